"""What recordings show of their scenes: the surface that errors are counted from, and the prior."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float, Float32

from ddg_jax.piecewise import piecewise_smooth
from ddg_jax.prior import Prior
from ddgrasp.config import PIECEWISE, PLANES, SURFACES
from ddgrasp.depth import inverse_depth
from ddgrasp.errors import UserError, unknown_name
from ddgrasp.progress import Progress
from ddgrasp.workers import spread, worth
from sensors.statistics.holes import fill_from_background, smooth_surface
from sensors.statistics.planes import on_planes

FRAMES_A_PROCESS = 500
"""So many are worth a process: with planes, they take five times as long as it takes to begin."""


@dataclass
class UsableFrames:
    """The usable frames of a recording."""

    number: int
    depth_m: Float32[np.ndarray, "T H W"]
    rgb: Sequence[np.ndarray] | None
    """(T of (h, w, 3)) if the prior wants it."""
    consecutive: bool
    sensor: str
    left_out: int
    """Frames of it that cannot be used."""
    first: int = 0
    """Where they begin among all recordings'."""

    @property
    def rows(self) -> slice:
        """Where they are among all recordings'."""
        return slice(self.first, self.first + len(self.depth_m))


def understand(
    read: Sequence[UsableFrames], noisy_m: np.ndarray, kind: str, prior: Prior, seed: int, progress: Progress
) -> tuple[np.ndarray, np.ndarray, list[tuple[int, UserError]]]:
    """Surface and prior of all frames, on all cores where that is worth it and neither is a program of JAX's;
    recordings that the prior refuses, by number."""
    shape = noisy_m.shape if len(read) > 1 else (0, 0, 0)  # one recording's are taken as they come
    surface, c = np.empty(shape, np.float32), np.empty(shape, np.float16)
    useless = []
    in_jax = prior.needs_rgb or kind == PIECEWISE
    workers = 0 if in_jax else worth(len(noisy_m) // FRAMES_A_PROCESS, len(read))
    by_number = {r.number: r for r in read}
    with progress.task("surfaces and priors", len(noisy_m)) as task:
        here = None if workers else task.advance  # other processes tell of whole recordings
        for number, made in spread(partial(_Geometer, kind, prior, seed, here), read, workers):
            rows = by_number[number].rows
            if isinstance(made, UserError):
                useless.append((number, made))
                if len(read) > 1:
                    progress.note(f"left out: {made}")
            elif len(read) == 1:
                surface, c = made
            else:
                surface[rows], c[rows] = made
            if workers or isinstance(made, UserError):  # of those that are refused no frame was told
                task.advance(len(by_number[number].depth_m))
    return surface, c, useless


class _Geometer:
    """Makes surfaces and priors of recordings."""

    def __init__(self, kind: str, prior: Prior, seed: int, advance: Callable[[], None] | None):
        self._kind, self._prior, self._seed, self._advance = kind, prior, seed, advance

    def run(self, read: UsableFrames) -> tuple[int, tuple[np.ndarray, np.ndarray] | UserError]:
        """Its number and (T, H, W) surface in metres and prior in float16, or why it cannot be used."""
        rng = np.random.default_rng((self._seed, read.number))
        try:
            c = self._prior.from_recording(read.depth_m, read.rgb, rng, read.consecutive)
        except UserError as error:
            return read.number, error
        return read.number, (surfaces(read.depth_m, self._kind, self._advance), c.astype(np.float16))

    def close(self) -> None:
        """See `ddgrasp.workers.Worker`."""


def surfaces(
    depth_m: Float[np.ndarray, "N H W"], kind: str, advance: Callable[[], None] | None = None
) -> Float[np.ndarray, "N H W"]:
    """Recorded depth (N, H, W) metres -> the same with holes filled and noise smoothed away, frame by frame,
    each told by `advance`; `kind` as in `ddg.depth.surface`. UserError for another one, or no metres.
    """
    if kind not in SURFACES:
        raise unknown_name("surface", kind, SURFACES)
    if depth_m.ndim != 3 or depth_m.dtype.kind != "f":
        raise UserError(f"Depth is {depth_m.dtype} {depth_m.shape}; expected metres (N, H, W), float32.")
    made = np.empty(depth_m.shape, np.float32)  # a list of them would take as much again
    for i, frame in enumerate(depth_m):
        if kind == PIECEWISE:
            smooth = piecewise_smooth(inverse_depth(frame))
        else:
            smooth = smooth_surface(fill_from_background(inverse_depth(frame)))
        made[i] = inverse_depth(on_planes(smooth) if kind == PLANES else smooth)
        if advance is not None:
            advance()
    return made
