"""How fit for a robot a policy's motion is: saturation, joint acceleration and jerk, gripper toggles. NumPy.

Velocities are known at control steps alone, so acceleration and jerk are means over 100 ms: they show
jitter from step to step, not what happens within one.
"""

import numpy as np
from jaxtyping import Bool, Float

from ddgrasp import contract
from ddgrasp.layout import ACTION, closes
from mjx_envs.grasp_math import SATURATED

JERK_LIMIT_RAD_S3 = (7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0)
"""Joint jerk limits: Franka's interface specification."""


def motion_metrics(
    velocity_rad_s: Float[np.ndarray, "steps n 7"],
    action: Float[np.ndarray, "steps n 8"],
    running: Bool[np.ndarray, "steps n"],
) -> dict[str, float]:
    """Metrics over N episodes of T control steps that start at rest with the gripper open.

    Args:
      velocity_rad_s: (T, N, 7) joint velocities at the end of each step.
      action: (T, N, 8) what was commanded in it.
      running: (T, N) bool, whether the episode was still going on in it.

    Returns:
      saturated_actions: share of the joint actions beyond `mjx_envs.grasp_math.SATURATED`.
      acceleration_p99, acceleration_max, jerk_p99, jerk_max: of the joint nearest its limit, relative to
        that limit; 99th percentile and maximum over steps.
      gripper_toggles: changes between open and close per episode; a grasp at first try is one.
    """
    acceleration = _rate(velocity_rad_s)
    jerk = _rate(acceleration)
    metrics = {"saturated_actions": float(np.mean(np.abs(action[..., ACTION.arm])[running] > SATURATED))}
    for name, value, limit in (
        ("acceleration", acceleration, contract.JOINT_ACCELERATION_LIMIT_RAD_S2),
        ("jerk", jerk, JERK_LIMIT_RAD_S3),
    ):
        worst = (np.abs(value) / np.array(limit)).max(axis=-1)[running]
        metrics[f"{name}_p99"] = float(np.percentile(worst, 99))
        metrics[f"{name}_max"] = float(worst.max())
    closed = closes(action)
    toggled = closed != np.concatenate([np.zeros_like(closed[:1]), closed[:-1]])
    metrics["gripper_toggles"] = float((toggled & running).sum() / running.shape[1])
    return metrics


def _rate(values: np.ndarray) -> np.ndarray:
    """Change per second of `values` (T, ...), which start from zero."""
    return np.diff(values, axis=0, prepend=np.zeros_like(values[:1])) / contract.CONTROL_DT_S
