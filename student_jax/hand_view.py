"""A second look: the picture around the hand, where joints say it should be, at a constant metric scale.

The camera's pose is known to a centimetre only, so a place read off the picture is known no better. The
hand is in the same picture and its place is known from the joints: what lies beside it can be placed
relative to it, whatever the camera's error. Like a spatial transformer (Jaderberg et al., 2015) whose
place is computed, not learned.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Float, Float32, Float64, Int

from ddgrasp.arrays import AnyArray
from ddgrasp.config import StudentConfig
from ddgrasp.contract import CameraProfile
from mjx_envs import kinematics, scene
from mjx_envs.camera import nominal_camera
from mjx_envs.precision import exact
from student_jax import preprocess
from student_jax.encoder import BasicBlock, Stem

STEM = "space_to_depth"
"""Patches keep every pixel, and are cheap on CPU."""
MIN_CAMERA_DEPTH_M = 0.1
"""A hand nearer to the camera than this is drawn as if it were there."""
MIN_COVERAGE = 0.25
"""Bounds the division by the share of valid pixels under a sample."""


class Projection(NamedTuple):
    """Nominal camera and crop window as plain numbers: picture pixel = focal * xy / z + centre - origin."""

    rotation: Float32[np.ndarray, "3 3"]
    """World to camera."""
    offset_m: Float32[np.ndarray, "3"]
    """World to camera."""
    focal_px: Float32[np.ndarray, "2"]
    """Row, column, in pixels of the network's picture."""
    centre_px: Float32[np.ndarray, "2"]
    """Principal point in those pixels, had the crop window its origin at (0, 0)."""
    shrink: Float32[np.ndarray, "2"]
    """Picture pixels per camera pixel."""


def projection(profile: CameraProfile, config: StudentConfig) -> Projection:
    """How the nominal camera draws a point of the world into the network's picture."""
    window = preprocess.plan_window(profile, config)
    shrink = np.array([1.0 if a.matrix is None else len(a.matrix) / a.length for a in window])
    start = np.array([a.start for a in window])
    pose = nominal_camera(profile).T_world_cam
    rotation = pose[:3, :3].T
    centre = (np.array([profile.cy_px, profile.cx_px]) - start) * shrink
    focal = np.array([profile.fy_px, profile.fx_px]) * shrink
    numbers = (rotation, -rotation @ pose[:3, 3], focal, centre, shrink)
    return Projection(*(np.asarray(x, np.float32) for x in numbers))


def grip_chain() -> list[tuple[Float64[np.ndarray, "3 3"], Float64[np.ndarray, "3"]]]:
    """[(R (3, 3), t (3,)), ...] of base to tip: point = R_1 Rz(q_1) (R_2 Rz(q_2) (... p) + t_2) + t_1.

    One entry for each arm joint; `grip_tip` is p.
    """
    return [
        (kinematics.quat_to_mat(np.array(link.quat, float)), np.array(link.pos_m)) for link in scene.ARM_LINKS
    ]


def grip_tip() -> Float64[np.ndarray, "3"]:
    """(3,) the point between the finger pads in the last link's frame, metres."""
    return np.array(scene.HAND_POS_M) + kinematics.rotate(
        np.array(scene.HAND_QUAT), np.array(scene.GRIP_POS_M)
    )


@exact
def place(
    grip_m: Float[AnyArray, "B 3"],
    origin_rc: Int[AnyArray, "B 2"],
    profile: CameraProfile,
    config: StudentConfig,
) -> tuple[Float[jax.Array, "B 2"], Float[jax.Array, "B 2"]]:
    """Where the nominal camera draws the hand.

    Args:
        grip_m: (B, 3) the point between the finger pads, world frame.
        origin_rc: (B, 2) crop origins in the full frame.

    Returns:
        (B, 2) its (row, column) in the network's picture, and (B, 2) pixels per metre there.
    """
    view = projection(profile, config)
    point = grip_m @ view.rotation.T + view.offset_m
    depth = jnp.maximum(point[:, 2:], MIN_CAMERA_DEPTH_M)
    per_metre = jnp.asarray(view.focal_px) / depth
    centre = point[:, 1::-1] * per_metre + view.centre_px - origin_rc * view.shrink
    return centre, per_metre


def sampling_matrix(
    centre: Float[AnyArray, " B"], step: Float[AnyArray, " B"], count: int, length: int
) -> Float[jax.Array, "B {count} {length}"]:
    """(B, count, length) weights of `count` samples, `step` pixels apart around `centre`, both (B,).

    Linear interpolation, widened to the step where that is more than a pixel; nothing beyond the edge.
    """
    offsets = np.arange(count, dtype=np.float32) - (count - 1) / 2
    pixels = np.arange(length, dtype=np.float32) + 0.5
    place_px = centre[:, None] + step[:, None] * offsets
    support = jnp.maximum(step, 1.0)[:, None, None]
    return jnp.maximum(0.0, 1.0 - jnp.abs(place_px[:, :, None] - pixels) / support) / support


@exact
def cut(
    picture: Float[AnyArray, "B h w C"],
    centre: Float[AnyArray, "B 2"],
    per_metre: Float[AnyArray, "B 2"],
    config: StudentConfig,
) -> Float[jax.Array, "B n n C"]:
    """(B, n, n, C) part of the picture (B, h, w, C) around `centre`, samples hand_view.pitch_m apart.

    Measures are averaged over valid pixels alone; the valid channel becomes the share of them.
    """
    count, pitch = config.hand_view.size_px, config.hand_view.pitch_m
    rows = sampling_matrix(centre[:, 0], pitch * per_metre[:, 0], count, config.picture.height_px)
    columns = sampling_matrix(centre[:, 1], pitch * per_metre[:, 1], count, config.picture.width_px)
    # Rows first: they are next to each other in memory, and fewer are left for the columns.
    seen = jnp.einsum("bikc,blk->bilc", jnp.einsum("bij,bjkc->bikc", rows, picture), columns)
    frames = seen.reshape(*seen.shape[:3], -1, len(config.picture.channels))
    valid = config.picture.channels.index("valid")
    coverage = frames[..., valid : valid + 1]
    scale = jnp.where(
        jnp.arange(len(config.picture.channels)) == valid, 1.0, 1.0 / jnp.maximum(coverage, MIN_COVERAGE)
    )
    return (frames * scale).reshape(seen.shape)


class HandView(nn.Module):
    """Convolutions over the part of the picture around the hand, to a vector of features."""

    config: StudentConfig
    profile: CameraProfile

    @nn.compact
    def __call__(
        self,
        picture: Float[AnyArray, "B h w C"],
        grip_m: Float[AnyArray, "B 3"],
        origin_rc: Int[AnyArray, "B 2"],
    ) -> Float[jax.Array, "B {self.config.hand_view.features}"]:
        """(B, h, w, C) picture, (B, 3) grip point and (B, 2) crop origins -> (B, features)."""
        config = self.config
        view = cut(picture, *place(grip_m, origin_rc, self.profile, config), config)
        x = Stem(STEM, config.hand_view.width, config.encoder.norm, name="stem")(view)
        for block in range(config.hand_view.blocks):
            x = BasicBlock(config.hand_view.width, 1, config.encoder.norm, name=f"block{block}")(x)
        cells = nn.relu(nn.Dense(config.hand_view.channels, name="cells")(x))
        return nn.relu(nn.Dense(config.hand_view.features, name="features")(cells.reshape(len(cells), -1)))
