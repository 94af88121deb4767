"""A hand-written controller that grasps from above: where PPO starts, not what is deployed.

It reads the teacher's observation and walks waypoints by inverse kinematics. Cloned into the policy
network it spares PPO the search (from scratch 6 M steps found no grasp, at the 10 ms physics of then),
and its motions are what a student can copy: from above, unhurried, the object in view.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.layout import OBSERVATION
from mjx_envs import inverse_kinematics, kinematics

REACH_STEP_M, LIFT_STEP_M = 0.04, 0.045
"""Length of a waypoint step, per control step."""
TOUCH_STEP_M, SLOWING = 0.010, 0.3
"""Length of the last step before the grasp, and what a step may be longer for each metre that is left: an arm
that comes down on something at full speed stops itself, as Franka's do."""
GAIN = 1.4
"""Over one: the arm lags behind its targets."""
MAX_ACTION = 0.85
ALIGNED_M, ALIGNED_RAD = 0.015, 0.25
"""Close the gripper within this of the grasp pose."""
NEAR_M, USUAL_OFFSET_M = 0.03, 0.021
"""Between the pads is what lies within the first of the grip; further for what is grasped further than the
second from its centre."""
CLEARANCE_M = 0.10


def guide(observation: Float[jax.Array, "40"]) -> Float[jax.Array, "8"]:
    """(8,) action for one observation (40,)."""
    part = {name: observation[where] for name, where in OBSERVATION.items()}
    q, fingers, finger_speed = part["arm"], part["fingers"].sum(), part["finger_velocity"].sum()
    grip, grip_quat, object_pos = part["grip_pos"], part["grip_quat"], part["object_pos"]
    grasp, grasp_quat = part["grasp_pos"], part["grasp_quat"]

    lateral = jnp.linalg.norm(grip[:2] - grasp[:2])
    angle = kinematics.angle_between(grip_quat, grasp_quat, jnp)
    aligned = (lateral < ALIGNED_M) & (jnp.abs(grip[2] - grasp[2]) < ALIGNED_M) & (angle < ALIGNED_RAD)
    offset = jnp.linalg.norm(grasp - object_pos)
    near_m = NEAR_M + jnp.maximum(offset - USUAL_OFFSET_M, 0.0)
    closing = (jnp.linalg.norm(grip - object_pos) < near_m) & (fingers < 0.078)
    held = closing & (jnp.abs(finger_speed) < 0.02) & (fingers > 0.004)

    misaligned = jnp.maximum(lateral - 0.008, 0.0) + 0.06 * jnp.maximum(angle - 0.12, 0.0)
    above = jnp.clip(2.0 * misaligned, 0.0, CLEARANCE_M)
    reach = grasp.at[2].add(above)
    lift = grip + jnp.asarray(contract.LIFT_TARGET_M) - object_pos
    way = jnp.where(held, lift, reach) - grip
    reach_step = jnp.minimum(REACH_STEP_M, TOUCH_STEP_M + SLOWING * jnp.linalg.norm(way))
    stride = jnp.where(held, LIFT_STEP_M, reach_step)
    waypoint = grip + way * jnp.minimum(1.0, stride / jnp.maximum(jnp.linalg.norm(way), 1e-6))
    target = inverse_kinematics.solve(q, waypoint, jnp.where(held, grip_quat, grasp_quat))

    move = GAIN * (target - q) / contract.ACTION_SCALE_RAD
    move = move * jnp.minimum(1.0, MAX_ACTION / jnp.maximum(jnp.max(jnp.abs(move)), 1e-6))
    close = aligned | held | (closing & (finger_speed < 0))
    return jnp.append(move, jnp.where(close, MAX_ACTION, -MAX_ACTION))
