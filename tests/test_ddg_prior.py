"""The built-in prior and the loading of recordings, by value on small pictures."""

import gc
import shutil
import tracemalloc
from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from ddg_jax import data, geometry, prior
from ddgrasp import artifacts, machine
from ddgrasp.config import DDGConfig, DDGDepthConfig, DDGTrainingConfig, PriorConfig, UNetConfig
from ddgrasp.depth import crop_nearest
from ddgrasp.errors import UserError
from ddgrasp.presets import PRESETS
from ddgrasp.progress import Progress, Task
from learning import memory
from recording_support import flat, set_meta, write_depth
from sensors.recordings.writer import RecordingWriter
from sensors.statistics.holes import fill_from_background


def test_holes_take_the_farther_neighbour_of_their_row():
    near, far = 2.0, 1.0
    inverse = np.full((9, 12), far, np.float32)
    inverse[:, 6:] = near
    truth = inverse.copy()
    inverse[:, 4:6] = 0  # the shadow left of the near surface
    inverse[:, 0] = 0  # left band
    np.testing.assert_array_equal(fill_from_background(inverse), truth)


def test_rows_without_a_reading_take_the_nearest_row():
    inverse = np.ones((12, 10), np.float32)
    inverse[8:] = 3.0
    inverse[:3] = 0
    filled = fill_from_background(inverse)
    assert (filled[:3] == 1).all() and (filled[8:] == 3).all()
    assert (fill_from_background(np.zeros((4, 4), np.float32)) == 0).all()


def test_prior_ignores_affine_changes_of_inverse_depth():
    inverse = np.random.default_rng(0).uniform(0.5, 2, (2, 20, 30)).astype(np.float32)
    c = prior.normalise(inverse)
    np.testing.assert_allclose(prior.normalise(3 * inverse + 0.7), c, atol=1e-4)
    assert abs(np.median(c)) < 0.02 and abs(np.mean(np.abs(c)) - 0.5) < 0.02


def test_the_metric_prior_says_how_far_a_surface_is_whatever_else_is_seen():
    made = prior.make_prior(DDGConfig(prior=PriorConfig(source="metric_inverse_depth")))
    near, far = np.full((1, 24, 32), 1.0, np.float32), np.full((1, 24, 32), 4.0, np.float32)
    mixed = np.concatenate([near[:, :12], far[:, :12]], axis=1)
    np.testing.assert_allclose(made.from_sim(near), 0, atol=1e-6)
    np.testing.assert_allclose(made.from_sim(mixed)[0, 2], 0, atol=1e-6)
    np.testing.assert_allclose(made.from_sim(mixed)[0, -2], made.from_sim(far)[0, -2], atol=1e-6)
    rng = np.random.default_rng(0)
    np.testing.assert_allclose(made.from_recording(mixed, None, rng), made.from_sim(mixed), atol=1e-6)
    close = np.full((1, 24, 32), 0.3, np.float32)  # nearer than most of what a normalised prior tells apart
    np.testing.assert_allclose(made.from_sim(close), 2 / 0.3 - 2, rtol=1e-5)
    np.testing.assert_allclose(made.from_recording(close, None, rng), made.from_sim(close), rtol=1e-5)
    np.testing.assert_allclose(made.from_sim(close / 10), 2 / prior.NEAREST_M - 2, rtol=1e-5)


def test_recording_and_simulation_of_one_scene_give_the_same_prior():
    clean = np.full((3, 24, 32), 1.5, np.float32)
    clean[:, 8:16, 12:22] = 0.8
    noisy = clean.copy()
    noisy[:, 8:16, 9:12] = 0
    made = prior.InverseDepthPrior(blur_px=1.0)
    rng = np.random.default_rng(0)
    np.testing.assert_allclose(made.from_recording(noisy, None, rng), made.from_sim(clean), atol=1e-5)


def test_frames_that_do_not_follow_each_other_leave_each_other_alone():
    table, box = np.full((1, 24, 32), 1.30, np.float32), np.full((1, 24, 32), 1.30, np.float32)
    box[:, 8:16, 12:22] = 1 / (1 / 1.30 + 0.03)  # within what counts as one surface
    made = prior.make_prior(DDGConfig(prior=PriorConfig(source="metric_inverse_depth", decoy_holes=0.0)))
    photos, rng = np.concatenate([table, box, table]), np.random.default_rng(0)
    apart = made.from_recording(photos, None, rng, consecutive=False)
    for c, photo in zip(apart, (table, box, table), strict=True):
        np.testing.assert_array_equal(c, made.from_recording(photo, None, rng)[0])
    assert np.abs(apart - made.from_recording(photos, None, rng)).max() > 0.01


def test_each_of_unrelated_photos_has_a_scale_of_its_own():
    near, far = (np.linspace(d, 2 * d, 24 * 32, dtype=np.float32).reshape(1, 24, 32) for d in (0.5, 1.5))
    made = prior.make_prior(DDGConfig(prior=PriorConfig(source="inverse_depth", decoy_holes=0.0)))
    photos, rng = np.concatenate([near, far]), np.random.default_rng(0)
    apart = made.from_recording(photos, None, rng, consecutive=False)
    for c, photo in zip(apart, (near, far), strict=True):
        np.testing.assert_array_equal(c, made.from_recording(photo, None, rng)[0])
    assert np.abs(apart - made.from_recording(photos, None, rng)).max() > 0.3


def test_temporal_smoothing_averages_one_surface_and_keeps_moving_edges():
    inverse = np.ones((3, 1, 2), np.float32)
    inverse[:, 0, 0] = (1.0, 1.03, 1.0)
    inverse[:, 0, 1] = (1.0, 2.0, 1.0)
    smooth = list(prior.smooth_in_time(inverse))
    assert len(smooth) == 3
    np.testing.assert_allclose(smooth[1][0], [1.01, 2.0], atol=1e-6)
    np.testing.assert_allclose(smooth[2][0], [1.015, 1.0], atol=1e-6)


def test_a_decoy_is_a_hole_moved_anywhere():
    holes = np.zeros((4, 6), bool)
    holes[1:3, 2] = True
    rng = np.random.default_rng(0)
    moved = [prior.decoy_holes(holes, rng) for _ in range(400)]
    assert {int(decoy.sum()) for decoy in moved} == {2}
    assert len({decoy.tobytes() for decoy in moved}) == holes.size


@pytest.mark.parametrize(("share", "least", "most"), [(0.0, 0, 0), (0.5, 6, 14), (1.0, 20, 20)])
def test_a_share_of_the_frames_is_filled_under_a_decoy_too(share, least, most):
    """A slope, whose filled pixels are flat; in turn so much nearer that no frame is smoothed by the next."""
    slope = np.broadcast_to(np.linspace(1.0, 2.0, 48, dtype=np.float32), (20, 36, 48))
    depth = slope * np.where(np.arange(20) % 2, 1.0, 0.6).astype(np.float32)[:, None, None]
    depth[:, 10:16, 20:28] = 0
    plain, made = (
        prior.MetricInverseDepthPrior(0.0, x).from_recording(depth, None, np.random.default_rng(0))
        for x in (0.0, share)
    )
    elsewhere = np.abs(made - plain) > 0.01
    assert least <= elsewhere.any(axis=(1, 2)).sum() <= most


def test_resizing_never_mixes_holes_into_surfaces():
    image = np.where(np.indices((48, 64)).sum(0) % 3 == 0, 0, 1000).astype(np.uint16)
    small = crop_nearest(image, (18, 32))
    assert small.shape == (18, 32) and set(np.unique(small)) == {0, 1000}
    ramp = np.tile(np.arange(64), (36, 1))
    assert crop_nearest(ramp, (18, 32))[0].tolist() == list(range(1, 64, 2))


@pytest.fixture
def recordings(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("a", "b"):
        depth_mm = rng.integers(700, 900, (3, 36, 64)).astype(np.uint16)
        depth_mm[..., :5] = 0
        write_depth(tmp_path / name, depth_mm)
    return tmp_path


def test_frames_and_batches(recordings):
    config = DDGConfig(
        depth=DDGDepthConfig(height_px=18, width_px=32),
        training=DDGTrainingConfig(batch_size=4, holdout_fraction=0.34),
    )
    frames = data.load_frames(recordings, config, prior.make_prior(config), 0, Progress(quiet=True))
    assert len(frames) == 6 and frames.recording.tolist() == [0, 0, 0, 1, 1, 1]
    np.testing.assert_allclose(np.mean(frames.depth_m == 0), 2 / 32)
    training, held = frames.split(config.training.holdout_fraction)
    assert training.recording.tolist() == [0, 0, 0] and held.recording.tolist() == [1, 1, 1]
    assert [len(part) for part in frames.split(0.17)] == [5, 1]  # a whole recording would be three times that
    assert [len(part) for part in training.split(0.34)] == [2, 1]  # there is but one
    one, again, other = (data.make_batch(training, config, 7, step) for step in (3, 3, 4))
    np.testing.assert_array_equal(one.x_0, again.x_0)
    assert not np.array_equal(one.c, other.c)
    holes, deviation = np.moveaxis(one.x_0, -1, 0)
    assert (holes[:, :, 0] == -1).all() and (holes[:, :, 3:] == 1).all()
    assert (deviation[holes == -1] == 0).all() and 0 < np.abs(deviation).max() <= 1
    with pytest.raises(UserError, match="record more"):
        frames.part(slice(0, 1)).split(0.1)
    with pytest.raises(UserError, match="inverse_depth"):
        prior.make_prior(DDGConfig(prior=PriorConfig(source="inverse_dept")))


@pytest.mark.parametrize("fraction", [0.17, 0.34, 0.5])
def test_the_held_out_frames_alone_are_those_that_all_of_them_hold_out(recordings, monkeypatch, fraction):
    config = DDGConfig(
        depth=DDGDepthConfig(height_px=18, width_px=32),
        training=DDGTrainingConfig(holdout_fraction=fraction),
    )
    given = recordings, config, prior.make_prior(config), 0, Progress(quiet=True)
    _, held = data.load_frames(*given).split(fraction)
    read, plainly = [], data._read

    def noted(number, recording, *given):
        read.append(recording.path.name)
        return plainly(number, recording, *given)

    monkeypatch.setattr(data, "_read", noted)
    alone = data.load_held_out(*given)
    assert read == ["b"]
    for name in ("depth_m", "surface_m", "prior", "recording"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(held, name))


@pytest.mark.parametrize("last_mm", [900, 0])
def test_what_is_held_out_is_so_among_the_frames_that_can_be_used(tmp_path, last_mm):
    """Of the first recording half is there again, of the last all or nothing can be used."""
    for name, repeated in (("a", 10), ("b", 0)):
        depths_mm = (800 + n // 2 if name == "a" else last_mm and last_mm + n for n in range(20))
        write_depth(tmp_path / name, (flat((18, 32), mm) for mm in depths_mm), repeated_frames=repeated)
    config = replace(WIDE, training=DDGTrainingConfig(holdout_fraction=0.1))
    given = tmp_path, config, prior.make_prior(config), 0, Progress(quiet=True)
    _, held = data.load_frames(*given).split(0.1)
    np.testing.assert_array_equal(data.load_held_out(*given).depth_m, held.depth_m)


@pytest.mark.parametrize("blind", [40, 12])
def test_what_is_held_out_is_so_whatever_earlier_recordings_lack(tmp_path, blind):
    """All or some of the first recording's frames show nothing in the window that a wide generator sees."""
    edge = np.zeros((64, 64), np.uint16)
    edge[0] = 900
    for name, count in (("a", blind), ("b", 0)):
        write_depth(tmp_path / name, [edge] * count + [flat((64, 64), 900 + n) for n in range(40 - count)])
    config = replace(WIDE, training=DDGTrainingConfig(holdout_fraction=0.1))
    given = tmp_path, config, prior.make_prior(config), 0, Progress(quiet=True)
    training, held = data.load_frames(*given).split(0.1)
    assert len(training) + len(held) == 80 - blind
    np.testing.assert_array_equal(data.load_held_out(*given).depth_m, held.depth_m)


def test_frames_around_blind_ones_do_not_follow_each_other(tmp_path):
    edge = np.zeros((64, 64), np.uint16)
    edge[0] = 900
    for blind, apart in ((4, True), (0, False)):
        frames = [flat((64, 64), 900)] * 5
        frames[blind] = edge
        write_depth(tmp_path / f"{blind}", [*frames, flat((64, 64), 1500)], consecutive_frames=True)
        found = data.load_frames(tmp_path / f"{blind}", WIDE, prior.make_prior(WIDE), 0, Progress(quiet=True))
        assert (len(found), found.apart == {0}) == (5, apart)


def _record(path, frames: int = 2, size=(36, 64), **changes):
    write_depth(path, frames * [flat(size, 900)])
    set_meta(path, **changes)


class Notes(Progress):
    """Keeps what is said."""

    def __init__(self):
        super().__init__(quiet=True)
        self.said = []

    def note(self, text):
        self.said.append(text)


WIDE = DDGConfig(depth=DDGDepthConfig(height_px=18, width_px=32))


def load(root, config=WIDE):
    notes = Notes()
    return data.load_frames(root, config, prior.make_prior(config), 0, notes), notes.said


@pytest.mark.parametrize("follow", [False, True])
def test_frames_go_together_only_where_a_recording_says_that_they_follow_each_other(tmp_path, follow):
    """A table, then a box on it within what counts as one surface."""
    table, box = flat((36, 64), 1300), flat((36, 64), 1300)
    box[12:24, 20:40] -= np.uint16(49)  # 0.03 of 0.77 per metre
    write_depth(tmp_path / "a", [table, box], consecutive_frames=follow)
    metric = PriorConfig(source="metric_inverse_depth", decoy_holes=0.0)
    frames, _ = load(tmp_path, DDGConfig(depth=WIDE.depth, prior=metric))
    assert (np.ptp(frames.prior[0].astype(float)) > 0.01) == follow  # the table alone is flat
    assert frames.stretch.tolist() == ([0, 0] if follow else [-1, -2])  # between which nothing flickers


def test_a_frame_that_came_again_is_learnt_from_once(tmp_path):
    """A deployment whose camera stalled holds a picture for every step."""
    seen = (flat((36, 64), depth_mm) for depth_mm in (800, 801, 801, 801, 801, 800))
    write_depth(tmp_path / "a", seen, repeated_frames=3)
    frames, said = load(tmp_path)
    np.testing.assert_allclose(frames.depth_m[:, 0, 0], [0.8, 0.801, 0.8], rtol=1e-6)
    assert said[0].endswith("left out 3 frame(s) that came again") and frames.skipped_frames == 3
    _record(tmp_path / "b", frames=4)
    assert len(load(tmp_path)[0]) == 3 + 4  # what no camera gave twice stays


def test_recordings_of_several_sensors_are_named(tmp_path):
    for name, sensor in (("a", "D435"), ("b", "D455"), ("c", "D435")):
        _record(tmp_path / name, sensor=sensor)
    assert load(tmp_path)[1] == [
        "recordings of several sensors, which one generator will mix: D435 (2), D455 (1)"
    ]
    assert load(tmp_path / "a")[1] == []


def _depth(root, name, frame, image):
    (root / name / "depth" / f"{frame:06d}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())


def test_a_crop_is_told(tmp_path):
    _record(tmp_path / "square", size=(64, 64))
    assert any(
        "sees 56% of each 64x64 frame" in line and "--ddg.depth.height-px 32" in line
        for line in load(tmp_path)[1]
    )
    assert not any(
        "sees" in line
        for line in load(
            tmp_path,
            DDGConfig(
                depth=DDGDepthConfig(height_px=32, width_px=32),
            ),
        )[1]
    )


def test_a_crop_of_any_recording_is_told_once(tmp_path):
    _record(tmp_path / "a", depth_unit_m=0.00001)  # refused
    _record(tmp_path / "b")
    for name in "cd":
        _record(tmp_path / name, size=(64, 64))
    told = [line for line in load(tmp_path)[1] if "sees" in line]
    assert len(told) == 1 and f"{tmp_path / 'c'}: the generator sees 56%" in told[0]


def test_what_cannot_be_used_is_named_and_counted(recordings):
    _depth(recordings, "a", 1, np.zeros((36, 64), np.uint16))  # nothing valid
    (recordings / "b" / "color" / "000000.jpg").unlink()  # no colour
    _record(recordings / "mixed")
    _depth(recordings, "mixed", 1, np.full((18, 32), 900, np.uint16))
    _record(recordings / "unit", depth_unit_m=0.00001)
    (recordings / "loose" / "depth").mkdir(parents=True)
    _record(recordings / "blind", size=(64, 64))
    edge = np.zeros((64, 64), np.uint16)
    edge[0] = 900  # outside the window that a wide generator sees of a square picture
    _depth(recordings, "blind", 0, edge)
    frames, said = load(recordings)
    assert len(frames) == 2 + 2 + 1
    assert (frames.skipped_frames, frames.refused_recordings) == (3, 2)
    assert frames.recording.tolist() == [0, 0, 1, 1, 2] and frames.number.tolist() == [0, 1, 0, 1, 0]
    for words in (
        "000001.png: no valid depth",
        "000000.jpg is missing",
        "32x18",
        "unit: median depth",
        "loose has no meta.json",
    ):
        assert sum(words in line for line in said) == 1, (words, said)
    assert any("blind: left out 1 frame(s) without a valid pixel in the window" in line for line in said)
    assert said[-1] == "left out 3 frame(s), and 2 of 5 recording(s)"
    config = DDGConfig(
        depth=DDGDepthConfig(height_px=18, width_px=32),
    )
    few = data.load_frames(recordings, config, prior.make_prior(config), 0, Progress(quiet=True), 3)
    np.testing.assert_array_equal(few.depth_m, frames.depth_m[:3])


def test_colours_are_those_of_the_frames_that_can_be_used(tmp_path):
    """Frame n is 60 n bright; the second is blind in the window that a wide generator sees."""
    edge = np.zeros((64, 64), np.uint16)
    edge[0] = 900
    with RecordingWriter(tmp_path / "a", {}) as writer:
        for number in range(4):
            depth_mm = edge if number == 1 else flat((64, 64), 900 + number)
            writer.add(np.full((64, 64, 3), 60 * number, np.uint8), depth_mm)

    class Coloured(prior.InverseDepthPrior):
        needs_rgb = True

        def from_recording(self, depth, rgb, rng, consecutive=True):
            self.seen = [picture.mean() for picture in rgb]
            np.testing.assert_array_equal(np.asarray(rgb[1:]), np.stack(list(rgb))[1:])
            return super().from_recording(depth, None, rng, consecutive)

    coloured = Coloured(0.0)
    data.load_frames(tmp_path, WIDE, coloured, 0, Progress(quiet=True))
    np.testing.assert_allclose(coloured.seen, [0, 120, 180], atol=5)
    broken = tmp_path / "b"  # whole to look at: a picture that a power cut left
    shutil.copytree(tmp_path / "a", broken)
    (broken / "color" / "000002.jpg").write_bytes(b"\xff\xd8" + bytes(200) + b"\xff\xd9")
    frames = data.load_frames(tmp_path, WIDE, coloured, 0, Progress(quiet=True))
    assert frames.refused_recordings == 1 and set(frames.recording) == {0}


def test_no_frame_behind_the_first_ones_is_read_for_those_that_cannot_be_used(tmp_path):
    edge = np.zeros((64, 64), np.uint16)
    edge[0] = 900  # outside the window
    for name, blind in (("a", (0, 1)), ("b", (0,)), ("c", ())):
        _record(tmp_path / name, size=(64, 64))
        for frame in blind:
            _depth(tmp_path, name, frame, edge)
    for first, used in ((3, None), (4, [1]), (5, [1, 2]), (6, [1, 2, 2]), (9, [1, 2, 2])):
        made = partial(
            data.load_frames, tmp_path, WIDE, prior.make_prior(WIDE), 0, Progress(quiet=True), first
        )
        if used is None:
            with pytest.raises(UserError, match="none of its 3 recording"):
                made()
        else:
            assert made().recording.tolist() == used


def test_more_recordings_than_memory_are_refused_before_any_is_read(recordings, monkeypatch):
    needed = 6 * 18 * 32 * (4 + 4 + 2 + 2)
    assert data.frames_bytes(WIDE, 6) == needed
    monkeypatch.setattr(memory, "host_bytes", lambda: needed)
    assert len(load(recordings)[0]) == 6
    monkeypatch.setattr(memory, "host_bytes", lambda: needed - 1)
    monkeypatch.setattr(data, "find_recordings", None)
    with pytest.raises(
        UserError, match=r"ddg needs about .* on the host, .*: lower the number of recordings"
    ):
        load(recordings)


def test_priors_of_several_processes_are_those_of_one(recordings, monkeypatch):
    config = replace(WIDE, depth=replace(WIDE.depth, surface="planes"))
    monkeypatch.setattr(machine, "cores", lambda: 2)
    here, _ = load(recordings, config)
    monkeypatch.setattr(geometry, "FRAMES_A_PROCESS", 2)
    spread, _ = load(recordings, config)
    for name in ("depth_m", "surface_m", "prior", "recording"):
        np.testing.assert_array_equal(getattr(spread, name), getattr(here, name))


@pytest.mark.parametrize("frames_a_process", [500, 2])
def test_the_bar_counts_every_frame_wherever_it_is_made(recordings, monkeypatch, frames_a_process):
    """In this process one by one: a recording of minutes is not silent."""
    monkeypatch.setattr(machine, "cores", lambda: 2)
    monkeypatch.setattr(geometry, "FRAMES_A_PROCESS", frames_a_process)
    progress, told = Progress(quiet=True), []
    monkeypatch.setattr(Task, "advance", lambda self, n=1: told.append((self.label, n)))
    count = len(data.load_frames(recordings, WIDE, prior.make_prior(WIDE), 0, progress))
    frames = [n for label, n in told if label == "surfaces and priors"]
    assert sum(frames) == count and (len(frames) == count) == (frames_a_process == 500)


def test_one_long_recording_takes_what_is_said_of_it(tmp_path):
    _record(tmp_path / "long", frames=50, size=(54, 96))
    _record(tmp_path / "short", frames=1, size=(54, 96))
    config = DDGConfig(depth=DDGDepthConfig(height_px=54, width_px=96))
    load(tmp_path / "short", config)  # what compiling takes is not the recording's,
    gc.collect()  # nor what another test has left, to be told in pages of traceback
    tracemalloc.start()
    try:
        frames, _ = load(tmp_path / "long", config)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < 1.2 * data.frames_bytes(config, len(frames))


def test_colour_of_another_view_is_refused_where_the_prior_comes_from_it(tmp_path):
    class OfColour(prior.InverseDepthPrior):
        needs_rgb = True

    for name, said in (("apart", {"color_aligned_to_depth": False}), ("unsaid", {})):
        _record(tmp_path / name, **said)
    notes = Notes()
    frames = data.load_frames(tmp_path, WIDE, OfColour(1.0), 0, notes)
    assert len(frames) == 2 and any("apart: colour is not aligned to depth" in line for line in notes.said)
    with pytest.raises(UserError, match="align it when recording, or --ddg.prior.source inverse_depth"):
        data.load_frames(tmp_path / "apart", WIDE, OfColour(1.0), 0, notes)
    assert len(load(tmp_path)[0]) == 4  # depth alone needs no colour


def test_nothing_usable_is_refused_with_the_first_reason(tmp_path):
    for name in ("a", "b"):
        _record(tmp_path / name, depth_unit_m=0.00001)
    with pytest.raises(UserError, match="none of its 2 recording.*The first: .*a: median depth"):
        load(tmp_path)
    with pytest.raises(UserError, match="no such folder"):
        load(tmp_path / "nowhere")


def test_recordings_of_another_contract_version_are_refused(recordings):
    artifacts.finish(recordings, "record", PRESETS["debug"], seconds=1, metrics={})
    assert len(load(recordings)[0]) == 6
    path = recordings / artifacts.MANIFEST
    path.write_text(path.read_text().replace('"contract_version": 1', '"contract_version": 99'))
    with pytest.raises(UserError, match="contract version 99"):
        load(recordings)


@pytest.mark.parametrize("position", [False, True])
def test_half_of_a_batch_is_upside_down_unless_the_network_knows_where_it_is(position):
    depth = np.full((1, 8, 12), 1.0, np.float32)
    depth[:, :4] = 2.0  # the upper half is farther
    frames = data.Frames(depth, depth, np.where(depth > 1.5, -1.0, 1.0).astype(np.float16), np.zeros(1, int))
    config = DDGConfig(
        prior=PriorConfig(jitter=0.0),
        unet=UNetConfig(position=position),
        training=DDGTrainingConfig(batch_size=32),
    )
    priors = data.make_batch(frames, config, seed=0, step=0).c
    turned = np.mean(priors[:, 0, 0] > 0)
    assert turned == 0.0 if position else 0.3 < turned < 0.7


def test_a_batch_s_priors_are_off_in_scale_and_shift_by_the_jitter_at_most():
    depth = np.ones((1, 8, 12), np.float32)
    c = np.random.default_rng(0).normal(size=depth.shape).astype(np.float16)
    config = DDGConfig(
        prior=PriorConfig(jitter=0.1),
        unet=UNetConfig(position=True),
        training=DDGTrainingConfig(batch_size=32),
    )
    made = data.make_batch(data.Frames(depth, depth, c, np.zeros(1, int)), config, seed=0, step=0).c
    straight = np.polyfit(c.ravel().astype(float), made.reshape(32, -1).T, 1)
    scale, shift = straight
    for off in (scale - 1, shift):
        assert 0.08 < np.abs(off).max() <= 0.1 + 1e-6 and 0.04 < off.std() < 0.08
    line = scale[:, None, None] * c + shift[:, None, None]
    np.testing.assert_allclose(made, line, atol=1e-5)
