"""Procedural depth noise: baselines that draw errors from formulas. JAX.

`dextrah`: the model that DextrAH-G trains with (Lum et al. 2024, "DextrAH-G: Pixels-to-Action Dexterous
Arm-Hand Grasping with Geometric Fabrics"; strengths from its published code): correlated noise in disparity,
noise along normals where asked for, pixel dropout, random values, sticks.
`kinect`: the model of Handa et al. 2014 ("A benchmark for RGB-D visual odometry, 3D reconstruction and SLAM",
after Barron and Malik 2013) with the axial noise that Khoshelham and Elberink 2012 measured.
`ellipse_dropout`: elliptic holes anywhere, alone (random erasing, Zhong et al. 2020, by ellipses).
"""

import math
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from ddgrasp.config import DextrahConfig, KinectConfig
from ddgrasp.contract import CameraProfile
from sensors.models.sense import Key, Sense, batched

NEAREST_M = 0.05
"""Noise never brings a surface nearer than this."""
MOST_SHAPES = 4.0
"""Room for this many deviations more sticks or ellipses than are expected in a picture."""
SHORTEST_HALF_AXIS = 1 / 8
"""An ellipse's shortest possible half axis, in parts of the longest."""
_DROPOUT_STREAM, _NORMAL_STREAM = 6, 7
"""Keep ellipses and noise along normals apart from DextrAH-G's other noise of the same key, which is split
into 0 to 5."""


def dextrah(config: DextrahConfig, profile: CameraProfile) -> Sense:
    """DextrAH-G's depth noise. `profile` gives focal length times baseline; strengths in pixels are of the
    picture that is given, whatever its size: in one twice as wide they are half as much depth."""
    return batched(partial(_dextrah_frame, config, profile))


def kinect(config: KinectConfig, profile: CameraProfile) -> Sense:
    """Kinect-style depth noise. `profile` gives focal length times baseline."""
    return batched(partial(_kinect_frame, config, profile.fx_px * profile.baseline_m))


def ellipse_dropout(expected: float, half_axis_px: float) -> Sense:
    """Holes alone, `expected` in a picture: ellipses anywhere, turned anyhow, either half axis drawn from a
    log-uniform distribution between `SHORTEST_HALF_AXIS` of `half_axis_px` and all of it."""

    def drop(key: Array, depth_m: Array, rgb: Array | None) -> Array:
        return drop_ellipses(jax.random.fold_in(key, _DROPOUT_STREAM), depth_m, expected, half_axis_px)

    return batched(drop)


def _dextrah_frame(
    config: DextrahConfig, profile: CameraProfile, key: Array, depth_m: Array, rgb: Array | None
) -> Array:
    shift_key, noise_key, replace_key, value_key, drop_key, stick_key = jax.random.split(key, 6)
    shape = (depth_m.shape[0], depth_m.shape[1])
    shift = config.shift_px * smooth_field(shift_key, (2, *shape), config.correlation_px)
    noise = config.disparity_px * smooth_field(noise_key, shape, config.correlation_px)
    noisy = add_disparity(shifted(depth_m, shift), noise, profile.fx_px * profile.baseline_m)
    if config.normal_m:
        normal_key = jax.random.fold_in(key, _NORMAL_STREAM)
        noisy = along_normals(noisy, config.normal_m * jax.random.normal(normal_key, shape), profile)
    near, far = config.random_near_m, config.random_far_m
    values = jax.random.uniform(value_key, shape, minval=near, maxval=far)
    noisy = jnp.where(jax.random.bernoulli(replace_key, float(config.random_value), shape), values, noisy)
    noisy = jnp.where(jax.random.bernoulli(drop_key, float(config.dropout), shape), 0.0, noisy)
    return draw_sticks(stick_key, noisy, config)


def _kinect_frame(
    config: KinectConfig, fb_px_m: float, key: Array, depth_m: Array, rgb: Array | None
) -> Array:
    shift_key, noise_key = jax.random.split(key)
    shift = config.shift_px * jax.random.normal(shift_key, (2, *depth_m.shape))
    seen = shifted(depth_m, shift)
    noisy = seen + axial_deviation_m(seen, config.axial_per_m) * jax.random.normal(noise_key, depth_m.shape)
    return jnp.where(seen > 0, quantised(jnp.maximum(noisy, NEAREST_M), fb_px_m, config.steps_per_px), 0.0)


# --- the equations ---------------------------------------------------------------------------------


def axial_deviation_m(depth_m: Float[Array, "*shape"], per_m: float) -> Float[Array, "*shape"]:
    """sigma_z = per_m z^2 (Khoshelham and Elberink 2012, eq. 11)."""
    return per_m * depth_m**2


def quantised(depth_m: Float[Array, "*shape"], fb_px_m: float, steps_per_px: float) -> Float[Array, "*shape"]:
    """z = n f B / round(n f B / z), n steps per pixel (Barron and Malik 2013; n f B is their 35130 cm).

    They round x + 1/2, which moves every depth by half a step; here the nearest step is taken.
    """
    scaled = fb_px_m * steps_per_px
    return scaled / jnp.maximum(jnp.round(scaled / jnp.maximum(depth_m, NEAREST_M)), 1.0)


def add_disparity(
    depth_m: Float[Array, "*shape"], noise_px: Float[Array, "*shape"], fb_px_m: float
) -> Float[Array, "*shape"]:
    """z' = f B / (f B / z + noise); 0 stays 0."""
    disparity = fb_px_m / jnp.maximum(depth_m, NEAREST_M) + noise_px
    return jnp.where(depth_m > 0, fb_px_m / jnp.clip(disparity, 1e-3, fb_px_m / NEAREST_M), 0.0)


def along_normals(
    depth_m: Float[Array, "H W"], noise_m: Float[Array, "H W"], profile: CameraProfile
) -> Float[Array, "H W"]:
    """z'(v, u) = z + noise n_z: each pixel's point moved along the normal that it and its neighbours to the
    right and below have. (H, W) each; holes and what is beside one stay.

    After DextrAH-G's published code, whose camera matrix makes what is tilted steeper than it is, and so
    moves it less in depth.
    """
    height, width = depth_m.shape
    u = (jnp.arange(width)[None, :] - profile.cx_px) / profile.fx_px
    v = (jnp.arange(height)[:, None] - profile.cy_px) / profile.fy_px
    point = depth_m[..., None] * jnp.stack(jnp.broadcast_arrays(u, v, 1.0), axis=-1)
    right, below = (jnp.roll(point, -1, axis) - point for axis in (1, 0))
    normal = jnp.cross(right, below)
    share = normal[..., 2] / jnp.maximum(jnp.linalg.norm(normal, axis=-1), 1e-12)
    there = (depth_m > 0) & (jnp.roll(depth_m, -1, 1) > 0) & (jnp.roll(depth_m, -1, 0) > 0)
    inside = (jnp.arange(height)[:, None] < height - 1) & (jnp.arange(width)[None, :] < width - 1)
    moved = jnp.maximum(depth_m + noise_m * share, NEAREST_M)
    return jnp.where(there & inside, moved, depth_m)


def shifted(depth_m: Float[Array, "H W"], shift_px: Float[Array, "2 H W"]) -> Float[Array, "H W"]:
    """z'(v, u) = z(v + s_0, u + s_1) at the nearest pixel: edges become ragged, depths are not mixed.

    depth_m (H, W), shift_px (2, H, W); places outside take the nearest pixel inside.
    """
    height, width = depth_m.shape
    rows = jnp.arange(height)[:, None] + jnp.round(shift_px[0]).astype(int)
    columns = jnp.arange(width)[None, :] + jnp.round(shift_px[1]).astype(int)
    return depth_m[jnp.clip(rows, 0, height - 1), jnp.clip(columns, 0, width - 1)]


def smooth_field(key: Key, shape: tuple[int, ...], correlation_px: float) -> Float[Array, "*lead H W"]:
    """(..., H, W) Gaussian noise of unit variance at every pixel, correlated over `correlation_px`."""
    *lead, height, width = shape
    up, across = (_interpolation(size, correlation_px) for size in (height, width))
    coarse = jax.random.normal(key, (*lead, up.shape[1], across.shape[1]))
    return jnp.einsum("ij,...jk,lk->...il", up, coarse, across)


def _interpolation(size: int, spacing_px: float) -> Array:
    """(size, n) linear interpolation from n knots, rows of unit norm, so that the variance stays one."""
    knots = math.ceil((size - 1) / max(spacing_px, 1.0)) + 1
    place = jnp.arange(size)[:, None] * (knots - 1) / max(size - 1, 1)
    weights = jnp.maximum(1.0 - jnp.abs(place - jnp.arange(knots)[None, :]), 0.0)
    return weights / jnp.linalg.norm(weights, axis=1, keepdims=True)


def draw_sticks(key: Key, depth_m: Float[Array, "H W"], config: DextrahConfig) -> Float[Array, "H W"]:
    """Thin segments of one random depth each over (H, W): every pixel starts one with probability `stick`."""
    most, share = _room(config.stick * depth_m.size)

    def draw(i: Array, picture: Array) -> Array:
        row, column, angle, length, thick, value, there = jax.random.uniform(jax.random.fold_in(key, i), (7,))
        along, across = _from(row, column, 2 * jnp.pi * angle, depth_m.shape)
        half_width = (1.0 + thick * (config.stick_width_px - 1.0)) / 2
        on = (along >= 0) & (along <= length * config.stick_length_px) & (jnp.abs(across) <= half_width)
        depth = config.random_near_m + value * (config.random_far_m - config.random_near_m)
        return jnp.where(on & (there < share), depth, picture)

    return jax.lax.fori_loop(0, most, draw, depth_m)


def drop_ellipses(
    key: Key, depth_m: Float[Array, "H W"], expected: float, half_axis_px: float
) -> Float[Array, "H W"]:
    """(H, W) with elliptic holes: see `ellipse_dropout`."""
    most, share = _room(expected)

    def cut(i: Array, picture: Array) -> Array:
        row, column, angle, one, other, there = jax.random.uniform(jax.random.fold_in(key, i), (6,))
        along, across = _from(row, column, jnp.pi * angle, depth_m.shape)
        half_axes = half_axis_px * SHORTEST_HALF_AXIS ** jnp.stack([one, other])
        inside = (along / half_axes[0]) ** 2 + (across / half_axes[1]) ** 2 <= 1
        return jnp.where(inside & (there < share), 0.0, picture)

    return jax.lax.fori_loop(0, most, cut, depth_m)


def _from(row: Array, column: Array, angle_rad: Array, shape: tuple[int, ...]) -> tuple[Array, Array]:
    """(along, across), each (H, W) in pixels: where every pixel of a picture of that shape lies from the
    place at the shares `row` of its height and `column` of its width, along a direction and across it."""
    height, width = shape
    v = jnp.arange(height)[:, None] + 0.5 - row * height
    u = jnp.arange(width)[None, :] + 0.5 - column * width
    sine, cosine = jnp.sin(angle_rad), jnp.cos(angle_rad)
    return u * cosine + v * sine, v * cosine - u * sine


def _room(expected: float) -> tuple[int, float]:
    """How many shapes to try to draw in a picture and with which probability each, so that on average
    `expected` are."""
    most = math.ceil(expected + MOST_SHAPES * math.sqrt(expected))
    return most, expected / max(most, 1)
