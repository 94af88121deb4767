"""ResNet-18 over the depth picture, ending in a vector that knows where things are in the robot's frame.

ResNet: He et al., 2016 (basic blocks). Spatial softmax: Levine et al., 2016, eq. 2; here every keypoint also
carries the relief it sees, and from both its position in the world.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Float, Float32, Int

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from ddgrasp.config import GROUP_CHANNELS, STEM_STRIDE, StudentConfig
from ddgrasp.contract import CameraProfile
from learning.layers import resnet_max_pool, space_to_depth
from mjx_envs.camera import nominal_camera
from mjx_envs.precision import exact
from student_jax import preprocess

EPSILON = 1e-5
POSITION_SCALE_M = 0.2
"""Metres per unit for positions inside the network, measured from POSITION_CENTER_M."""
POSITION_CENTER_M = (*contract.WORKSPACE_CENTER_M, 0.0)


def stage_plan(config: StudentConfig) -> list[tuple[int, int]]:
    """(channels, stride) of the first block of each stage; the stride stops at `output_stride`."""
    plan, total = [], STEM_STRIDE
    for index in range(len(config.encoder.stage_blocks)):
        stride = 2 if index > 0 and total * 2 <= config.encoder.output_stride else 1
        total *= stride
        plan.append((min(config.encoder.width * 2**index, config.encoder.max_channels), stride))
    return plan


def map_stride(config: StudentConfig) -> int:
    """Input pixels per cell of the last feature map."""
    return STEM_STRIDE * int(np.prod([stride for _, stride in stage_plan(config)]))


class GroupNorm(nn.Module):
    """GroupNorm over (h, w, GROUP_CHANNELS channels): two reductions, five times flax's speed on CPU."""

    @nn.compact
    def __call__(self, x: Float[AnyArray, "B h w C"]) -> Float[jax.Array, "B h w C"]:
        """(B, h, w, C) -> same."""
        batch, _, _, channels = x.shape
        groups = channels // GROUP_CHANNELS
        mean = x.mean((1, 2)).reshape(batch, groups, -1).mean(-1)
        square = (x * x).mean((1, 2)).reshape(batch, groups, -1).mean(-1)
        inverse = jax.lax.rsqrt(jnp.maximum(square - mean * mean, 0.0) + EPSILON)
        scale = self.param("scale", nn.initializers.ones, (channels,))
        bias = self.param("bias", nn.initializers.zeros, (channels,))
        gain = jnp.repeat(inverse, GROUP_CHANNELS, axis=1) * scale
        offset = bias - jnp.repeat(mean, GROUP_CHANNELS, axis=1) * gain
        return x * gain[:, None, None, :] + offset[:, None, None, :]


class ConvNorm(nn.Module):
    """Convolution with PyTorch's symmetric padding, then the norm. A bias only where no norm follows."""

    channels: int
    kernel: int
    stride: int
    norm: str

    @nn.compact
    def __call__(self, x: Float[AnyArray, "B h w C"]) -> Float[jax.Array, "B h2 w2 {self.channels}"]:
        """(B, h, w, C) -> (B, h / stride, w / stride, channels), rounded up."""
        pad = self.kernel // 2
        x = nn.Conv(
            self.channels,
            (self.kernel,) * 2,
            (self.stride,) * 2,
            ((pad, pad),) * 2,
            use_bias=self.norm == "none",
            kernel_init=nn.initializers.he_normal(),
            name="conv",
        )(x)
        return GroupNorm(name="norm")(x) if self.norm == "group" else x


class BasicBlock(nn.Module):
    """Two 3x3 convolutions and a shortcut, projected where shape changes."""

    channels: int
    stride: int
    norm: str

    @nn.compact
    def __call__(self, x: Float[AnyArray, "B h w C"]) -> Float[jax.Array, "B h2 w2 {self.channels}"]:
        """(B, h, w, C) -> (B, h / stride, w / stride, channels), rounded up."""
        y = nn.relu(ConvNorm(self.channels, 3, self.stride, self.norm, name="first")(x))
        y = ConvNorm(self.channels, 3, 1, self.norm, name="second")(y)
        if x.shape[-1] != self.channels or self.stride != 1:
            x = ConvNorm(self.channels, 1, self.stride, self.norm, name="shortcut")(x)
        return nn.relu(x + y)


class Stem(nn.Module):
    """Input at a quarter of its resolution: conv7 + max pooling, or one matrix product per 4x4 patch."""

    kind: str
    width: int
    norm: str

    @nn.compact
    def __call__(self, x: Float[AnyArray, "B h w C"]) -> Float[jax.Array, "B h4 w4 {self.width}"]:
        """(B, h, w, C) -> (B, h / 4, w / 4, width)."""
        if self.kind == "conv7":
            x = nn.relu(ConvNorm(self.width, 7, 2, self.norm, name="conv7")(x))
            return resnet_max_pool(x)
        patches = space_to_depth(x, STEM_STRIDE)
        x = nn.Dense(self.width, use_bias=self.norm == "none", name="patch")(patches)
        return nn.relu(GroupNorm(name="norm")(x) if self.norm == "group" else x)


class CellGeometry(NamedTuple):
    """Affine and projective constants that turn a cell of the feature map into a place in the world."""

    rows_px: Float32[np.ndarray, " h"]
    """Centre of each cell row, in pixels of the crop window."""
    columns_px: Float32[np.ndarray, " w"]
    """Centre of each cell column, in pixels of the crop window."""


def cell_geometry(profile: CameraProfile, config: StudentConfig) -> CellGeometry:
    """Centres of the feature map's cells inside the crop window."""
    window = preprocess.plan_window(profile, config)
    return CellGeometry(*preprocess.pixel_coordinates(window, map_stride(config)))


@exact
def cell_maps(
    origin_rc: Int[AnyArray, "B 2"], profile: CameraProfile, config: StudentConfig
) -> Float32[jax.Array, "B cells 8"]:
    """What each cell of the feature map means in the robot's frame, per crop window.

    Args:
        origin_rc: (B, 2) crop origins (row, column) in the full frame.

    Returns:
        (B, h*w, 8) float32: full-frame coordinates (v, u) in [-1, 1]; the point of the empty table the
        cell looks at, relative to POSITION_CENTER_M in units of POSITION_SCALE_M (3); how that point moves
        per unit of relief, same units (3).
    """
    return _maps_from_origin(jnp, origin_rc.astype(jnp.float32), profile, config)


def static_cell_maps(profile: CameraProfile, config: StudentConfig) -> Float32[np.ndarray, "cells 8"]:
    """`cell_maps` of the centred window as a (h*w, 8) NumPy constant, for the exported graph."""
    origin = np.asarray([profile.crop_origin_px], np.float32)
    return np.asarray(_maps_from_origin(np, origin, profile, config), np.float32)[0]


def _maps_from_origin(xp, origin, profile: CameraProfile, config: StudentConfig):
    geometry = cell_geometry(profile, config)
    camera = nominal_camera(profile)
    rotation = camera.T_world_cam[:3, :3].astype(np.float32)
    position = camera.T_world_cam[:3, 3].astype(np.float32)
    shape = (origin.shape[0], len(geometry.rows_px), len(geometry.columns_px))
    v_px = xp.broadcast_to((origin[:, :1] + geometry.rows_px)[:, :, None], shape)
    u_px = xp.broadcast_to((origin[:, 1:] + geometry.columns_px)[:, None, :], shape)
    ray_cam = xp.stack(
        [(u_px - profile.cx_px) / profile.fx_px, (v_px - profile.cy_px) / profile.fy_px, xp.ones_like(u_px)],
        -1,
    )
    ray = ray_cam @ rotation.T  # world direction with unit planar depth
    depth = xp.minimum(position[2] / xp.maximum(-ray[..., 2], 1e-6), config.picture.max_depth_m)[..., None]
    table = (position + depth * ray - np.asarray(POSITION_CENTER_M, np.float32)) / POSITION_SCALE_M
    per_relief = ray * (-preprocess.RELIEF_SCALE_M / POSITION_SCALE_M)
    coordinates = xp.stack([2 * v_px / profile.height_px - 1, 2 * u_px / profile.width_px - 1], -1)
    maps = xp.concatenate([coordinates, table, per_relief], axis=-1)
    return maps.reshape(shape[0], shape[1] * shape[2], 8)


def cell_relief(picture: Float[AnyArray, "B h w C"], config: StudentConfig) -> Float[jax.Array, "B cells"]:
    """(B, h*w) mean relief of the newest frame's valid pixels in each cell; 0 where a cell has none."""
    relief, valid = (newest_channel(picture, config, name) for name in ("relief", "valid"))
    stride = map_stride(config)

    def cells(image: AnyArray) -> jax.Array:
        batch, height, width = image.shape
        pad = ((0, 0), (0, -height % stride), (0, -width % stride))
        image = jnp.pad(image, pad)
        image = image.reshape(batch, image.shape[1] // stride, stride, image.shape[2] // stride, stride)
        return image.sum((2, 4)).reshape(batch, -1)

    return cells(relief * valid) / jnp.maximum(cells(valid), 1.0)


def newest_channel(
    picture: Float[AnyArray, "B h w C"], config: StudentConfig, name: str
) -> Float[jax.Array, "B h w"]:
    """(B, h, w): one channel of the newest frame in a picture made by `prepare_depth`."""
    return picture[..., newest_channel_index(config, name)]


def newest_channel_index(config: StudentConfig, name: str) -> int:
    """Index of that channel among the picture's 3 * channels."""
    return (contract.DEPTH_FRAMES - 1) * len(config.picture.channels) + config.picture.channels.index(name)


@exact
def spatial_softmax(
    logits: Float[AnyArray, "B cells K"],
    relief: Float[AnyArray, "B cells"],
    maps: Float[AnyArray, "B cells 8"],
) -> Float[jax.Array, "B K 6"]:
    """Expected place of each keypoint.

    Args:
        logits: (B, h*w, K).
        relief: (B, h*w).
        maps: (B, h*w, 8) of `cell_maps`.

    Returns:
        (B, K, 6): v, u in the full frame, relief, and x, y, z in the world in network units.
    """
    attention = jax.nn.softmax(logits, axis=1)
    coordinates, table, per_relief = maps[..., :2], maps[..., 2:5], maps[..., 5:]
    world = table + relief[..., None] * per_relief
    values = jnp.concatenate([coordinates, relief[..., None], world], axis=-1)
    return jnp.einsum("bpk,bpv->bkv", attention, values)


class DepthEncoder(nn.Module):
    """ResNet over the picture, pooled to a vector of features."""

    config: StudentConfig
    profile: CameraProfile

    @nn.compact
    def __call__(
        self, picture: Float[AnyArray, "B h w C"], origin_rc: Int[AnyArray, "B 2"]
    ) -> Float[jax.Array, "B {self.config.encoder.features}"]:
        """(B, h, w, C) picture and (B, 2) crop origins -> (B, features)."""
        config = self.config
        x = Stem(config.encoder.stem, config.encoder.width, config.encoder.norm, name="stem")(picture)
        for index, (channels, stride) in enumerate(stage_plan(config)):
            for block in range(config.encoder.stage_blocks[index]):
                stride_here = stride if block == 0 else 1
                x = BasicBlock(channels, stride_here, config.encoder.norm, name=f"stage{index}_block{block}")(
                    x
                )
        return self._pool(x, picture, origin_rc)

    def _pool(self, x: AnyArray, picture: AnyArray, origin_rc: AnyArray) -> jax.Array:
        config = self.config
        cells = x.reshape(x.shape[0], -1, x.shape[-1])
        centre = crop_centre(origin_rc, self.profile)
        if config.encoder.pooling == "mean":
            # Linear, as ResNet's last layer: means differ little from picture to picture, and a relu dies.
            known = jnp.concatenate([cells.mean(1), centre], axis=-1)
            return nn.Dense(config.encoder.features, name="features")(known)
        cells = nn.Dense(config.encoder.keypoints, name="cells")(cells)
        pooled = cells.reshape(cells.shape[0], -1)
        if config.encoder.pooling == "tokens":
            pooled = jnp.concatenate([nn.relu(pooled), centre], axis=-1)
        if config.encoder.pooling == "spatial_softmax":
            maps = cell_maps(origin_rc, self.profile, config)
            points = spatial_softmax(cells, cell_relief(picture, config), maps)
            pooled = points.reshape(points.shape[0], -1)
        return nn.relu(nn.Dense(config.encoder.features, name="features")(pooled))


def crop_centre(origin_rc: Int[AnyArray, "B 2"], profile: CameraProfile) -> Float[jax.Array, "B 2"]:
    """(B, 2) centre of each crop window in full-frame coordinates [-1, 1] (v, u); 0 when centred."""
    half = jnp.array([profile.crop_height_px, profile.crop_width_px], jnp.float32) / 2
    size = jnp.array([profile.height_px, profile.width_px], jnp.float32)
    return 2 * (origin_rc + half) / size - 1


def static_crop_centre(profile: CameraProfile) -> Float32[np.ndarray, "2"]:
    """(2,) `crop_centre` of the centred window, for the exported graph."""
    row, column = profile.crop_origin_px
    v = 2 * (row + profile.crop_height_px / 2) / profile.height_px - 1
    u = 2 * (column + profile.crop_width_px / 2) / profile.width_px - 1
    return np.array([v, u], np.float32)
