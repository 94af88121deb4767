"""What every stage agrees on: joint order, shapes, units, rates, camera profile.

This module imports the standard library alone, so that the robot side can use it. Which number of a vector
is what: `ddgrasp.layout`.
Change a value here and `CONTRACT_VERSION` with it: artifacts of another version are refused. What a policy
file alone takes is named in its metadata (`policy_metadata.STATE_LAYOUT`), which refuses such files alone.
"""

import math
from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Any

from ddgrasp.layout import ACTION, OBSERVATION, POLICY_STATE, STATE

CONTRACT_VERSION = 1

# --- time ------------------------------------------------------------------------------------
CONTROL_HZ = 10.0
CONTROL_DT_S = 1.0 / CONTROL_HZ


# --- robot: limits from Franka's published interface specification ---------------------------
@dataclass(frozen=True)
class Arm:
    """A Franka arm with its hand. Both have the same kinematics, and differ in what their joints may do."""

    name: str
    """As `deploy.franka.model` names it."""
    joint_lower_rad: tuple[float, ...]
    joint_upper_rad: tuple[float, ...]
    joint_velocity_rad_s: tuple[float, ...]
    joint_acceleration_rad_s2: tuple[float, ...]
    braking_rad_s2: tuple[float, ...] = (6.0, 2.585, 3.5, 4.0, 17.0, 5.5, 17.0)
    """Towards a position limit r rad away a joint may do -braking_reserve + sqrt(2 braking r) rad/s. The
    FR3's ("Limits for Franka Research 3", Franka's control parameters); the Panda's maker names none."""
    braking_reserve_rad_s: tuple[float, ...] = (0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35)
    hand_width_m: float = 0.08
    """Largest opening between the pads of the Franka Hand."""


PANDA = Arm(
    name="panda",
    joint_lower_rad=(-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973),
    joint_upper_rad=(2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973),
    joint_velocity_rad_s=(2.1750, 2.1750, 2.1750, 2.1750, 2.6100, 2.6100, 2.6100),
    joint_acceleration_rad_s2=(15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0),
)
"""Franka Emika Panda: what training and the development rig drive."""
FR3 = Arm(
    name="fr3",
    joint_lower_rad=(-2.7437, -1.7837, -2.9007, -3.0421, -2.8065, 0.5445, -3.0159),
    joint_upper_rad=(2.7437, 1.7837, 2.9007, -0.1518, 2.8065, 4.5169, 3.0159),
    joint_velocity_rad_s=(2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26),
    joint_acceleration_rad_s2=(10.0, 10.0, 10.0, 10.0, 10.0, 10.0, 10.0),
)
"""Franka Research 3."""
ARMS = {arm.name: arm for arm in (PANDA, FR3)}

HOME_RAD = (0.0, -0.2016, 0.0, -2.4853, 0.0, 2.2836, 0.7854)
"""Grip 0.26 m above the table over x = 0.45, fingers down, opening along world y."""
ARM_JOINTS = tuple(f"panda_joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("panda_finger_joint1", "panda_finger_joint2")
JOINT_LOWER_RAD = PANDA.joint_lower_rad
JOINT_UPPER_RAD = PANDA.joint_upper_rad
JOINT_VELOCITY_LIMIT_RAD_S = PANDA.joint_velocity_rad_s
JOINT_ACCELERATION_LIMIT_RAD_S2 = PANDA.joint_acceleration_rad_s2
GRIPPER_MAX_WIDTH_M = PANDA.hand_width_m
GRIPPER_SPEED_M_S = 0.1
"""How fast the opening changes: 50 mm/s for each finger of a Franka Hand (its datasheet)."""

OBSERVATION_PARTS = {
    "joint_position": 9, "joint_velocity": 9, "hand_pose": 7,
    "object_pose": 7, "grasp_pose": 7, "category": 1,
}  # fmt: skip
"""Teacher's observation, in order. Poses are position (m) + unit quaternion (w, x, y, z) in the world frame
(robot base); the category is the logarithm of its id."""
OBSERVATION_SIZE = OBSERVATION.size
"""40."""
STATE_SIZE = STATE.size
"""A robot's: seven arm joint positions (rad) and the gripper's opening width (m)."""
POLICY_STATE_SIZE = POLICY_STATE.size
"""A student's: the same, and the width's change since the control step before (m)."""
ACTION_SIZE = ACTION.size
"""a[:7] in [-1, 1] scaled joint deltas, a[7] gripper: > 0 closes, <= 0 opens."""
ACTION_SCALE_RAD = 0.1
"""s in q_target = q + s * a[:7]: radians per control step."""

# --- workspace: world frame = robot base, x forward, z up, table top at z = 0 ----------------
WORKSPACE_CENTER_M = (0.5, 0.0)
WORKSPACE_SIZE_M = (0.3, 0.4)
"""x and y extent in which an object's centre starts (the paper's 40 cm x 30 cm)."""
LIFT_TARGET_M = (0.5, 0.0, 0.4)
LIFT_TOLERANCE_M = 0.05
HOLD_STEPS = 5
"""An episode succeeds if its last HOLD_STEPS steps all had the object within tolerance."""
TRIAL_S = 12.0
"""A trial on a rig ends as soon as that is so, and fails after this: twice an episode of training, so that a
hand that has closed on nothing can try again. The paper gives a trial no limit."""

# --- objects ---------------------------------------------------------------------------------
SEEN_OBJECTS = ("apple", "pear", "peach", "banana", "cube", "block")
"""The paper trains on these and tests on the others as well; `mjx_envs.objects` describes them all."""
UNSEEN_OBJECTS = ("persimmon", "starfruit", "lemon", "can", "wheel", "bread")
PLAIN_SHAPES = ("tower", "slab", "stick", "puck", "ring", "tin")
"""None of the paper's: to train on besides."""

# --- depth -----------------------------------------------------------------------------------
DEPTH_FRAMES = 3
DEPTH_UNIT_M = 0.001
"""On disk: uint16 millimetres. In memory: float32 planar metres. 0 = invalid in both."""


@dataclass(frozen=True)
class CameraProfile:
    """Pinhole camera. Pixel (row v, column u) has its centre at (u + 0.5, v + 0.5).

    Camera frame as in OpenCV: x right, y down, z forward; depth is planar (along z).
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    baseline_m: float
    """Distance from the left to the right infrared imager."""
    crop_height_px: int
    crop_width_px: int
    """The window a policy sees (450 x 580 at scale 1, paper III-C1)."""

    def scaled(self, scale: float) -> "CameraProfile":
        """The same camera with `scale` times the pixels per side (0.25: 1280 -> 320), rounded; what rounding
        adds or takes is shared by both sides, so that a centred axis stays so."""
        width_px, height_px = round(self.width_px * scale), round(self.height_px * scale)
        return replace(
            self,
            width_px=width_px,
            height_px=height_px,
            fx_px=self.fx_px * scale,
            fy_px=self.fy_px * scale,
            cx_px=width_px / 2 + (self.cx_px - self.width_px / 2) * scale,
            cy_px=height_px / 2 + (self.cy_px - self.height_px / 2) * scale,
            crop_height_px=round(self.crop_height_px * scale),
            crop_width_px=round(self.crop_width_px * scale),
        )

    @property
    def nearest_m(self) -> float:
        """Nearest surface that a D4xx whose stream is this profile reports: where the search ends."""
        return self.fx_px * self.baseline_m / D4XX_SEARCH_PX

    @property
    def crop_origin_px(self) -> tuple[int, int]:
        """(row, column) of the centred crop window's first pixel."""
        return (
            (self.height_px - self.crop_height_px) // 2,
            (self.width_px - self.crop_width_px) // 2,
        )


_D455_FX_PX = 640.0 / math.tan(math.radians(87.0 / 2))
D455 = CameraProfile(
    width_px=1280,
    height_px=720,
    fx_px=_D455_FX_PX,
    fy_px=_D455_FX_PX,
    cx_px=640.0,
    cy_px=360.0,
    baseline_m=0.095,
    crop_height_px=450,
    crop_width_px=580,
)
"""RealSense D455 depth stream: 87 degrees horizontal field of view, 95 mm baseline (datasheet)."""

D455_STREAM = replace(D455.scaled(2 / 3), width_px=848, cx_px=424.0)
"""The mode in which a D455 is run, 848 x 480 (its 853 columns less five): it sees from 0.34 m on. At
1280 x 720 that is 0.51 m, and the object is lifted to 0.41 m; at 640 x 360 it is 0.25 m, with a third more
noise, since a pixel of disparity is worth more."""
D4XX_SEARCH_PX = 126
"""Disparities that a D4xx's matcher searches, at every resolution (RealSense's tuning guide)."""

CAMERA_POSITION_M = (0.94, 0.0, 0.56)
CAMERA_LOOK_AT_M = (0.48, 0.0, 0.05)
"""Nominal extrinsics: the camera stands across the table and looks back at the robot."""

# --- exported policy -------------------------------------------------------------------------
ONNX_INPUT_DEPTH = "depth"
"""(B, 3, H, W), oldest frame first; float32 metres or uint16 millimetres, as the metadata says."""
ONNX_INPUT_STATE = "state"
"""(B, 9) float32, see POLICY_STATE_SIZE."""
ONNX_INPUT_NOISE = "noise"
"""(B, chunk, 8) float32, standard normal: the initial sample of the reverse diffusion."""
ONNX_OUTPUT_ACTION = "action"
"""(B, chunk, 8) float32 in [-1, 1]; row 0 is to be executed now."""
ONNX_METADATA_KEY = "ddgrasp"
"""metadata_props key whose value is a JSON object (see ddgrasp/policy_metadata.py)."""


# --- manifests -------------------------------------------------------------------------------
def counted(outcomes: Collection[Any]) -> dict[str, int]:
    """{"successes", "n"} of n outcomes, true or false (or of an array (n,)): how success is written down."""
    return {"successes": int(sum(outcomes)), "n": len(outcomes)}
