"""What differs from episode to episode, as formulas of uniform numbers already drawn.

Training (`mjx_envs/randomize.py`, JAX) and the rig (`rig/world.py`, NumPy) draw the numbers, each with a
generator of its own; what becomes of them stands here. `xp` is the array namespace. Free of JAX.
"""

from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from ddgrasp.config import RandomConfig
from mjx_envs import kinematics


class Units(NamedTuple):
    """Uniform numbers behind one episode's dynamics: in [-1, 1], `joint_friction` in [0, 1]."""

    size: Any
    object_mass: Any
    object_friction: Any
    link_mass: Any
    """(7,) as the rest below."""
    damping: Any
    joint_friction: Any
    stiffness: Any


class Dynamics(NamedTuple):
    """Relative to the nominal model where no unit is named."""

    size: Any
    """() of the object, all lengths."""
    object_mass: Any
    """()"""
    object_friction: Any
    """()"""
    link_mass: Any
    """(7,) mass and inertia of the arm's links."""
    damping: Any
    """(7,) of the joints."""
    joint_friction_nm: Any
    """(7,) dry friction."""
    gain: Any
    """(7,) stiffness and damping of the position controllers."""


def dynamics(config: RandomConfig, units: Units) -> Dynamics:
    """The configured half-ranges around nominal; dry friction from 0 up to its range."""
    return Dynamics(
        size=_around(config.size, units.size),
        object_mass=_around(config.object_mass, units.object_mass),
        object_friction=_around(config.object_friction, units.object_friction),
        link_mass=_around(config.link_mass, units.link_mass),
        damping=_around(config.damping, units.damping),
        joint_friction_nm=config.friction_nm * units.joint_friction,
        gain=_around(config.stiffness, units.stiffness),
    )


def start_qpos(
    config: RandomConfig,
    joints: Float[AnyArray, "7"],
    xy: Float[AnyArray, "2"],
    yaw_rad: Float[AnyArray, ""],
    rest_height_m: Float[AnyArray, ""] | float,
    xp: ModuleType = np,
) -> Float[AnyArray, "16"]:
    """(16,) joints around home within their limits, gripper open, object at rest on the table.

    Args:
      joints: (7,) in [-1, 1].
      xy: (2,) in [-1, 1], across the workspace.
      yaw_rad: () of the object.
      rest_height_m: () of its origin.
    """
    limits = xp.asarray(contract.JOINT_LOWER_RAD), xp.asarray(contract.JOINT_UPPER_RAD)
    q_arm = xp.clip(xp.asarray(contract.HOME_RAD) + config.joint_rad * joints, *limits)
    half = xp.asarray(contract.WORKSPACE_SIZE_M) / 2
    place = xp.asarray(contract.WORKSPACE_CENTER_M) + half * xy
    fingers = xp.full(2, contract.GRIPPER_MAX_WIDTH_M / 2)
    height = xp.asarray(rest_height_m)[None]
    return xp.concatenate([q_arm, fingers, place, height, kinematics.quat_about_z(yaw_rad, xp)])


def displaced(
    T_world_cam: Float[AnyArray, "4 4"],
    shift_m: Float[AnyArray, "3"],
    turn: Float[AnyArray, "4"],
    xp: ModuleType = np,
) -> Float[AnyArray, "4 4"]:
    """(4, 4) camera pose moved by `shift_m` (3,) in the world and turned by the quaternion `turn` (4,) about
    its own axes."""
    rotation = T_world_cam[:3, :3] @ kinematics.quat_to_mat(turn, xp)
    position = T_world_cam[:3, 3] + shift_m
    top = xp.concatenate([rotation, position[:, None]], axis=1)
    return xp.concatenate([top, T_world_cam[3:]])


def _around(half_range, unit):
    """Factors in [1 - half_range, 1 + half_range] from `unit` in [-1, 1]."""
    return 1.0 + half_range * unit
