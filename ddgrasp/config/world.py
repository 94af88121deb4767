"""Scene, objects, reward and randomisation."""

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal, get_args

from ddgrasp import contract
from ddgrasp.config.checks import Range, Section, Share, Text, Weight

Backend = Literal["cpu", "jax", "warp"]
BACKENDS: tuple[Backend, ...] = get_args(Backend)
RewardDistance = Literal["funnel", "plain"]
GraspSwitch = Literal["touch", "near"]
Renderer = Literal["jax", "warp"]
RENDERERS: tuple[Renderer, ...] = get_args(Renderer)
CameraScale = Annotated[float, Range(0.1, 1)]
_Relative = Annotated[float, Range(0, 0.9)]
"""Half-range as a share of the nominal value."""


@dataclass(frozen=True)
class RewardConfig(Section, name="world.reward"):
    """Weights of the reward terms (paper Eq. 2 and its terms; `ours` marks what the paper lacks).

    `PAPER_REWARD` is the paper's own five terms.
    """

    reach: Weight = 10.0
    """w1: for a hand near the object, per metre."""
    lift: Weight = 10.0
    """w2: for an object near the lift target, per metre."""
    orient: Weight = 0.5
    """w3: for turning the hand upright, as it is at the lift target, once it is lifted, per radian."""
    accel: Weight = 3e-5
    """w4: penalty on joint accelerations, per (rad/s^2)^2."""
    bonus_base: Annotated[float, Range(1, 1000, above=True)] = 1.1
    """c1 > 1: the bonus for success, times c2 already at its first step."""
    bonus_growth: Annotated[float, Range(1, 1000, above=True)] = 1.08
    """c2 > 1: by which the bonus grows with every further step of success."""
    bonus_max_count: Annotated[int, Range(0, 10_000)] = 10
    """Steps of success after which the bonus no longer grows, which keeps it finite."""
    align: Weight = 0.5
    """Ours: for turning the hand to the grasp pose before the lift, per radian."""
    saturation: Weight = 0.01
    """Ours: penalty on the squared part of an action beyond 0.8 of its range."""
    grasp: Weight = 0.1
    """Ours: per step with the object in the hand."""
    toggle: Weight = 0.005
    """Ours: penalty on each change of the gripper's command. Keep it small: ten times as much teaches the
    policy never to close the gripper."""
    distance: RewardDistance = "funnel"
    """What w1 counts: funnel (ours: by way of a point above the grasp, so that the hand comes from above) or
    plain (the paper's: gripper centre to object centre)."""
    grasp_switch: GraspSwitch = "touch"
    """What counts as grasped: touch (ours: both pads press on the object, gripper closing; w1 ends with it,
    and the bonus needs it) or near (the paper's: gripper closing, its centre within 3 cm of the object's; w1
    goes on, and the bonus is for the object's place alone)."""


PAPER_REWARD = RewardConfig(
    align=0.0, saturation=0.0, grasp=0.0, toggle=0.0, distance="plain", grasp_switch="near"
)
"""The paper's reward: its five terms, its distance, its grasp. It prints no weights: these are ours, and so
are the bounds that keep it finite, 0.5 m on distances and `bonus_max_count`."""


@dataclass(frozen=True)
class RandomConfig(Section, name="world.random"):
    """Half-ranges of the randomisation, uniform, drawn once per episode (paper III-C1)."""

    joint_rad: Annotated[float, Range(0, math.pi)] = 0.1
    """Initial arm joints around home."""
    pregrasp_share: Share = 0.0
    """Share of episodes that start with the hand above the object: exploring starts, which in a run only
    training has, by teacher.pregrasp_share."""
    pregrasp_turn_rad: Annotated[float, Range(0, math.pi / 2)] = 0.0
    """The hand's yaw there, off the grasp's by up to this: in a run by teacher.pregrasp_turn_rad."""
    held_share: Share = 0.0
    """Share of episodes that start with the object in the hand, anywhere up to the lift target: in a run by
    teacher.held_share."""
    other_pose_share: Share = 0.5
    """Share of episodes in which an object that can both lie and stand rests in its other pose."""
    size: Annotated[float, Range(0, 0.5)] = 0.05
    """Size of the object, relative to its own."""
    object_mass: _Relative = 0.3
    """Mass of the object, relative to its own."""
    object_friction: _Relative = 0.2
    """Friction of the object, relative to its own."""
    link_mass: _Relative = 0.1
    """Mass of each link of the arm, relative to its own."""
    damping: _Relative = 0.3
    """Damping of each joint, relative to its own."""
    friction_nm: Annotated[float, Range(0, 10)] = 0.3
    """Dry friction of each joint, drawn from 0 to this torque in newton metres."""
    stiffness: _Relative = 0.1
    """Gain of each joint's position controller, relative to its own."""
    camera_position_m: Annotated[float, Range(0, 0.3)] = 0.01
    """Camera position, each axis."""
    camera_angle_rad: Annotated[float, Range(0, 0.5)] = 0.015
    """Camera orientation, each axis."""
    latency_share: Share = 0.0
    """Share of episodes in which every command takes effect one control step late, in the simulation of
    training; the rigs' arms have none."""


@dataclass(frozen=True)
class WorldConfig(Section, name="world"):
    """Scene, objects, randomisation."""

    objects: tuple[Text, ...] = contract.SEEN_OBJECTS
    """Objects, mixed in one batch (`ddgrasp objects list` names them all)."""
    backend: Backend = "cpu"
    """Physics: cpu (MuJoCo's C engine on all cores), jax (MJX) or warp (MJX-Warp, on an NVIDIA GPU)."""
    renderer: Renderer = "jax"
    """Pictures of training's scenes: jax (the project's ray caster) or warp (MJX-Warp's, on an NVIDIA GPU);
    the rigs draw by their own."""
    episode_steps: Annotated[int, Range(1, 10_000)] = 60
    """Control steps in an episode (10 Hz)."""
    sim_dt_s: Annotated[float, Range(0.0001, contract.CONTROL_DT_S)] = 0.005
    """Physics time step; must divide the control period of 0.1 s. Keep it at 5 ms or less: with 10 ms the
    fingers eject what they grasp. The rigs have 2.5 ms."""
    camera_scale: CameraScale = 0.25
    """Size of the depth camera's picture relative to 1280 x 720. For a RealSense at most 0.66: its stream is
    848 x 480."""
    reward: RewardConfig = field(default_factory=RewardConfig)
    random: RandomConfig = field(default_factory=RandomConfig)

    @property
    def profile(self) -> contract.CameraProfile:
        """The depth camera at this configuration's scale."""
        return contract.D455.scaled(self.camera_scale)

    def check(self) -> None:
        """See `Section.check`."""
        if len(set(self.objects)) < len(self.objects):
            raise self.error("objects", "each of them once")
        substeps = contract.CONTROL_DT_S / self.sim_dt_s
        if abs(substeps - round(substeps)) > 1e-6:
            raise self.error(
                "sim_dt_s", f"a step that divides the control period of {contract.CONTROL_DT_S:g} s, such as "
                "0.005, 0.004 or 0.002"
            )  # fmt: skip
