"""From the configuration and the policy's own metadata to the loop's parts."""

from collections.abc import Sequence

import numpy as np

from ddgrasp import contract
from ddgrasp.config import DeployConfig
from ddgrasp.errors import UserError
from ddgrasp.policy_metadata import PolicyMetadata
from deploy.devices.options import SIMULATION
from deploy.loop import LoopSettings
from deploy.safety import SafetyFilter, SafetyLimits

JOINT_MARGIN_RAD = 0.02
"""A real arm's targets stay this far inside its range: the planner that smooths them overshoots a little, and
the control unit stops an arm that asks for more than its range."""


def loop_settings(
    config: DeployConfig, info: PolicyMetadata, moves: bool = True, by_time: bool = False
) -> LoopSettings:
    """The policy's own rate, the configured patience, whether a hand tries again: one that is not moved
    stands still and stays shut whatever it is told, and would try again for ever."""
    return LoopSettings(1.0 / info.control_hz, config.stale_periods, config.retry and moves, by_time)


def safety_filter(config: DeployConfig, info: PolicyMetadata, robot: str = SIMULATION) -> SafetyFilter:
    """Limits narrow enough for both `robot` (as `--robot` names it) and the policy.

    Whatever is no simulation is the configured arm, by whichever driver.
    """
    real = robot != SIMULATION
    arm = contract.ARMS[config.franka.model] if real else contract.PANDA
    speed = config.franka.speed_rad_s if real else arm.joint_velocity_rad_s
    margin = JOINT_MARGIN_RAD if real else 0.0
    limits = SafetyLimits(
        lower_rad=tuple(
            max(a + margin, p) for a, p in zip(arm.joint_lower_rad, info.joint_lower_rad, strict=True)
        ),
        upper_rad=tuple(
            min(a - margin, p) for a, p in zip(arm.joint_upper_rad, info.joint_upper_rad, strict=True)
        ),
        velocity_rad_s=speed,
        acceleration_rad_s2=tuple(config.acceleration_scale * a for a in arm.joint_acceleration_rad_s2),
        braking_rad_s2=arm.braking_rad_s2 if real else None,
        braking_reserve_rad_s=arm.braking_reserve_rad_s,
        workspace_lower_m=config.workspace_lower_m,
        workspace_upper_m=config.workspace_upper_m,
        arm_lower_m=config.arm_lower_m,
        arm_upper_m=config.arm_upper_m,
        approach_below_m=config.franka.approach_below_m if real else 0.0,
        approach_m_s=config.franka.approach_m_s,
        period_s=1.0 / info.control_hz,
    )
    return SafetyFilter(limits, info.action_scale_rad)


def check_start(safety: SafetyFilter) -> None:
    """UserError if a real arm's start pose is outside of the boxes that it is to keep to: the filter does not
    see the way there, and lets stay outside what begins there."""
    for box, metres in safety.outside_m(np.array(contract.HOME_RAD)).items():
        if metres > 0:
            raise UserError(
                f"at its start pose the arm is {1e3 * metres:.0f} mm outside of deploy.{box}_lower_m to "
                f"{box}_upper_m: nothing has moved; take away what stands there, or widen the box."
            )


def speed_notice(config: DeployConfig, info: PolicyMetadata) -> str:
    """One line where the policy may ask for more speed than `deploy.franka.dynamics` gives; else ""."""
    asked, given = info.action_scale_rad * info.control_hz, min(config.franka.speed_rad_s)
    if asked <= given:
        return ""
    enough = config.franka.dynamics * asked / given
    return (
        f"speed: the policy may ask for {asked:.2f} rad/s, deploy.franka.dynamics {config.franka.dynamics:g} "
        f"gives {given:.2f}; steps are cut to that ({enough:.2f} gives all of it)"
    )


def space_notice(config: DeployConfig) -> str:
    """One line with the boxes that a real arm keeps to: whoever left them out of a command sees it."""
    pads = _box(config.workspace_lower_m, config.workspace_upper_m)
    arm = _box(config.arm_lower_m, config.arm_upper_m)
    return (
        f"space, metres from the base: between the pads {pads} (deploy.workspace_lower_m, ..._upper_m); "
        f"arm and hand {arm} (deploy.arm_lower_m, ..._upper_m)"
    )


def _box(lower: Sequence[float], upper: Sequence[float]) -> str:
    sides = zip("xyz", lower, upper, strict=True)
    return ", ".join(f"{axis} {low:g} to {high:g}" for axis, low, high in sides)
