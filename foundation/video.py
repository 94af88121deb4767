"""Depth of videos of any length, frame by frame, in memory that does not grow with them.

At most 32 pictures and their depth are held. Windows share ten frames (foundation/long_video.py), and what
the encoder made of those is kept, so that every frame is encoded once.
"""

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, UInt8

from foundation.depth import DepthNetwork, Taps, decode_at, encode_rgb
from foundation.long_video import KEPT, STRIDE, WINDOW, stitch
from foundation.pictures import INPUT_SIZE

_encode = jax.jit(encode_rgb, static_argnums=(0, 3))
_decode = jax.jit(decode_at, static_argnums=(0, 3, 4))


def stream(
    network: DepthNetwork,
    params: dict[str, Any],
    frames: Iterable[UInt8[np.ndarray, "H W 3"]],
    input_size: int = INPUT_SIZE,
) -> Iterator[Float32[np.ndarray, "H W"]]:
    """Depth of each frame of a video, in order, while the video is being read.

    Args:
      frames: (H, W, 3) uint8 RGB, all of one size; at most 32 are read ahead of the depth that is given out.

    Yields (H, W) float32: relative inverse depth on the scale of the first window.
    """
    read = 0

    def windows() -> Iterator[np.ndarray]:
        nonlocal read
        kept: Taps | None = None
        for pictures, so_far in _new_frames(iter(frames)):
            read = so_far
            taps = _encode(network, params, pictures, input_size)
            if kept is not None:
                taps = tuple(jnp.concatenate(pair) for pair in zip(kept, taps, strict=True))
            depth = np.asarray(_decode(network, params, taps, WINDOW, pictures.shape[1:3]))
            kept = tuple(tap[jnp.asarray(KEPT)] for tap in taps)
            yield depth

    for index, depth in enumerate(stitch(windows())):
        if index == read:  # behind here the last frame was repeated to fill its window
            return
        yield depth


def _new_frames(frames: Iterator[np.ndarray]) -> Iterator[tuple[np.ndarray, int]]:
    """(pictures that each window sees for the first time, frames of the video so far), windows in order.

    32 pictures for the first window, 22 for the others; the video's last one is repeated where it ends.
    """
    start, wanted, read = 0, WINDOW, 0
    last: list[np.ndarray] = []
    while True:
        new = list(islice(frames, wanted))
        read += len(new)
        if start >= read:
            return
        last = new[-1:] or last
        yield np.stack(new + last * (wanted - len(new))), read
        start, wanted = start + STRIDE, STRIDE
