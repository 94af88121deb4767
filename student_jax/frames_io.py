"""Demos and DAgger episodes as the student sees them, on disk, so that a resumed stage finds them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, UInt16

from ddg_jax.generate import Clip
from ddgrasp.config import Config
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from demos.rollout import Episodes
from demos.spool import Spool
from demos.store import EpisodeStore
from mjx_envs.views import Views, observed
from student_jax.data import LEAD_IN, DepthInWindow, Frames, Window, make_frames
from student_jax.depth_source import VIEWED, DepthSource
from student_jax.device_frames import DepthOnDevice

_COLUMNS = ("state", "action", "observation", "held")
_DRAWN = "drawn"
_STRETCH_SEED = 47_000


def add_noisy_demos(
    demos: EpisodeStore, frames: EpisodeStore, source: DepthSource, config: Config, progress: Progress,
    window: Window | None = None,
) -> None:  # fmt: skip
    """Copies the demos into `frames` with the source's artefacts on their depth, going on from what is there.

    A share of `config.student.training.clean_share` keeps clean depth. Steps long after the grasp are no
    samples, nor those beside a demo's stretch if one is configured; of them are kept what samples need, as
    pictures before and, without a picture, as actions after them. What lies outside of the `window` is left
    out if one is given. The demos must have what the source needs (`depth_source.check_demos`).
    """
    training = config.student.training
    begins = [0, *demos.ends.tolist()]
    useful = [
        useful_steps(held, training.demo_held_steps) for held in np.split(demos.steps("held"), begins[1:-1])
    ]
    stretches = [stretch(n, training.demo_stretch_steps, (config.seed, i)) for i, n in enumerate(useful)]
    pictured = [range(max(0, steps.start - LEAD_IN), steps.stop) for steps in stretches]
    keep_clean = np.random.default_rng(config.seed).random(len(demos)) < training.clean_share
    chosen = np.flatnonzero(~keep_clean)

    def rows_of(i: int, behind: int = 0) -> tuple[int, int]:
        stop = min(begins[i] + pictured[i].stop + behind, begins[i + 1])
        return begins[i] + pictured[i].start, stop

    def read(i: int) -> Clip:
        rows = rows_of(chosen[i])
        rgb = demos.steps("rgb", *rows) if source.needs_rgb else None
        views = _views(demos, chosen[i], rows) if source.needs_views else None
        return Clip(int(chosen[i]), demos.steps("depth_mm", *rows), rgb, views)

    size_px = demos.reader("depth_mm").shape[1:]
    done = int(np.sum(~keep_clean[: len(frames)]))
    noisy = source.episodes([len(pictured[i]) for i in chosen], read, done)
    with progress.task("artefacts on the demos", len(demos)) as task:
        task.start_at(len(frames))
        for i in range(len(frames), len(demos)):
            rows = rows_of(i, behind=config.student.head.chunk - 1)
            steps = {name: demos.steps(name, *rows) for name in _COLUMNS}
            number = np.arange(pictured[i].start, pictured[i].start + rows[1] - rows[0])
            steps[_DRAWN] = (number >= stretches[i].start) & (number < stretches[i].stop)
            if keep_clean[i]:
                depth = demos.steps("depth_mm", *rows_of(i))
            else:
                depth = checked(next(noisy, None), (len(pictured[i]), *size_px))
            depth = depth if window is None else window.cut(depth)
            unseen = np.zeros((len(number) - len(depth), *depth.shape[1:]), depth.dtype)
            steps["depth_mm"] = np.concatenate([depth, unseen])
            frames.append(steps, {"from_demo": np.bool_(True)})
            task.advance()


def checked(
    noisy_mm: UInt16[np.ndarray, "T H W"] | None, shape: tuple[int, ...]
) -> UInt16[np.ndarray, "T H W"]:
    """What a depth source gave for frames of that shape, None where it gave nothing. Raises UserError unless
    it is as many, as large, and in uint16 millimetres: a source may be somebody's own."""
    if noisy_mm is None:
        raise UserError("The depth source gave fewer episodes than it was asked for.")
    if noisy_mm.dtype != np.uint16 or noisy_mm.shape != shape:
        raise UserError(
            f"The depth source gave {noisy_mm.dtype} {noisy_mm.shape} for uint16 {shape}: expected as many "
            "frames, as large, in millimetres."
        )
    return noisy_mm


def _views(demos: EpisodeStore, number: int, rows: tuple[int, int]) -> Views:
    """What `rows` of demo `number` show."""
    observation = demos.steps("observation", *rows)
    fixed = (np.repeat(demos.episodes(name)[[number]], len(observation), axis=0) for name in VIEWED)
    return observed(observation, *fixed)


def demos_with_errors(demos: EpisodeStore, source: DepthSource, chosen: Sequence[int]) -> Iterator[Frames]:
    """Some demos as a student sees them, by their numbers: an episode each, whole, the source's artefacts
    on all of their depth. They must have what the source needs (`depth_source.check_demos`)."""
    begins = [0, *demos.ends.tolist()]
    rows = [(begins[number], begins[number + 1]) for number in chosen]

    def read(i: int) -> Clip:
        rgb = demos.steps("rgb", *rows[i]) if source.needs_rgb else None
        views = _views(demos, chosen[i], rows[i]) if source.needs_views else None
        return Clip(chosen[i], demos.steps("depth_mm", *rows[i]), rgb, views)

    seen = source.episodes([stop - start for start, stop in rows], read)
    for place, depth_mm in zip(rows, seen, strict=True):
        columns = (demos.steps(name, *place) for name in _COLUMNS)
        yield make_frames([depth_mm], *([column] for column in columns))


def useful_steps(held: Bool[np.ndarray, " T"], held_steps: int) -> int:
    """Number of an episode's first steps up to `held_steps` with the object in the hand, at least one."""
    enough = np.flatnonzero(np.cumsum(held) >= max(1, held_steps))
    return max(1, int(enough[0]) + (held_steps > 0)) if len(enough) else len(held)


def stretch(useful: int, steps: int, seed: Sequence[int]) -> range:
    """The samples among a demo's `useful` first steps: `steps` in a row from a random one on; all for 0."""
    if not 0 < steps < useful:
        return range(useful)
    first = int(np.random.default_rng([*seed, _STRETCH_SEED]).integers(useful - steps + 1))
    return range(first, first + steps)


def add_rollouts(frames: EpisodeStore, episodes: Episodes, seen: Spool, window: Window) -> None:
    """Adds DAgger episodes with the depth that the student saw in `window`."""
    for i, length in enumerate(episodes.length):
        n = min(int(length), len(seen))
        frames.append(
            {
                "depth_mm": window.cut(seen.episode(i, n)),
                "state": episodes.state[i, :n].astype(np.float32),
                "action": episodes.action[i, :n].astype(np.float32),
                "observation": episodes.observation[i, :n].astype(np.float32),
                "held": episodes.held[i, :n],
                _DRAWN: np.ones(n, bool),
            },
            {"from_demo": np.bool_(False)},
        )


def load(path: Path, window: Window | None = None, room_bytes: int = 0) -> Frames:
    """All episodes of a frame store; depth stays on disk, unless `room_bytes` of the device can take it.

    `window`: the one that was kept, if any was.
    """
    store = EpisodeStore(path)
    bounds = store.ends[:-1]
    columns = (np.split(store.steps(name), bounds) for name in _COLUMNS)
    depth, count = store.reader("depth_mm"), int(store.ends[-1])
    kept = window if window is not None and depth.shape[1:] == window.shape else None
    if 2 * count * math.prod(depth.shape[1:]) <= room_bytes:
        depth = DepthOnDevice(depth, count, kept)
    elif kept is not None:
        depth = DepthInWindow(depth, kept)
    frames = replace(make_frames([], *columns), depth_mm=depth)
    return replace(frames, drawn=store.steps(_DRAWN)) if _DRAWN in store.fields else frames
