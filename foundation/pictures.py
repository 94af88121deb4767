"""What pictures go through before a network: its input size, resampling, standardisation."""

import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float32, Shaped, UInt8

from ddgrasp.arrays import AnyArray
from ddgrasp.errors import UserError
from foundation.resample import resize_cubic
from foundation.sizes import PATCH_PX

IMAGENET_MEAN = (0.485, 0.456, 0.406)
"""Mean of RGB in [0, 1]."""
IMAGENET_STD = (0.229, 0.224, 0.225)
INPUT_SIZE = 518
"""The depth networks' training size."""
WIDEST = 1.78
"""Side ratio beyond which the video network takes a smaller picture."""
WIDE_SIDES = 1.777
"""The ratio whose area it keeps."""


def in_batches(
    function: Callable[[np.ndarray], AnyArray],
    rows: Shaped[np.ndarray, "N ..."] | Sequence[np.ndarray],
    size: int,
) -> Shaped[np.ndarray, "N ..."]:
    """`function` of all N `rows`, of which it is given `size` at once: one shape, compiled once.

    Where too few are left, the last one is repeated; what its copies give is dropped.
    """
    parts = (np.asarray(rows[at : at + size]) for at in range(0, len(rows), size))
    filled = (np.concatenate([part, np.repeat(part[-1:], size - len(part), 0)]) for part in parts)
    return np.concatenate([np.asarray(function(part)) for part in filled])[: len(rows)]


def network_size(height: int, width: int, input_size: int = INPUT_SIZE, *, video: bool) -> tuple[int, int]:
    """(rows, columns) at which a network sees pictures of height x width: multiples of 14.

    The shorter side becomes `input_size`, the longer one keeps the ratio to the nearest multiple. The video
    network shrinks the input size of very wide or tall pictures first.
    """
    if min(height, width, input_size) < 1:
        raise UserError(
            f"A picture of {height} x {width} at input size {input_size}: expected positive sides."
        )
    ratio = max(height, width) / min(height, width)
    if video and ratio > WIDEST:
        input_size = max(PATCH_PX, round(int(input_size * WIDE_SIDES / ratio) / PATCH_PX) * PATCH_PX)
    scale = max(input_size / height, input_size / width)

    def side(pixels: int) -> int:
        patches = scale * pixels / PATCH_PX
        nearest = round(patches) * PATCH_PX
        return nearest if nearest >= input_size else math.ceil(patches) * PATCH_PX

    return side(height), side(width)


def standardise(
    rgb: UInt8[AnyArray, "*batch H W 3"], size: tuple[int, int] | None = None
) -> Float32[jax.Array, "*batch rows columns 3"]:
    """(..., H, W, 3) uint8 -> float32 of ImageNet's mean 0 and deviation 1, resized bicubically to `size`
    (which takes pictures with one leading axis alone)."""
    x = jnp.asarray(rgb, jnp.float32) / 255
    if size is not None:
        with jax.default_matmul_precision("highest"):
            x = resize_cubic(x, size)
    return (x - np.asarray(IMAGENET_MEAN, np.float32)) / np.asarray(IMAGENET_STD, np.float32)
