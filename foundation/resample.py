"""Resampling in the conventions the networks were trained with.

Rows and columns are resampled one after the other. Libraries differ in where they sample, in the cubic kernel
and in whether shrinking blurs first, so each convention is written out here: nothing in this file blurs.
"""

from functools import lru_cache

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Float32, Float64

CUBIC_A = -0.75
"""Free parameter of Keys' cubic kernel (Keys 1981, eq. 15), as OpenCV and PyTorch choose it."""
Images = Float[Array, "*b h w c"]
Resized = Float[Array, "*b {size[0]} {size[1]} c"]
"""What functions with an argument `size`, (rows, columns), return."""


def corner_positions(size: int, wanted: int) -> Float64[np.ndarray, " {wanted}"]:
    """Where sample i lies, first and last ones kept: i (size - 1) / (wanted - 1). (wanted,) float64."""
    return np.arange(wanted) * ((size - 1) / max(wanted - 1, 1))


def centre_positions(size: int, wanted: int, offset: float = 0.0) -> Float64[np.ndarray, " {wanted}"]:
    """Where sample i lies between centres: (i + 1/2) size / (wanted + offset) - 1/2. (wanted,) float64."""
    return (np.arange(wanted) + 0.5) * (size / (wanted + offset)) - 0.5


def resize_corners(images: Images, size: tuple[int, int]) -> Resized:
    """Bilinear, corners aligned: (..., h, w, c) -> (..., *size, c)."""
    for axis, wanted in zip((-3, -2), size, strict=True):
        images = _interpolate(images, corner_positions(images.shape[axis], wanted), axis)
    return images


def resize_half_pixel(images: Images, size: tuple[int, int]) -> Resized:
    """Bilinear between pixel centres, edges clamped, without blurring first: (..., h, w, c) -> (..., *size,
    c).
    """
    for axis, wanted in zip((-3, -2), size, strict=True):
        images = _interpolate(images, centre_positions(images.shape[axis], wanted), axis)
    return images


def _interpolate(images: Array, positions: np.ndarray, axis: int) -> Array:
    """Linear between the two neighbours of each position, clamped to the axis."""
    size = images.shape[axis]
    positions = np.clip(positions, 0, size - 1)
    if len(positions) == size and np.array_equal(positions, np.arange(size)):
        return images
    below = np.floor(positions).astype(int)
    share = (positions - below).reshape(-1, *(1,) * (-1 - axis))
    near, far = (jnp.take(images, index, axis) for index in (below, np.minimum(below + 1, size - 1)))
    return near * jnp.asarray(1 - share, images.dtype) + far * jnp.asarray(share, images.dtype)


@lru_cache(maxsize=256)
def cubic_matrix(size: int, wanted: int, offset: float = 0.0) -> Float32[np.ndarray, "{wanted} {size}"]:
    """Bicubic between pixel centres, edges clamped, as a matrix (wanted, size).

    `offset` 0 is OpenCV's INTER_CUBIC; DINOv2's position table wants 0.1.
    """
    positions = centre_positions(size, wanted, offset)
    taps = np.floor(positions)[:, None] + np.arange(-1, 3)
    weights = _keys_kernel(np.abs(positions[:, None] - taps))
    matrix = np.zeros((wanted, size))
    np.add.at(matrix, (np.arange(wanted)[:, None], np.clip(taps, 0, size - 1).astype(int)), weights)
    return matrix.astype(np.float32)


def _keys_kernel(x: np.ndarray) -> np.ndarray:
    """Keys' kernel at distance 0 <= x <= 2 (Keys 1981, eq. 15, with a = CUBIC_A)."""
    near = (CUBIC_A + 2) * x**3 - (CUBIC_A + 3) * x**2 + 1
    far = CUBIC_A * (x**3 - 5 * x**2 + 8 * x - 4)
    return np.where(x <= 1, near, far)


def resize_cubic(images: Images, size: tuple[int, int], offset: float = 0.0) -> Resized:
    """Bicubic, see `cubic_matrix`: (..., h, w, c) -> (..., *size, c)."""
    rows, columns = (
        jnp.asarray(cubic_matrix(images.shape[axis], wanted, offset), images.dtype)
        for axis, wanted in zip((-3, -2), size, strict=True)
    )
    images = jnp.einsum("ip,...pqc->...iqc", rows, images)
    return jnp.einsum("jq,...iqc->...ijc", columns, images)
