"""Resampling as matrices, in the conventions the networks were trained with.

Rows and columns are resampled independently: resized = R image C^T, with R of shape (out, in). Libraries
differ in where they sample, in the cubic kernel and in whether shrinking blurs first, so each convention is
written out here: nothing in this file blurs.
"""

from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

CUBIC_A = -0.75
"""Free parameter of Keys' cubic kernel (Keys 1981, eq. 15), as OpenCV and PyTorch choose it."""


def _from_taps(positions: np.ndarray, offsets: np.ndarray, weights: np.ndarray, size: int) -> np.ndarray:
    """(out, size) matrix: row i adds weights[i, k] at column floor(positions[i]) + offsets[k], clamped."""
    matrix = np.zeros((len(positions), size))
    columns = np.clip(np.floor(positions).astype(int)[:, None] + offsets, 0, size - 1)
    np.add.at(matrix, (np.arange(len(positions))[:, None], columns), weights)
    return matrix.astype(np.float32)


def _bilinear(positions: np.ndarray, size: int) -> np.ndarray:
    fraction = positions - np.floor(positions)
    return _from_taps(positions, np.arange(2), np.stack([1 - fraction, fraction], 1), size)


@lru_cache(maxsize=256)
def corner_matrix(size: int, wanted: int) -> np.ndarray:
    """Bilinear with first and last samples aligned: row i samples i (size - 1) / (wanted - 1). (wanted,
    size).
    """
    positions = np.arange(wanted) * ((size - 1) / (wanted - 1)) if wanted > 1 else np.zeros(1)
    return _bilinear(positions, size)


@lru_cache(maxsize=256)
def half_pixel_matrix(size: int, wanted: int) -> np.ndarray:
    """Bilinear between centres: row i samples (i + 1/2) size / wanted - 1/2, clamped. (wanted, size)."""
    positions = np.maximum((np.arange(wanted) + 0.5) * (size / wanted) - 0.5, 0)
    return _bilinear(positions, size)


@lru_cache(maxsize=256)
def cubic_matrix(size: int, wanted: int, offset: float = 0.0) -> np.ndarray:
    """Bicubic between pixel centres, edges clamped: row i samples (i + 1/2) size / (wanted + offset) - 1/2.

    Returns (wanted, size). `offset` 0 is OpenCV's INTER_CUBIC; DINOv2's position table wants 0.1.
    """
    positions = (np.arange(wanted) + 0.5) * (size / (wanted + offset)) - 0.5
    offsets = np.arange(-1, 3)
    distance = np.abs(positions[:, None] - np.floor(positions)[:, None] - offsets)
    return _from_taps(positions, offsets, _keys_kernel(distance), size)


def _keys_kernel(x: np.ndarray) -> np.ndarray:
    """Keys' kernel at distance |x| <= 2 (Keys 1981, eq. 15, with a = CUBIC_A)."""
    near = (CUBIC_A + 2) * x**3 - (CUBIC_A + 3) * x**2 + 1
    far = CUBIC_A * (x**3 - 5 * x**2 + 8 * x - 4)
    return np.where(x <= 1, near, far)


def resize(images: jax.Array, rows: np.ndarray, columns: np.ndarray) -> jax.Array:
    """(..., h, w, c) -> (..., H, W, c), R = `rows` (H, h), C = `columns` (W, w), in the images' dtype."""
    if rows.shape[0] != rows.shape[1] or not np.array_equal(rows, np.eye(len(rows))):
        images = jnp.einsum("ip,...pqc->...iqc", jnp.asarray(rows, images.dtype), images)
    if columns.shape[0] != columns.shape[1] or not np.array_equal(columns, np.eye(len(columns))):
        images = jnp.einsum("jq,...iqc->...ijc", jnp.asarray(columns, images.dtype), images)
    return images


def resize_corners(images: jax.Array, size: tuple[int, int]) -> jax.Array:
    """Bilinear, corners aligned: (..., h, w, c) -> (..., *size, c)."""
    return resize(images, corner_matrix(images.shape[-3], size[0]), corner_matrix(images.shape[-2], size[1]))


def resize_half_pixel(images: jax.Array, size: tuple[int, int]) -> jax.Array:
    """Bilinear between pixel centres, without blurring first: (..., h, w, c) -> (..., *size, c)."""
    return resize(
        images, half_pixel_matrix(images.shape[-3], size[0]), half_pixel_matrix(images.shape[-2], size[1])
    )


def resize_cubic(images: jax.Array, size: tuple[int, int]) -> jax.Array:
    """Bicubic between pixel centres, OpenCV's INTER_CUBIC: (..., h, w, c) -> (..., *size, c)."""
    return resize(images, cubic_matrix(images.shape[-3], size[0]), cubic_matrix(images.shape[-2], size[1]))
