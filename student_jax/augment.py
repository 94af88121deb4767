"""What a camera does to pixels that it does report. Grafting keeps simulated depth there to the last bit.

A student trained on exact surfaces takes every ripple of a far table for an object: in the rig it let go
of what it had lifted, and on ideal depth never. So training ripples them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, Key

from ddgrasp.arrays import AnyArray
from ddgrasp.config import StudentConfig
from ddgrasp.contract import CameraProfile
from mjx_envs.camera import nominal_camera
from student_jax.preprocess import cut, table_depth

CORRELATION_PX = 2
"""Neighbouring pixels share their matching window; the rig's residuals correlate by 0.65 at one pixel."""
EDGE_CELL_PX = 4
"""Beside edges they share more of it: there the rig's residuals correlate by 0.73, 0.48 and 0.23 at one,
two and four pixels."""
EDGE_RELIEF_PX = 1.0
"""Disparities that differ by this within three such cells, other than the table's do, make an edge in full: a
4 cm cube is 1.4 px."""
SPURIOUS_SHARE = 0.002
SPURIOUS_PX = 8.0
"""Largest disparity error of a wrong match, and the share of 2x2 cells that have one."""
_MIN_DISPARITY_PX = 0.5
UNSEEN_RADIUS_M = 0.07
"""What lies within this of the grasp, seen from above, is the object: the hand's width, nearly."""
UNSEEN_ABOVE_M = (0.008, 0.015)
"""And higher than this above the table (a far table ripples by a few millimetres), and lower than twice the
grasp's height and this."""
TABLE_M = 0.03
"""What seems no further than this from the table, beside the object, is the table: the camera does not stand
exactly where it should, and its height here is read off what is seen."""
LYING_M = 0.08
"""A grasp that is lower than this lies on the table."""


def disparity_noise(
    key: Key[jax.Array, ""],
    depth_m: Float[jax.Array, "B F h w"],
    first_px: Int[AnyArray, "#B 2"],
    profile: CameraProfile,
    config: StudentConfig,
) -> Float[jax.Array, "B F h w"]:
    """Depth with correlated disparity noise, with it a few wrong matches, and more of it at edges.

    disparity = f b / depth, so that depth errors grow with the square of depth (Nguyen et al. 2012). Each
    sample draws its own strengths, uniform up to `disparity_noise_px` and `edge_noise_px`; half of the
    variance stays the same in all frames of a stack, as a camera's does.

    Args:
        depth_m: (B, F, h, w) planar metres, 0 = invalid; a part of the frames, or all; what
            lies outside it counts for nothing.
        first_px: (B or 1, 2) where it begins in the full frame, row and column.

    Returns:
        The same shape; invalid pixels stay so.
    """
    batch, frames, height, width = depth_m.shape
    k_strength, k_shared, k_own, k_wrong, k_edges = jax.random.split(key, 5)
    coarse = (batch, frames, _count(height, CORRELATION_PX), _count(width, CORRELATION_PX))
    field = _half_shared(k_shared, k_own, coarse)
    strength = config.training.disparity_noise_px * jax.random.uniform(k_strength, (batch, 1, 1, 1))
    field = strength * field
    if config.training.disparity_noise_px:
        chance = jax.random.uniform(k_wrong, coarse)  # says which cells, and among those uniformly how much
        wrong_px = SPURIOUS_PX * (2.0 * chance / SPURIOUS_SHARE - 1.0)
        field += jnp.where(chance < SPURIOUS_SHARE, wrong_px, 0.0)
    field = _enlarged(field, CORRELATION_PX, first_px, (height, width))
    fb = profile.fx_px * profile.baseline_m
    if config.training.edge_noise_px:
        table_m = cut(table_depth(profile, config.picture.max_depth_m)[None, None], first_px, (height, width))
        above_px = fb / jnp.maximum(depth_m, 1e-3) - fb / table_m
        field += _edge_noise(k_edges, above_px, depth_m > 0, first_px, config)
    # fb / (fb / depth + field), with one division and 0 where depth is 0.
    return depth_m * fb / jnp.maximum(fb + depth_m * field, depth_m * _MIN_DISPARITY_PX)


def _edge_noise(
    key: Key[jax.Array, ""],
    above_px: Float[jax.Array, "B F H W"],
    valid: Bool[jax.Array, "B F H W"],
    first_px: Int[AnyArray, "#B 2"],
    config: StudentConfig,
) -> Float[jax.Array, "B F H W"]:
    """Disparity errors at edges, one a cell of EDGE_CELL_PX, half of it the same in all frames.

    Args:
        above_px: disparity, less the empty table's.
    """
    _, _, height, width = above_px.shape
    highest, lowest = (
        _around(_cells(jnp.where(valid, sign * above_px, -jnp.inf), first_px)) for sign in (1.0, -1.0)
    )
    edge = jnp.clip((highest + lowest) / EDGE_RELIEF_PX, 0.0, 1.0)  # a sum: each is of its own sign
    k_strength, k_shared, k_own = jax.random.split(key, 3)
    noise = _half_shared(k_shared, k_own, edge.shape)
    strength = config.training.edge_noise_px * jax.random.uniform(k_strength, (len(valid), 1, 1, 1))
    return _enlarged(strength * edge * noise, EDGE_CELL_PX, first_px, (height, width))


def _half_shared(
    k_shared: Key[jax.Array, ""], k_own: Key[jax.Array, ""], shape: tuple[int, ...]
) -> Float[jax.Array, "B F h w"]:
    """Standard normal numbers, half of their variance the same in all frames of a stack."""
    shared = jax.random.normal(k_shared, (shape[0], 1, *shape[2:]))
    return (shared + jax.random.normal(k_own, shape)) / jnp.sqrt(2.0)


def _count(length: int, cell_px: int) -> int:
    """Cells that so many pixels touch, wherever they begin."""
    return -(-(length + cell_px - 1) // cell_px)


def _cells(
    values: Float[jax.Array, "B F H W"], first_px: Int[AnyArray, "#B 2"]
) -> Float[jax.Array, "B F h w"]:
    """The largest value of each cell of EDGE_CELL_PX; cells begin where the full frame's do."""
    size, before = (1, 1, EDGE_CELL_PX, EDGE_CELL_PX), EDGE_CELL_PX - 1
    rows, columns = (EDGE_CELL_PX * _count(length, EDGE_CELL_PX) for length in values.shape[2:])
    rest = ((0, 0), (0, 0), (before, rows - values.shape[2]), (before, columns - values.shape[3]))
    padded = jnp.pad(values, rest, constant_values=-jnp.inf)
    values = cut(padded, before - first_px % EDGE_CELL_PX, (rows, columns))
    return jax.lax.reduce_window(values, -jnp.inf, jax.lax.max, size, size, "VALID")


def _around(cells: Float[jax.Array, "B F h w"]) -> Float[jax.Array, "B F h w"]:
    """The largest of a cell and those beside it."""
    return jax.lax.reduce_window(cells, -jnp.inf, jax.lax.max, (1, 1, 3, 3), (1, 1, 1, 1), "SAME")


def _enlarged(
    cells: Float[jax.Array, "B F h w"], cell_px: int, first_px: Int[AnyArray, "#B 2"], size: tuple[int, int]
) -> Float[jax.Array, "B F H W"]:
    """(B, F, *size): a value for every pixel of a cell. Cells begin where the full frame's do: with the part
    that the encoder sees, its patches would always have whole ones."""
    return cut(jnp.repeat(jnp.repeat(cells, cell_px, axis=2), cell_px, axis=3), first_px % cell_px, size)


def unseen_objects(
    key: Key[jax.Array, ""],
    depth_m: Float[jax.Array, "B F h w"],
    first_px: Int[AnyArray, "#B 2"],
    grasp_m: Float[jax.Array, "B 3"],
    profile: CameraProfile,
    config: StudentConfig,
) -> Float[jax.Array, "B F h w"]:
    """Depth in which a share of the objects that lie on the table is a hole in every frame.

    A stereo camera finds nothing on what is dark or thin (the rig's tyre, a starfruit): the hole is all there
    is to see of it. Parts of a hand that is about to grasp go too.

    Args:
        depth_m: (B, F, h, w) planar metres, 0 = invalid; a part of the frames, or all; what
            lies outside it counts for nothing.
        first_px: (B or 1, 2) where it begins in the full frame, row and column.
        grasp_m: (B, 3) where to grasp, world frame.
    """
    chosen = jax.random.bernoulli(key, config.training.unseen_share, depth_m.shape[:1])
    chosen &= grasp_m[:, 2] < LYING_M
    hole = _grown(_of_object(depth_m, first_px, grasp_m, profile)) & chosen[:, None, None, None]
    return jnp.where(hole, 0.0, depth_m)


def _of_object(
    depth_m: Float[jax.Array, "B F h w"],
    first_px: Int[AnyArray, "#B 2"],
    grasp_m: Float[jax.Array, "B 3"],
    profile: CameraProfile,
) -> Bool[jax.Array, "B F h w"]:
    camera = nominal_camera(profile)
    x = (np.arange(profile.width_px) + 0.5 - profile.cx_px) / profile.fx_px
    y = (np.arange(profile.height_px) + 0.5 - profile.cy_px) / profile.fy_px
    ray = np.stack([*np.broadcast_arrays(x[None, :], y[:, None]), np.ones((len(y), len(x)))])
    ray = np.tensordot(camera.T_world_cam[:3, :3], ray, 1).astype(np.float32)[None]
    ray = cut(ray, first_px, (depth_m.shape[2], depth_m.shape[3]))[:, :, None]
    start = np.asarray(camera.T_world_cam[:3, 3], np.float32)
    grasp = grasp_m[:, None, None, None, :]
    away = [start[i] + depth_m * ray[:, i] - grasp[..., i] for i in range(2)]
    height = start[2] + depth_m * ray[:, 2]
    low, above = UNSEEN_ABOVE_M
    square = away[0] ** 2 + away[1] ** 2
    around = (square > UNSEEN_RADIUS_M**2) & (square < (2 * UNSEEN_RADIUS_M) ** 2)
    table = around & (depth_m > 0) & (jnp.abs(height) < TABLE_M)
    count = jnp.maximum(table.sum((2, 3), keepdims=True), 1)
    height = height - jnp.where(table, height, 0.0).sum((2, 3), keepdims=True) / count
    within = (depth_m > 0) & (square < UNSEEN_RADIUS_M**2)
    return within & (height > low) & (height < 2 * grasp[..., 2] + above)


def _grown(mask: Bool[jax.Array, "B F H W"]) -> Bool[jax.Array, "B F H W"]:
    """By a pixel each way: a hole takes the object's edge with it."""
    return jax.lax.reduce_window(mask, False, jax.lax.bitwise_or, (1, 1, 3, 3), (1, 1, 1, 1), "SAME")
