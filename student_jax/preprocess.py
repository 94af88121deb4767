"""Raw depth frames to the encoder's picture: clean, crop, resize, subtract the empty table.

Every constant the exported graph needs (crop window, resize matrices, table depth) is computed here in
NumPy, so that training and export share the numbers. Invalid pixels stay invalid, or are filled from around
them (`student.picture.fill_holes`).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32, Int, Int32, Shaped

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from ddgrasp.config import StudentConfig
from ddgrasp.contract import CameraProfile
from ddgrasp.errors import UserError
from mjx_envs.camera import nominal_camera
from mjx_envs.precision import exact

RELIEF_SCALE_M = 0.1
"""One unit of the relief channel: how much nearer than the empty table, along the optical axis."""
RELIEF_MIN, RELIEF_MAX = -1.0, 4.0
SNAP_FRACTION = 0.02
"""A crop this close to the input size is trimmed to it instead of being resampled."""
COVERAGE_MIN = 0.5
"""A resized pixel is valid when at least this share of its footprint is."""


class Axis(NamedTuple):
    """How one image axis goes from the crop window to the encoder's picture."""

    start: int
    """First crop pixel used."""
    length: int
    """Crop pixels used."""
    matrix: Float32[np.ndarray, "out length"] | None
    """Resize matrix; None if the pixels are taken as they are."""


class ResizeWindow(NamedTuple):
    """The pixels of the full frame that the encoder sees, and how they are resized."""

    rows: Axis
    columns: Axis


def resize_matrix(length: int, out: int) -> Float32[np.ndarray, "{out} {length}"]:
    """(out, length) float32: linear resize with a triangle filter widened when shrinking; rows sum to 1.

    Same numbers as `jax.image.resize(..., "linear", antialias=True)`.
    """
    scale = length / out
    support = max(scale, 1.0)
    centres = (np.arange(out) + 0.5) * scale
    distance = np.abs(centres[:, None] - (np.arange(length) + 0.5)[None, :]) / support
    weight = np.maximum(0.0, 1.0 - distance)
    return (weight / weight.sum(axis=1, keepdims=True)).astype(np.float32)


def plan_axis(crop: int, out: int) -> Axis:
    """Trim when the sizes nearly agree (pixels stay sharp), otherwise resize the whole crop."""
    if 0 <= crop - out <= SNAP_FRACTION * crop:
        return Axis((crop - out) // 2, out, None)
    return Axis(0, crop, resize_matrix(crop, out))


def plan_window(profile: CameraProfile, config: StudentConfig) -> ResizeWindow:
    """The window of `profile` that becomes an input of `config`'s size."""
    return ResizeWindow(
        plan_axis(profile.crop_height_px, config.picture.height_px),
        plan_axis(profile.crop_width_px, config.picture.width_px),
    )


def table_depth(profile: CameraProfile, max_depth_m: float) -> Float32[np.ndarray, "H W"]:
    """(H, W) float32 planar depth of the empty table from the nominal camera, at most `max_depth_m`."""
    camera = nominal_camera(profile)
    rotation, height_m = camera.T_world_cam[:3, :3], camera.T_world_cam[2, 3]
    x = (np.arange(profile.width_px) + 0.5 - profile.cx_px) / profile.fx_px
    y = (np.arange(profile.height_px) + 0.5 - profile.cy_px) / profile.fy_px
    fall = -(rotation[2, 0] * x[None, :] + rotation[2, 1] * y[:, None] + rotation[2, 2])
    depth = np.where(fall > 1e-6, height_m / np.maximum(fall, 1e-6), max_depth_m)
    return np.minimum(depth, max_depth_m).astype(np.float32)


def clean_depth(depth_m: Float[AnyArray, "*x"], config: StudentConfig) -> Float32[jax.Array, "*x"]:
    """Non-finite, too near and too far readings become 0 = invalid. Any shape, metres."""
    usable = (depth_m >= config.picture.min_depth_m) & (
        depth_m <= config.picture.max_depth_m
    )  # False for NaN
    return jnp.where(usable, depth_m, 0.0).astype(jnp.float32)


def clip_crop(crop_rc: Int[AnyArray, "B 2"], profile: CameraProfile) -> Int[jax.Array, "B 2"]:
    """(B, 2) crop origins moved to where the whole window fits into the frame."""
    highest = jnp.array(
        [profile.height_px - profile.crop_height_px, profile.width_px - profile.crop_width_px]
    )
    return jnp.clip(crop_rc, 0, highest)


def crop_origin(
    crop_rc: Int[AnyArray, "B 2"] | None, batch: int, profile: CameraProfile
) -> Int32[jax.Array, "{batch} 2"]:
    """(B, 2) int32 crop origins (row, column) in the full frame; None is the centred window."""
    if crop_rc is None:
        return jnp.broadcast_to(jnp.array(profile.crop_origin_px, jnp.int32), (batch, 2))
    return clip_crop(crop_rc, profile).astype(jnp.int32)


def pixel_coordinates(
    window: ResizeWindow, stride: int
) -> tuple[Float32[np.ndarray, " h"], Float32[np.ndarray, " w"]]:
    """Crop pixel coordinates, rows (h,) and columns (w,), of the centres of `stride`-sized input cells."""

    def centres(axis: Axis) -> np.ndarray:
        out = axis.length if axis.matrix is None else axis.matrix.shape[0]
        cells = (np.arange(-(-out // stride)) + 0.5) * stride
        return (axis.start + cells * (axis.length / out)).astype(np.float32)

    return centres(window.rows), centres(window.columns)


def first_pixel(
    crop_rc: Int[AnyArray, "B 2"] | None, profile: CameraProfile, config: StudentConfig
) -> Int[AnyArray, "#B 2"]:
    """(B, 2), or a NumPy constant (1, 2) for the centred window: (row, column) in the full frame of the first
    pixel that the encoder sees."""
    window = plan_window(profile, config)
    starts = np.array([window.rows.start, window.columns.start])
    if crop_rc is None:
        return (profile.crop_origin_px + starts)[None]
    return clip_crop(crop_rc, profile) + starts


def cut(
    frames: Shaped[AnyArray, "#B F H W"], first_px: Int[AnyArray, "#B 2"], size: tuple[int, int]
) -> Shaped[jax.Array, "#B F h w"]:
    """(B, F, *size) of the frames (B or 1, F, H, W), of any type, from the pixel `first_px` on."""
    if isinstance(first_px, np.ndarray) and len(first_px) == 1:  # a slice that is known beforehand
        row, column = first_px[0]
        return jnp.asarray(frames)[..., row : row + size[0], column : column + size[1]]

    def one(stack: AnyArray, first: AnyArray) -> jax.Array:
        return jax.lax.dynamic_slice(stack, (0, first[0], first[1]), (len(stack), *size))

    if len(frames) == 1:
        return jax.vmap(one, (None, 0))(frames[0], first_px)
    return jax.vmap(one)(frames, first_px)


@exact
def prepare_depth(
    depth_m: AnyArray, crop_rc: Int[AnyArray, "B 2"] | None, profile: CameraProfile, config: StudentConfig
) -> Float32[jax.Array, "B h w C"]:
    """Depth frames as the encoder's picture.

    Args:
        depth_m: (B, 3, H, W) planar metres, 0 or non-finite where invalid, oldest frame first; or of that the
            part that the encoder sees, from `cut`.
        crop_rc: (B, 2) integer (row, column) of each sample's crop window, clipped into the frame;
            None takes the centred window (what the exported policy does).
        profile: the camera that took the frames; whole ones must have its H and W.
        config: input size, channels and depth limits.

    Returns:
        (B, h, w, 3 * channels) float32, channels of the oldest frame first. relief is in
        [RELIEF_MIN, RELIEF_MAX] and 0 where invalid; valid is 0 or 1; depth is in metres, 0 where invalid.
        With `fill_holes` all of a frame is valid, unless none of it is.

    Raises UserError for frames of another size, or of whole numbers: millimetres, most likely.
    """
    if depth_m.dtype.kind in "iu":
        raise UserError(f"Depth is {depth_m.dtype}; expected metres (float32).")
    window = plan_window(profile, config)
    expected = (contract.DEPTH_FRAMES, profile.height_px, profile.width_px)
    seen = (contract.DEPTH_FRAMES, window.rows.length, window.columns.length)
    if depth_m.shape[1:] not in (expected, seen):
        wanted = ", ".join(map(str, expected))
        raise UserError(f"Depth has shape {tuple(depth_m.shape)}; expected (B, {wanted}).")
    table = jnp.asarray(table_depth(profile, config.picture.max_depth_m))[None, None]
    first_px = first_pixel(crop_rc, profile, config)
    depth = clean_depth(depth_m if depth_m.shape[1:] == seen else cut(depth_m, first_px, seen[1:]), config)
    valid = (depth > 0).astype(jnp.float32)
    relief = (cut(table, first_px, seen[1:]) - depth) / RELIEF_SCALE_M
    relief, depth, valid = _resize_masked(relief, depth, valid, window, "depth" in config.picture.channels)
    if config.picture.fill_holes:
        relief = filled(relief, valid)
        depth = filled(depth, valid) if "depth" in config.picture.channels else depth
        valid = jnp.broadcast_to(valid.max((2, 3), keepdims=True), valid.shape)
    planes = {"relief": jnp.clip(relief, RELIEF_MIN, RELIEF_MAX) * valid, "valid": valid, "depth": depth}
    stacked = jnp.stack([planes[name] for name in config.picture.channels], axis=-1)  # (B, 3, h, w, C)
    picture = jnp.moveaxis(stacked, 1, 3)
    # Behind a barrier: else a CPU turns the picture around once for each of those that read it.
    return jax.lax.optimization_barrier(picture.reshape(*picture.shape[:3], -1))


def filled(
    plane: Float32[AnyArray, "B F h w"], valid: Float32[AnyArray, "B F h w"]
) -> Float32[jax.Array, "B F h w"]:
    """`plane` where `valid` (0 or 1), elsewhere what is nearest: the mean of the valid among the eight pixels
    beside it, where there are none that of the eight 2x2 blocks beside it, and so on, interpolated linearly
    between blocks (after pull-push, Gortler et al. 1996). 0 if nothing is valid.
    """
    known = jnp.where(valid > 0, plane, 0.0)
    rows, columns = plane.shape[2:]
    if rows % 2 or columns % 2:
        total, count = (x.sum((2, 3), keepdims=True) for x in (known, valid))
        return jnp.where(valid > 0, known, total / jnp.maximum(count, 1.0))
    blocks = (*plane.shape[:2], rows // 2, 2, columns // 2, 2)
    total, count = (x.reshape(blocks).sum((3, 5)) for x in (known, valid))
    coarse = filled(total / jnp.maximum(count, 1.0), (count > 0).astype(jnp.float32))
    along_rows = jnp.einsum("or,bfrc->bfoc", resize_matrix(rows // 2, rows), coarse)
    around = jnp.einsum("pc,bfoc->bfop", resize_matrix(columns // 2, columns), along_rows)
    total, count = _sum_3x3(known), _sum_3x3(valid)
    around = jnp.where(count > 0, total / jnp.maximum(count, 1.0), around)
    return jnp.where(valid > 0, known, around)


def _sum_3x3(x: AnyArray) -> jax.Array:
    """(B, F, h, w) over every pixel and those beside it; there is nothing beyond the border."""
    x = jnp.pad(x, ((0, 0), (0, 0), (1, 1), (1, 1)))
    x = x[:, :, :-2] + x[:, :, 1:-1] + x[:, :, 2:]
    return x[..., :-2] + x[..., 1:-1] + x[..., 2:]


def _resize_masked(
    relief: AnyArray, depth: AnyArray, valid: AnyArray, window: ResizeWindow, need_depth: bool
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """resize(x * valid) / resize(valid): what is invalid never bleeds into what is valid."""

    def resize(image: AnyArray) -> jax.Array:
        if window.rows.matrix is not None:
            image = jnp.einsum("or,bfrc->bfoc", window.rows.matrix, image)
        if window.columns.matrix is not None:
            image = jnp.einsum("pc,bfoc->bfop", window.columns.matrix, image)
        return image

    if window.rows.matrix is None and window.columns.matrix is None:
        return relief * valid, depth, valid
    coverage = resize(valid)
    resized_valid = (coverage >= COVERAGE_MIN).astype(jnp.float32)
    weight = resized_valid / jnp.maximum(coverage, COVERAGE_MIN)
    # COVERAGE_MIN as a bound keeps the quotient finite; below it the weight is 0 anyway.
    resized_depth = resize(depth) * weight if need_depth else depth
    return resize(relief * valid) * weight, resized_depth, resized_valid
