"""Frames that stay on disk: the same batches as from memory, bounded memory, damaged files."""

import dataclasses
import subprocess
import sys
import textwrap
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.config import (
    EncoderConfig,
    HandViewConfig,
    PictureConfig,
    StudentConfig,
    StudentTrainingConfig,
)
from ddgrasp.errors import UserError
from ddgrasp.presets import PRESETS
from demos.spool import Spool
from demos.store import EpisodeStore
from learning.prefetch import AHEAD, Prefetched
from student_jax import device_frames, frames_io, memory, train
from student_jax.data import Window, make_frames
from student_jax.policy import init_params

PROFILE = contract.D455.scaled(0.1)
LENGTHS = (21, 1, 30, 2, 13)
"""Episodes that end within chunks of 16 frames, and cross several."""


def columns(length: int, seed: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    size = (length, PROFILE.height_px, PROFILE.width_px)
    numbers = rng.random((length, 40)).astype(np.float32)
    return {
        "depth_mm": rng.integers(0, 2**16, size, np.uint16),
        "state": numbers[:, :8],
        "action": numbers[:, 8:16],
        "observation": numbers,
        "held": rng.random(length) < 0.5,
    }


def stored(path: Path, compressed: bool) -> list[dict[str, np.ndarray]]:
    store, episodes = EpisodeStore(path, create=True, compressed=compressed), []
    for seed, length in enumerate(LENGTHS):
        episodes.append(columns(length, seed))
        store.append(episodes[-1], {"from_demo": np.bool_(True)})
    return episodes


@pytest.mark.parametrize("compressed", [False, True])
def test_batches_from_disk_are_those_from_memory_to_the_last_bit(tmp_path, compressed):
    episodes = stored(tmp_path / "frames.zarr", compressed)
    names = ("depth_mm", "state", "action", "observation", "held")
    memory = make_frames(*([episode[name] for episode in episodes] for name in names))
    disk = frames_io.load(tmp_path / "frames.zarr")
    config = StudentConfig()
    for step in range(4):
        batches = []
        for frames in (memory, disk):
            rng = np.random.default_rng([7, step])
            index = frames.draw(rng, 64, 0.4)
            batches.append(train.make_batch(frames, index, rng, config, PROFILE))
        for a, b in zip(*map(_leaves, batches), strict=True):
            np.testing.assert_array_equal(a, b)
    whole = np.concatenate([episode["depth_mm"] for episode in episodes])
    for row in (0, 1, 2, 15, 16, 17, 21, 22, 23, 24, 25, 66):
        first = [r for r in (0, 21, 22, 52, 54) if r <= row][-1]
        rows = [max(first, row - back) for back in (2, 1, 0)]
        np.testing.assert_array_equal(disk.depth_stack(np.array([row]))[0], whole[rows])


def _leaves(batch: train.Batch) -> list[np.ndarray]:
    parts = (batch.depth_mm, batch.crop_rc, batch.state, batch.action, *batch.aux)
    return [np.asarray(part) for part in parts]


@pytest.mark.parametrize("damage", ["gone", "short"])
def test_a_chunk_that_is_damaged_is_one_line_with_the_file(tmp_path, damage):
    stored(tmp_path / "frames.zarr", compressed=False)
    chunk = tmp_path / "frames.zarr/data/depth_mm/c/1/0/0"
    whole = chunk.read_bytes()
    chunk.unlink()
    if damage == "short":
        chunk.write_bytes(whole[:100])
    frames = frames_io.load(tmp_path / "frames.zarr")
    frames.depth_stack(np.array([2]))
    with pytest.raises(UserError, match=r"depth_mm/c/1/0/0 cannot be read .*: delete the store"):
        frames.depth_stack(np.array([18]))


def test_a_spool_gives_back_whole_episodes(tmp_path):
    rng = np.random.default_rng(0)
    steps = rng.integers(0, 256, (5, 4, 6, 7, 3), np.uint8)
    spool = Spool(tmp_path)
    for pictures in steps:
        spool.add(pictures)
    assert len(spool) == 5
    for i, length in enumerate((5, 1, 4, 2)):
        np.testing.assert_array_equal(spool.episode(i, length), steps[:length, i])
    assert not list(tmp_path.iterdir())  # the file has no name to be left behind


def test_prefetched_batches_come_in_order_one_at_a_time_and_none_beyond_the_end():
    made, at_once, begun = [], threading.Lock(), {step: threading.Event() for step in range(9)}

    def make(step: int) -> int:
        with at_once_or_fail(at_once):
            begun[step].set()
            time.sleep(0.01)
            made.append(step)
        return 10 * step

    with Prefetched(make, 9) as batches:
        for step in range(3, 9):
            assert batches(step) == 10 * step
            assert step == 8 or begun[step + 1].wait(10.0), "ahead of the step that takes it"
    assert made == [3, 4, 5, 6, 7, 8]


@contextmanager
def at_once_or_fail(lock: threading.Lock):
    assert lock.acquire(blocking=False), "two at once"
    try:
        yield
    finally:
        lock.release()


def test_what_making_a_batch_raises_reaches_the_step_that_wanted_it():
    def make(step: int) -> int:
        if step == 2:
            raise UserError("cannot be read")
        return step

    with Prefetched(make, 9) as batches:
        assert [batches(0), batches(1)] == [0, 1]
        with pytest.raises(UserError, match="cannot be read"):
            batches(2)


def test_memory_does_not_grow_with_the_frames_on_disk(tmp_path):
    """160 MB of frames, drawn from everywhere, in a process that takes less than 80 MB for it."""
    program = f"""
        import resource
        import numpy as np
        from demos.store import EpisodeStore
        from student_jax import frames_io
        store = EpisodeStore({str(tmp_path / "frames.zarr")!r}, create=True, compressed=False)
        for number in range(8):
            depth = np.full((174, 180, 320), number, np.uint16)
            rows = np.zeros((174, 40), np.float32)
            store.append(dict(depth_mm=depth, state=rows[:, :8], action=rows[:, :8], observation=rows,
                              held=np.zeros(174, bool)), dict(from_demo=np.bool_(True)))
        peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        before = peak()
        frames = frames_io.load(store.path)
        rng = np.random.default_rng(0)
        for _ in range(60):
            index = frames.draw(rng, 64, 0.4)
            assert (frames.depth_stack(index)[:, :, 0, 0] == frames.episode[index][:, None]).all()
        print(peak() - before)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(program)], capture_output=True, text=True, check=True
    )
    assert float(done.stdout) < 80


@pytest.mark.parametrize("kept", ["whole", "window"])
@pytest.mark.parametrize("rows", [7, 1000], ids=["parts", "one"])
def test_frames_on_the_device_are_those_on_disk(tmp_path, monkeypatch, kept, rows):
    window = Window.seen(PROFILE, 3) if kept == "window" else None
    store = EpisodeStore(tmp_path / "frames.zarr", create=True, compressed=False)
    for seed, length in enumerate(LENGTHS):
        steps = columns(length, seed)
        cut = steps["depth_mm"] if window is None else window.cut(steps["depth_mm"])
        store.append(steps | {"depth_mm": cut}, {"from_demo": np.bool_(True)})
    height, width = store.reader("depth_mm").shape[1:]
    monkeypatch.setattr(device_frames, "PART_ELEMENTS", rows * height * width)
    monkeypatch.setattr(device_frames, "BLOCK", 5)
    size = 2 * sum(LENGTHS) * height * width
    disk, device = (frames_io.load(store.path, window, room) for room in (size - 1, size))
    assert not isinstance(disk.depth_mm, device_frames.DepthOnDevice)
    assert isinstance(device.depth_mm, device_frames.DepthOnDevice)
    index = np.random.default_rng(0).permutation(sum(LENGTHS))
    seen = device.depth_stack(index)
    assert isinstance(seen, jax.Array) and seen.dtype == jnp.uint16
    np.testing.assert_array_equal(np.asarray(seen), disk.depth_stack(index))


def test_there_is_room_beside_a_training_step_on_an_accelerator_alone(monkeypatch):
    config = PRESETS["debug"]
    assert device_frames.room_bytes(config) == 0
    taken = memory.training_bytes(config) + (AHEAD + 1) * memory.batch_bytes(config) + 7
    device = SimpleNamespace(platform="gpu")
    monkeypatch.setattr(jax, "local_devices", lambda: [device])
    for limit, room in ((taken + 1000, 800), (taken - 1, 0)):
        device.memory_stats = lambda limit=limit: {"bytes_limit": limit, "bytes_in_use": 7}
        assert device_frames.room_bytes(config) == room


def test_what_the_student_cannot_see_is_not_kept_and_changes_nothing(tmp_path):
    """Training steps on frames cut to the window are those on whole frames, to the last bit."""
    shift = 3
    config = StudentConfig(
        picture=PictureConfig(height_px=44, width_px=56),
        encoder=EncoderConfig(width=8, keypoints=4, stage_blocks=(1, 1), features=16),
        training=StudentTrainingConfig(batch_size=4, noise_draws=2, crop_shift_px=shift),
        hand_view=HandViewConfig(size_px=8, width=8, blocks=1, channels=2, features=8),
    )
    window = Window.seen(PROFILE, shift)
    whole = stored(tmp_path / "whole.zarr", compressed=False)
    store = EpisodeStore(tmp_path / "cut.zarr", create=True, compressed=False)
    for episode in whole:
        store.append(episode | {"depth_mm": window.cut(episode["depth_mm"])}, {"from_demo": np.bool_(True)})
    assert store.reader("depth_mm").shape[1:] == window.shape != (PROFILE.height_px, PROFILE.width_px)
    params = init_params(jax.random.key(0), config, PROFILE)
    trained, frozen = train.split(config, params)
    ends = []
    for name in ("whole.zarr", "cut.zarr"):
        frames = frames_io.load(tmp_path / name, window)
        state = train.init_state(config, 3, 0, trained)
        for step in range(3):
            rng = np.random.default_rng([1, step])
            batch = train.make_batch(frames, frames.draw(rng, 4, 0.4), rng, config, PROFILE)
            corner = [(-shift, -shift), (shift, shift), (-shift, shift), (shift, -shift)]
            crops = (np.array(PROFILE.crop_origin_px) + corner).astype(np.int32)
            batch = dataclasses.replace(batch, crop_rc=jnp.asarray(crops))
            state, _ = train.train_step(config, PROFILE, 3, state, frozen, batch)
        ends.append(jax.tree.leaves(state.params))
    for a, b in zip(*ends, strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def test_frames_in_metres_and_rows_that_do_not_fit_are_refused():
    depth, state, action, *others = columns(4, 0).values()
    others = [[rows] for rows in others]
    with pytest.raises(UserError, match=r"Depth is float32; expected millimetres \(uint16\)"):
        make_frames([depth / np.float32(1000)], [state], [action], *others)
    with pytest.raises(UserError, match="Episode 0 has 4 states and 3 other rows"):
        make_frames([depth], [state], [action[:3]], *others)


@pytest.mark.parametrize("made", [np.zeros((4, 6, 8), np.float32), np.zeros((3, 6, 8), np.uint16)])
def test_what_a_depth_source_of_one_s_own_gives_is_looked_at(made):
    with pytest.raises(UserError, match=r"The depth source gave \S+ \(\d, 6, 8\) for uint16 \(4, 6, 8\)"):
        frames_io.checked(made, (4, 6, 8))
