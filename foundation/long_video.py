"""Videos longer than the network's 32 frames, as Video Depth Anything treats them (Chen et al. 2025, section
3.3).

Windows of 32 frames start every 22 frames. The first ten of a window are frames seen before: the video's
first one, one 20 frames back, and the last eight of the window before. Each window's depth is brought to the
scale of what went before by scale and shift, and eight frames are cross-faded. Memory does not grow with the
video.
"""

from collections.abc import Iterable, Iterator
from itertools import islice

import numpy as np
from jaxtyping import Float, Float32, Int

WINDOW = 32
STRIDE = 22
KEPT = (0, 12, 24, 25, 26, 27, 28, 29, 30, 31)
"""Positions of a window that the next one sees again, at its positions 0 to 9."""
ANCHORS = (0, 12)
"""Positions of a window that the next one, where they are at positions 0 and 1, is aligned to."""
BLENDED = 8
"""Frames that are cross-faded."""


def window_frames(count: int) -> Int[np.ndarray, f"windows {WINDOW}"]:
    """(windows, 32) which frame of a video of `count` each window sees; its last one fills the end."""
    rows = [np.arange(WINDOW)]
    for start in range(STRIDE, count, STRIDE):
        rows.append(np.concatenate([rows[-1][list(KEPT)], start + np.arange(len(KEPT), WINDOW)]))
    return np.minimum(np.stack(rows), count - 1)


def fit_scale_shift(
    source: Float[np.ndarray, "*any"], target: Float[np.ndarray, "*any"]
) -> tuple[float, float]:
    """(a, b) of least |a source + b - target|^2 over all values; (1, 0) if all of `source` is one value."""
    x, y = source.astype(np.float64).ravel(), target.astype(np.float64).ravel()
    deviation = x - x.mean()
    variance = deviation @ deviation
    if variance == 0:
        return 1.0, 0.0
    scale = float(deviation @ y / variance)
    return scale, float(y.mean() - scale * x.mean())


def stitch(
    windows: Iterable[Float[np.ndarray, f"{WINDOW} H W"]], count: int | None = None
) -> Iterator[Float32[np.ndarray, "H W"]]:
    """Depth of each frame of the video, in order, from the depth of its windows.

    Args:
      windows: (32, H, W) per window, in order, as `window_frames` lays them out.
      count: frames of the video; what the windows hold beyond them is dropped.
    """
    return islice(_stitched(windows), count)


def _stitched(windows: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    anchors = ending = None
    for window in windows:
        if anchors is None or ending is None:
            maps = np.asarray(window, np.float32)
            yield from maps[:-BLENDED]
            anchors = maps[list(ANCHORS)]
        else:
            scale, shift = fit_scale_shift(window[: len(ANCHORS)], anchors)
            maps = np.maximum(np.float32(scale) * window + np.float32(shift), 0)
            share = np.linspace(0, 1, BLENDED, dtype=np.float32)[:, None, None]
            overlap = maps[len(ANCHORS) : len(KEPT)]
            yield from (1 - share) * ending + share * overlap
            yield from maps[len(KEPT) : -BLENDED]
            anchors = np.stack([anchors[0], maps[ANCHORS[1]]])
        ending = maps[-BLENDED:]
    if ending is not None:
        yield from ending
