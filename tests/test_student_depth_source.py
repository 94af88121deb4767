"""Depth sources of the student stage: by name, keyed by episode and frame, on demos and in closed loop."""

import math
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from app.commands.checks import check_config_values
from config_support import unchecked
from ddg_jax import generate, sample, train
from ddg_jax.generate import Clip
from ddg_jax.prior import make_prior
from ddg_jax.sensor import SENSORS
from ddgrasp import artifacts, config, contract, upgrades
from ddgrasp.config import (
    BY_COLOUR,
    Config,
    DDGConfig,
    DDGDepthConfig,
    DDGDiffusionConfig,
    DextrahConfig,
    GraftConfig,
    PictureConfig,
    SamplingConfig,
    StudentConfig,
    StudentTrainingConfig,
    UNetConfig,
    WorldConfig,
)
from ddgrasp.errors import UserError
from ddgrasp.presets import get_preset
from ddgrasp.progress import Progress
from demos.rollout import Scene
from demos.store import EpisodeStore
from learning.params import save_params
from sensors.models.procedural import ellipse_dropout
from student_jax import frames_io
from student_jax.act import SourceCamera
from student_jax.depth_source import (
    EllipseDropoutSource,
    GeneratorSource,
    SenseSource,
    check_demos,
    make_source,
)
from upgrades_support import downgraded

CONFIG = Config(
    preset="test",
    seed=3,
    world=WorldConfig(camera_scale=0.125),
    ddg=DDGConfig(
        depth=DDGDepthConfig(height_px=18, width_px=32),
        unet=UNetConfig(widths=(8, 8), blocks=(0, 1), attention_heads=1),
        diffusion=DDGDiffusionConfig(steps=50),
        sampling=SamplingConfig(steps=2, batch_size=4),
        graft=GraftConfig(noise_threshold=-0.02),
    ),
    student=StudentConfig(
        picture=PictureConfig(height_px=32, width_px=40),
        training=StudentTrainingConfig(clean_share=0.0, demo_held_steps=99, crop_shift_px=2),
    ),
)
PROFILE = CONFIG.world.profile
LENGTHS = (5, 20, 3)


def with_source(name: str, clean_share: float = 0.0) -> Config:
    training = replace(CONFIG.student.training, clean_share=clean_share)
    return replace(CONFIG, student=replace(CONFIG.student, depth_source=name, training=training))


@pytest.fixture(scope="module")
def demos(tmp_path_factory) -> EpisodeStore:
    """Tables at 0.7 to 1.5 m without noise."""
    store = EpisodeStore(tmp_path_factory.mktemp("demos") / "episodes.zarr", create=True)
    rng = np.random.default_rng(0)
    rows = np.linspace(1500, 700, PROFILE.height_px)[:, None]
    for length in LENGTHS:
        depth = np.broadcast_to(rows, (length, PROFILE.height_px, PROFILE.width_px)) + rng.integers(9)
        numbers = rng.random((length, 40)).astype(np.float32)
        steps = {"state": numbers[:, :8], "action": numbers[:, :8], "observation": numbers}
        store.append(
            {"depth_mm": depth.astype(np.uint16), "held": np.arange(length) > 2, **steps},
            {"object_index": np.int32(0)},
        )
    return store


@pytest.fixture(scope="module")
def generator() -> sample.Generator:
    params = train.init_params(CONFIG.ddg, jax.random.key(0))
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    noisy = [leaf + 0.1 * jax.random.normal(key, leaf.shape) for leaf, key in zip(leaves, keys, strict=True)]
    return sample.Generator(CONFIG.ddg, jax.tree.unflatten(tree, noisy), make_prior(CONFIG.ddg))


def training_depth(settings: Config, source, demos: EpisodeStore, folder: Path, have: int = 0) -> np.ndarray:
    """(N, H, W) what the student trains on; the first `have` episodes as an interrupted stage left them."""
    frames = EpisodeStore(folder / "frames.zarr", create=True)
    frames_io.add_noisy_demos(demos, frames, source, settings, Progress(quiet=True))
    if have:
        begun = EpisodeStore(folder / "begun.zarr", create=True)
        for i in range(have):
            rows = ([0, *frames.ends.tolist()][i], int(frames.ends[i]))
            begun.append(
                {name: frames.steps(name, *rows) for name in frames.fields}, {"from_demo": np.bool_(True)}
            )
        frames_io.add_noisy_demos(demos, begun, source, settings, Progress(quiet=True))
        np.testing.assert_array_equal(begun.steps("depth_mm"), frames.steps("depth_mm"))
    return frames.steps("depth_mm")


class Numbered:
    """A depth source that adds a thousand to every picture, and a hundred for each episode before."""

    needs_rgb = needs_views = False

    def episodes(self, lengths, read, first=0):
        """See `DepthSource`."""
        for i in range(first, len(lengths)):
            clip = read(i)
            assert len(clip.depth_mm) == lengths[i]
            yield clip.depth_mm + np.uint16(1000 + 100 * clip.number)


def test_demos_that_stay_clean_are_no_other_demo_s_noise_also_for_a_stage_that_goes_on(demos, tmp_path):
    settings = replace(with_source("ideal", clean_share=0.5), seed=9)
    clean = np.random.default_rng(9).random(len(LENGTHS)) < 0.5
    assert clean.tolist() == [False, True, False]
    seen = training_depth(settings, Numbered(), demos, tmp_path, have=2)
    added = np.repeat([1000, 0, 1200], LENGTHS)[:, None, None]
    np.testing.assert_array_equal(seen, demos.steps("depth_mm") + added)


def test_every_camera_model_is_a_choice_and_a_wrong_name_is_refused_with_them():
    assert set(config.SENSORS) == set(SENSORS)
    assert StudentConfig().depth_source == "learned"
    with pytest.raises(UserError, match=r"student.depth_source 'dextra'. Did you mean 'dextrah'"):
        with_source("dextra")


def test_ideal_depth_is_the_demos(demos, tmp_path):
    settings = with_source("ideal")
    source = make_source(settings, tmp_path / "no generator needed")
    seen = training_depth(settings, source, demos, tmp_path)
    np.testing.assert_array_equal(seen, demos.steps("depth_mm"))


def test_a_stretch_s_samples_are_those_of_the_whole_demo(demos, tmp_path):
    whole_settings = with_source("ideal")
    training = replace(whole_settings.student.training, demo_stretch_steps=4, demo_held_steps=9)
    cut_settings = replace(whole_settings, student=replace(whole_settings.student, training=training))
    loaded = {}
    for name, settings in (("whole", whole_settings), ("cut", cut_settings)):
        source = make_source(settings, tmp_path / "no generator needed")
        training_depth(settings, source, demos, tmp_path / name, have=2)
        loaded[name] = frames_io.load(tmp_path / name / "frames.zarr")
    whole, cut = loaded["whole"], loaded["cut"]
    assert whole.drawn.all() and np.bincount(cut.episode[cut.drawn]).tolist() == [4, 4, 3]
    assert set(cut.draw(np.random.default_rng(0), 200, 0.4)) == set(np.flatnonzero(cut.drawn))
    of_step = {tuple(row): i for i, row in enumerate(whole.observation)}
    at = np.flatnonzero(cut.drawn)
    same = np.array([of_step[tuple(row)] for row in cut.observation[at]])
    np.testing.assert_array_equal(cut.depth_stack(at), whole.depth_stack(same))
    np.testing.assert_array_equal(cut.state[at], whole.state[same])
    chunk = CONFIG.student.head.chunk
    np.testing.assert_array_equal(cut.action_chunks(at, chunk), whole.action_chunks(same, chunk))
    assert np.all(np.diff(same[cut.episode[at] == 1]) == 1)


def test_a_stretch_begins_anywhere():
    assert frames_io.stretch(9, 0, (0, 0)) == frames_io.stretch(9, 9, (0, 0)) == range(9)
    kept = [frames_io.stretch(9, 3, (0, number)) for number in range(200)]
    assert {steps.stop for steps in kept} == {3, 4, 5, 6, 7, 8, 9}
    assert all(len(steps) == 3 for steps in kept)


def test_dextrah_loses_and_replaces_the_expected_shares(demos, tmp_path):
    settings = with_source("dextrah")
    seen = training_depth(settings, make_source(settings, tmp_path), demos, tmp_path, have=2)
    clean, strengths = demos.steps("depth_mm"), DextrahConfig()
    # Sticks cover a little besides; random values fall near the table now and then.
    assert np.mean(seen == 0) == pytest.approx(strengths.dropout, rel=0.15)
    far = np.abs(seen.astype(int) - clean) > 60
    assert np.mean(far & (seen > 0)) > 0.8 * strengths.random_value
    assert np.mean(seen != clean) > 0.3


def test_a_student_s_formulas_take_its_scale(demos):
    def deviation(settings):
        numbers = np.arange(6)
        clean = demos.steps("depth_mm")[:6]
        seen = make_source(settings, Path()).frames(clean, None, numbers, numbers)
        off = seen.astype(int) - clean
        return off[(seen > 0) & (np.abs(off) < 60)].std()

    once = with_source("dextrah")
    twice = replace(once, student=replace(once.student, dextrah_scale=2.0))
    assert deviation(twice) == pytest.approx(2 * deviation(once), rel=0.2)
    normal = replace(once, student=replace(once.student, dextrah_normal_m=0.01))
    assert deviation(normal) ** 2 - deviation(once) ** 2 > 5.0**2  # 10 mm times the table's share


def with_ellipses(settings: Config, number: float = 4.0) -> Config:
    student = replace(settings.student, ellipse_dropout=number, ellipse_half_axis_px=9.0)
    return replace(settings, student=student)


@pytest.mark.parametrize("name", ["ideal", "dextrah"])
def test_ellipses_are_dropped_from_whatever_a_source_gives(demos, tmp_path, name):
    plain, dropping = with_source(name), with_ellipses(with_source(name))
    own, wrapped = (make_source(settings, tmp_path) for settings in (plain, dropping))
    seen, holed = (
        training_depth(settings, source, demos, tmp_path / source.__class__.__name__)
        for settings, source in ((plain, own), (dropping, wrapped))
    )
    changed = holed != seen
    assert not holed[changed].any(), "nothing but holes"
    # Half axes are 9 px x 8^-u: 3.8 px on average; some beyond the border or on another.
    assert changed.mean() == pytest.approx(4 * math.pi * 3.79**2 / (90 * 160), rel=0.3)


def clips_of(demos: EpisodeStore) -> list[Clip]:
    """The demos' frames as episodes 10, 11, ..."""
    parts = np.split(demos.steps("depth_mm"), demos.ends[:-1])
    return [Clip(10 + i, part) for i, part in enumerate(parts)]


def test_ellipses_of_a_frame_hang_on_its_own_numbers_alone(demos, tmp_path):
    source, clips = make_source(with_ellipses(with_source("dextrah")), tmp_path), clips_of(demos)
    whole = list(source.episodes(LENGTHS, clips.__getitem__))
    np.testing.assert_array_equal(whole[2], next(source.episodes(LENGTHS, clips.__getitem__, 2)))
    alone = source.frames(clips[1].depth_mm[[7]], None, np.array([11]), np.array([7]))
    np.testing.assert_array_equal(alone[0], whole[1][7])


def test_ellipses_find_their_episode_where_a_generator_reads_ahead(demos, generator):
    own, clips = GeneratorSource(generator, jax.random.key(3)), clips_of(demos)
    dropout = SenseSource(ellipse_dropout(4.0, 9.0), jax.random.key(3))
    source = EllipseDropoutSource(own, dropout)
    seen = own.episodes(LENGTHS, clips.__getitem__)
    whole = list(source.episodes(LENGTHS, clips.__getitem__))
    for clip, plain, holed in zip(clips, seen, whole, strict=True):
        number = np.full(len(plain), clip.number)
        np.testing.assert_array_equal(holed, dropout.frames(plain, None, number, np.arange(len(plain))))
        assert np.mean(holed != plain) > 0.001
    np.testing.assert_array_equal(whole[2], next(source.episodes(LENGTHS, clips.__getitem__, 2)))


@pytest.mark.parametrize(("name", "needs"), [("stereo", (True, False)), ("rig", (False, True))])
def test_with_ellipses_a_source_needs_what_it_needs(tmp_path, name, needs):
    source = make_source(with_ellipses(with_source(name)), tmp_path)
    assert (source.needs_rgb, source.needs_views) == needs


def test_the_clean_share_keeps_clean_depth_whatever_the_source(demos, tmp_path):
    settings = with_source("dextrah", clean_share=1.0)
    seen = training_depth(settings, make_source(settings, tmp_path), demos, tmp_path)
    np.testing.assert_array_equal(seen, demos.steps("depth_mm"))


def test_a_frame_hangs_on_its_own_numbers_alone(demos):
    source = make_source(with_source("kinect"), Path())
    assert isinstance(source, SenseSource)
    depth = demos.steps("depth_mm")[:6]
    episode, frame = np.array([7, 7, 7, 8, 8, 9]), np.array([0, 1, 2, 0, 1, 0])
    together = source.frames(depth, None, episode, frame)
    apart = [source.frames(depth[i][None], None, episode[[i]], frame[[i]])[0] for i in range(6)]
    np.testing.assert_array_equal(together, np.stack(apart))
    again = source.frames(depth, None, episode, frame + 10)
    assert all(np.any(a != b) for a, b in zip(together, again, strict=True))


def test_learned_is_the_generator_of_the_run_to_the_bit(demos, generator, tmp_path):
    save_params(tmp_path / "ddg" / sample.PARAMS_FILE, generator.params)
    artifacts.finish(tmp_path / "ddg", "ddg", CONFIG, seconds=1, metrics={})
    source = make_source(CONFIG, tmp_path / "ddg")
    assert isinstance(source, GeneratorSource) and not source.needs_rgb
    seen = training_depth(CONFIG, source, demos, tmp_path)
    clips = np.split(demos.steps("depth_mm"), demos.ends[:-1])
    key = jax.random.key(CONFIG.seed)
    expected = generate.noisy_episodes(
        key, generator, [len(clip) for clip in clips], lambda i: generate.Clip(i, clips[i])
    )
    np.testing.assert_array_equal(seen, np.concatenate(list(expected)))
    assert 0.01 < np.mean(seen == 0) < 0.99

    rest = {name: np.zeros(3) for name in ("state", "expert", "observation", "held")}
    scene = Scene(depth_mm=clips[0][:3], step=4, **rest)
    metres = scene.depth_mm.astype(np.float32) * contract.DEPTH_UNIT_M
    direct = sample.generate(key, generator, metres, episode=100 + np.arange(3), frame=np.full(3, 4))
    np.testing.assert_array_equal(
        SourceCamera(source, first=100)(scene),
        np.round(direct.depth_m / contract.DEPTH_UNIT_M).astype(np.uint16),
    )


def test_without_grafting_the_student_sees_the_generators_own_map(demos, generator, tmp_path):
    save_params(tmp_path / "ddg" / sample.PARAMS_FILE, generator.params)
    artifacts.finish(tmp_path / "ddg", "ddg", CONFIG, seconds=1, metrics={})
    settings = with_source("learned_ungrafted")
    source = make_source(settings, tmp_path / "ddg")
    seen = training_depth(settings, source, demos, tmp_path, have=1)
    key = jax.random.key(CONFIG.seed)
    starts = [0, *demos.ends.tolist()]
    for i, (first, last) in enumerate(zip(starts, starts[1:], strict=False)):
        metres = demos.steps("depth_mm", first, last).astype(np.float32) * contract.DEPTH_UNIT_M
        made = sample.generate(key, generator, metres, episode=i)
        own_mm = np.round(made.predicted_m / contract.DEPTH_UNIT_M).astype(np.uint16)
        # Batches of other sizes round a few pixels otherwise.
        off_mm = np.abs(seen[first:last].astype(int) - own_mm)
        assert off_mm.max() <= 1 and np.mean(off_mm > 0) < 1e-3
        number = np.array([i]), np.zeros(1, int)
        alone = sample.generate(key, generator, metres[:1], episode=number[0], frame=number[1])
        direct = source.frames(demos.steps("depth_mm", first, first + 1), None, *number)
        np.testing.assert_array_equal(direct, np.round(alone.predicted_m / contract.DEPTH_UNIT_M))
        assert np.any(made.depth_m != made.predicted_m)


def test_the_rigs_camera_looks_at_clean_depth_in_colour(demos, tmp_path):
    settings = with_source("stereo")
    source = make_source(settings, tmp_path)
    assert source.needs_rgb and BY_COLOUR == ("stereo",)
    depth = demos.steps("depth_mm")[:1]
    bright, dark = (np.full((1, *depth.shape[1:], 3), value, np.uint8) for value in (150, 2))
    number = np.zeros(1, int)
    seen = source.frames(depth, bright, number, number)
    assert 0.6 < np.mean(seen > 0) < 1.0
    assert np.median(np.abs(seen.astype(int) - depth)[seen > 0]) < 20
    assert np.mean(source.frames(depth, dark, number, number) > 0) < np.mean(seen > 0) - 0.2
    with pytest.raises(UserError, match=r"holds no colour, .* --demos.rgb"):
        check_demos(source, demos)


def test_students_from_before_there_was_a_choice_were_trained_on_learned_depth():
    flat = downgraded(artifacts.to_json(with_source("dextrah")), 1)
    assert "depth_source" not in flat["student"]
    assert upgrades.upgraded(flat, 1)["student"]["depth_source"] == "learned"


def test_missing_colour_is_refused_before_the_first_stage():
    preset = get_preset("debug")
    coloured = replace(preset, student=replace(preset.student, depth_source="stereo"))
    wanting = replace(coloured, demos=replace(preset.demos, rgb=False))
    with pytest.raises(UserError, match=r"'stereo' needs colour in the demos, .* --demos.rgb") as error:
        check_config_values(wanting)
    assert "\n" not in str(error.value)
    check_config_values(replace(coloured, demos=replace(preset.demos, rgb=True)))


def test_a_source_with_a_name_and_nothing_behind_it_is_no_camera_model(tmp_path):
    named = unchecked(CONFIG.student, depth_source="flat")
    with pytest.raises(ValueError, match="'flat' has no line here"):
        make_source(replace(CONFIG, student=named), tmp_path)
