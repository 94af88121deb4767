"""The rig's camera before the scenes of training: the rig's own frames, of the scenes that demos are of."""

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from ddg_jax.generate import Clip
from ddgrasp import machine
from ddgrasp.config import (
    Config,
    PictureConfig,
    RandomConfig,
    StudentConfig,
    StudentTrainingConfig,
    WorldConfig,
)
from ddgrasp.errors import UserError
from ddgrasp.layout import QPOS
from ddgrasp.progress import Progress
from demos.rollout import Roller, successful
from demos.store import EpisodeStore
from mjx_envs.randomize import ObjectTable
from mjx_envs.views import Views, observed
from rig.camera import camera_pose, make_camera
from rig.world import make_world
from sensors.models.active_stereo import ActiveStereo
from student_jax import frames_io
from student_jax.act import SourceCamera
from student_jax.depth_source import VIEWED, check_demos, make_source
from student_jax.rig_source import RigSource
from teacher_support import still_teacher

CONFIG = Config(
    preset="test",
    seed=3,
    world=WorldConfig(
        objects=("apple", "block", "can"),
        camera_scale=0.125,
        episode_steps=3,
        random=RandomConfig(other_pose_share=0.5),
    ),
    student=StudentConfig(
        depth_source="rig",
        picture=PictureConfig(height_px=32, width_px=40),
        training=StudentTrainingConfig(clean_share=0.0, crop_shift_px=2),
    ),
)


@pytest.fixture(scope="module")
def roller() -> Roller:
    return Roller(CONFIG, still_teacher(), 12)


def test_a_frame_is_what_the_rigs_own_camera_takes_of_the_scene():
    upright = replace(CONFIG.world, random=replace(CONFIG.world.random, other_pose_share=0.0))
    world, rng = make_world(upright), np.random.default_rng(0)
    camera, ideal = (make_camera(CONFIG, world, ideal) for ideal in (False, True))
    source, clean = make_source(CONFIG, Path()), RigSource(CONFIG, ideal=True)
    for index, name in enumerate(CONFIG.world.objects):
        world.reset(index, name)
        lying_m = world.data.qpos[QPOS.object_pos][2]
        world.step(0.5)
        view = Views(
            world.data.qpos[None].copy(),
            np.array([index]),
            np.array([lying_m / world.objects[name].rest_height_m]),
            camera_pose(CONFIG, rng)[None],
        )
        episode, frame = np.array([index]), np.array([7])
        blank = np.zeros((1, 1, 1), np.uint16)
        (seen,), (rendered,) = (s.frames(blank, None, episode, frame, view) for s in (source, clean))
        draw = np.random.default_rng([CONFIG.seed, 0x626F756E, index, 7])
        taken = camera.depth_mm(world.data, view.T_world_cam[0], draw, name)
        np.testing.assert_array_equal(rendered, ideal.clean_mm(world.data, view.T_world_cam[0]))
        np.testing.assert_array_equal(seen, taken)
        assert 0.6 < np.mean(seen > 0) < 1.0 and np.any(seen != rendered)


def test_an_episode_stays_before_its_own_table(monkeypatch):
    config = replace(CONFIG, record=replace(CONFIG.record, other_tables=True))
    world, painted = make_world(CONFIG.world), []
    world.reset(0, "apple")
    poses = np.repeat(camera_pose(CONFIG, np.random.default_rng(0))[None], 5, axis=0)
    views = Views(np.repeat(world.data.qpos[None], 5, axis=0), np.zeros(5, int), np.ones(5), poses)
    monkeypatch.setattr(machine, "cores", lambda: 1)
    paint = ActiveStereo.paint
    monkeypatch.setattr(ActiveStereo, "paint", lambda self, seed: painted.append(seed) or paint(self, seed))
    episode, frame = np.array([3, 3, 4, 4, 3]), np.arange(5)
    RigSource(config).frames(np.zeros((5, 1, 1), np.uint16), None, episode, frame, views)
    first, second, third, fourth, again = painted[1:]  # after the one that a camera begins with
    assert first == second == again != third == fourth


def test_a_rollout_s_views_are_of_what_it_shows(roller):
    """Objects of any size in either rest pose: the same surfaces to the millimetre or two."""
    camera, scenes = SourceCamera(RigSource(CONFIG, ideal=True)), []

    def actor(scene):
        scenes.append((scene.depth_mm.astype(int), camera(scene).astype(int), scene.views))
        return scene.expert

    episodes = roller.run(jax.random.PRNGKey(0), actor)
    objects, names = (
        ObjectTable(CONFIG.world.objects),
        [CONFIG.world.objects[i] for i in episodes.object_index],
    )
    assert len(set(episodes.variant.tolist())) > 3 and np.ptp(episodes.size) > 0.03
    for shown, again, views in scenes:
        assert [objects.variants[v].name for v in views.variant] == names
        assert np.mean(np.abs(shown - again) > 2) < 2e-4
        other = replace(views, size=1.2 * views.size)
        assert np.mean(np.abs(shown - _clean(other)) > 2) > 1e-3


def _clean(views: Views) -> np.ndarray:
    blank, number = np.zeros((len(views), 1, 1), np.uint16), np.arange(len(views))
    return RigSource(CONFIG, ideal=True).frames(blank, None, number, number, views).astype(int)


@pytest.fixture(scope="module")
def episodes(tmp_path_factory) -> list:
    """What demos keep of rollouts that all count as successful."""
    roller = Roller(CONFIG, still_teacher(), 3, keep=tmp_path_factory.mktemp("spool"))
    made = roller.run(jax.random.PRNGKey(1), lambda scene: scene.expert)
    return list(successful(replace(made, success=np.ones(3, bool))))


def test_demos_say_what_their_pictures_are_of(episodes, tmp_path):
    store, frames = (EpisodeStore(tmp_path / name, create=True) for name in ("demos", "frames"))
    for steps, episode in episodes:
        store.append(steps, episode)
    frames_io.add_noisy_demos(store, frames, RigSource(CONFIG, ideal=True), CONFIG, Progress(quiet=True))
    off_mm = np.abs(frames.steps("depth_mm").astype(int) - store.steps("depth_mm"))
    assert frames.ends.tolist() == store.ends.tolist() and np.mean(off_mm > 2) < 2e-4


def test_noise_hangs_on_a_frame_s_numbers_alone_however_it_is_asked_for(episodes):
    """Episode by episode, going on from the second, all frames in a batch by many threads, one by one."""
    source, clips = RigSource(CONFIG), []
    for number, (steps, said) in enumerate(episodes):
        fixed = (np.repeat(np.asarray(said[name])[None], 3, axis=0) for name in VIEWED)
        views = observed(steps["observation"], *fixed)
        clips.append(Clip(number, steps["depth_mm"], None, views))
    whole = list(source.episodes([3, 3, 3], clips.__getitem__))
    np.testing.assert_array_equal(whole[1:], list(source.episodes([3, 3, 3], clips.__getitem__, 1)))
    for clip, expected in zip(clips, whole, strict=True):
        backwards = [2, 1, 0]
        views = Views(*(values[backwards] for values in vars(clip.views).values()))
        number = np.full(3, clip.number), np.array(backwards)
        seen = source.frames(clip.depth_mm, None, *number, views)
        np.testing.assert_array_equal(seen, expected[backwards])
    assert np.any(whole[0][0] != whole[0][1])


@pytest.mark.parametrize("went_on", [False, True])
def test_demos_that_do_not_say_it_are_refused_in_one_line(went_on, episodes, tmp_path):
    """Neither do those that were begun before demos said it."""
    store = EpisodeStore(tmp_path / "demos", create=True)
    steps, said = episodes[0]
    store.append(steps, {name: said[name] for name in ("object_index", "T_world_cam")})
    if went_on:
        store.append(steps, said)
    with pytest.raises(UserError, match=r"does not say which object .* collect new ones") as error:
        check_demos(RigSource(CONFIG), store)
    assert "\n" not in str(error.value)
