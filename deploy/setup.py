"""From the configuration and the policy's own metadata to the loop's parts."""

from ddgrasp import contract
from ddgrasp.config import DeployConfig
from ddgrasp.policy_metadata import PolicyMetadata
from deploy.loop import LoopSettings
from deploy.safety import SafetyFilter, SafetyLimits


def loop_settings(config: DeployConfig, info: PolicyMetadata) -> LoopSettings:
    """The policy's own rate, the configured patience."""
    return LoopSettings(period_s=1.0 / info.control_hz, stale_periods=config.stale_periods)


def safety_filter(config: DeployConfig, info: PolicyMetadata) -> SafetyFilter:
    """Joint limits narrow enough for both this robot and the policy; the rest from the configuration."""
    acceleration = (config.acceleration_scale * a for a in contract.JOINT_ACCELERATION_LIMIT_RAD_S2)
    limits = SafetyLimits(
        lower_rad=tuple(map(max, contract.JOINT_LOWER_RAD, info.joint_lower_rad)),
        upper_rad=tuple(map(min, contract.JOINT_UPPER_RAD, info.joint_upper_rad)),
        acceleration_rad_s2=tuple(acceleration),
        workspace_lower_m=config.workspace_lower_m,
        workspace_upper_m=config.workspace_upper_m,
        period_s=1.0 / info.control_hz,
    )
    return SafetyFilter(limits, info.action_scale_rad)
