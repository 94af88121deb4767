"""The development rig's world: one Franka in MuJoCo's own C engine, at half the training's time step.

It stands in for reality: nothing that trains a student sees its ground truth, but for the bound that
`student.depth_source rig` is. JAX-free.
"""

from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float, Float64

from ddgrasp import contract
from ddgrasp.config import RandomConfig, WorldConfig
from ddgrasp.errors import unknown_name
from ddgrasp.layout import CONTROLS, QPOS
from mjx_envs import draws, grasp_math, scene
from mjx_envs.object_spec import ObjectSpec, slot_layout
from mjx_envs.objects import get_object

SIM_DT_S = 0.0025


class RigWorld:
    """One robot, one object, one table. `reset` first.

    Args:
      objects: names that `reset` may be asked for.
      random: half-ranges of what `reset` draws; the defaults without.
    """

    def __init__(self, objects: Sequence[str], random: RandomConfig | None = None):
        self.objects = {name: get_object(name) for name in objects}
        self._random = random or RandomConfig()
        self._layout = slot_layout(self.objects.values())
        self._base = scene.build_model(SIM_DT_S, self._layout)
        self.model = scene.build_model(SIM_DT_S, self._layout)
        self.data = mujoco.MjData(self.model)
        self._spec: ObjectSpec = next(iter(self.objects.values()))
        self._branch = 0.0
        self._hold_steps = 0

    def reset(self, seed: int, object_name: str) -> None:
        """A new trial: everything about it follows from `seed` and the object."""
        if object_name not in self.objects:
            raise unknown_name("object", object_name, self.objects)
        rng = np.random.default_rng(seed)
        self._spec = self._choose_pose(rng, self.objects[object_name])
        drawn = draws.dynamics(self._random, _units(rng))
        size, mass, friction = (float(f) for f in drawn[:3])
        rest_height_m = self._put(seed, size, mass, friction)
        self._set_dynamics(drawn)
        mujoco.mj_setConst(self.model, self.data)  # inertia that MuJoCo precomputes for free bodies
        mujoco.mj_resetData(self.model, self.data)
        self._set_pose(rng, rest_height_m)
        mujoco.mj_forward(self.model, self.data)
        self._branch = float(
            grasp_math.yaw_branch(self.data.qpos[QPOS.object_quat], self._spec.grasp_symmetry)
        )
        self._hold_steps = 0

    def state(self) -> tuple[Float64[np.ndarray, "7"], float]:
        """Arm joint positions (7,) rad and the gripper's opening (m)."""
        return self.data.qpos[QPOS.arm].copy(), float(self.data.qpos[QPOS.fingers].sum())

    def command(self, q_target_rad: Float[np.ndarray, "7"], close: bool) -> None:
        """Joint targets (7,) rad and whether to close the gripper; in force from the next `step`."""
        self.data.ctrl[CONTROLS.arm] = np.clip(
            q_target_rad, contract.JOINT_LOWER_RAD, contract.JOINT_UPPER_RAD
        )
        self.data.ctrl[CONTROLS.fingers] = 0.0 if close else contract.GRIPPER_MAX_WIDTH_M / 2

    def step(self, seconds: float) -> None:
        """Advance the physics; whole control periods count towards success."""
        for _ in range(round(seconds / contract.CONTROL_DT_S)):
            mujoco.mj_step(self.model, self.data, nstep=round(contract.CONTROL_DT_S / SIM_DT_S))
            mujoco.mj_kinematics(self.model, self.data)
            held = grasp_math.at_lift_target(self.data.qpos[QPOS.object_pos])
            self._hold_steps = self._hold_steps + 1 if held else 0

    def observation(self) -> Float[np.ndarray, "40"]:
        """(40,) what the teacher sees; for the teacher alone."""
        return grasp_math.observation(
            self.data.qpos, self.data.qvel, np.asarray(self._spec.grasp_symmetry), self._branch,
            np.log(self._spec.category_id), offset_m=np.asarray(self._spec.grasp_offset_m),
        )  # fmt: skip

    def grasped(self) -> bool:
        """Whether both pads press on the object while the hand is told to close: "held" in training."""
        touch_n = grasp_math.touch_from_sensors(self.data.sensordata, np)
        return bool((touch_n > grasp_math.TOUCH_N).all() and not self.data.ctrl[CONTROLS.fingers].any())

    @property
    def grasp_symmetry(self) -> int:
        """Yaws in a turn by which the object is grasped alike; 0: any."""
        return self._spec.grasp_symmetry

    def success(self) -> bool:
        """Whether the object has been at the lift target for the last HOLD_STEPS control steps."""
        return self._hold_steps >= contract.HOLD_STEPS

    def _put(self, seed: int, size: float, mass: float, friction: float) -> float:
        """Makes the object that of `self._spec`, by those factors; returns its origin's height at rest."""
        del seed
        scene.fill_slots(self.model, self._spec, self._layout, size, mass, friction)
        return self._spec.rest_height_m * size

    def _choose_pose(self, rng: np.random.Generator, spec: ObjectSpec) -> ObjectSpec:
        other = rng.random() < self._random.other_pose_share
        return spec.in_other_pose() if other and spec.other_pose is not None else spec

    def _set_dynamics(self, drawn: draws.Dynamics) -> None:
        base, model = self._base, self.model
        links = [model.body(link.name).id for link in scene.ARM_LINKS]
        model.body_mass[links] = base.body_mass[links] * drawn.link_mass
        model.body_inertia[links] = base.body_inertia[links] * drawn.link_mass[:, None]
        arm = np.arange(scene.N_ARM)
        model.dof_damping[arm] = base.dof_damping[arm] * drawn.damping
        model.dof_frictionloss[arm] = drawn.joint_friction_nm
        model.actuator_gainprm[arm, 0] = base.actuator_gainprm[arm, 0] * drawn.gain
        model.actuator_biasprm[arm, 1:3] = base.actuator_biasprm[arm, 1:3] * drawn.gain[:, None]

    def _set_pose(self, rng: np.random.Generator, rest_height_m: float) -> None:
        joints, xy = rng.uniform(-1, 1, scene.N_ARM), rng.uniform(-1, 1, 2)
        yaw = np.asarray(rng.uniform(-np.pi, np.pi))
        self.data.qpos[:] = draws.start_qpos(self._random, joints, xy, yaw, rest_height_m)
        self.command(self.data.qpos[QPOS.arm], close=False)


def make_world(config: WorldConfig, objects: Sequence[str] = ()) -> RigWorld:
    """The configured world, with the configured objects or `objects`."""
    return RigWorld(objects or config.objects, config.random)


def _units(rng: np.random.Generator) -> draws.Units:
    """The order of the draws is that of `draws.Units`; every seed's trial hangs on it."""
    arm = scene.N_ARM
    size, mass, friction = (rng.uniform(-1.0, 1.0, ()) for _ in range(3))
    link_mass, damping = rng.uniform(-1.0, 1.0, arm), rng.uniform(-1.0, 1.0, arm)
    joint_friction, stiffness = rng.uniform(size=arm), rng.uniform(-1.0, 1.0, arm)
    return draws.Units(size, mass, friction, link_mass, damping, joint_friction, stiffness)
