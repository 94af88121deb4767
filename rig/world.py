"""The pseudo-real rig's world: one Franka in MuJoCo's own C engine, at half the training's time step.

It stands in for reality: no stage that trains a student sees its ground truth. JAX-free.
"""

from collections.abc import Sequence

import mujoco
import numpy as np

from ddgrasp import contract
from ddgrasp.config import RandomConfig
from ddgrasp.errors import unknown_name
from ddgrasp.layout import CONTROLS, QPOS
from mjx_envs import grasp_math, kinematics, scene
from mjx_envs.objects import ObjectSpec, get_object, slot_layout

SIM_DT_S = 0.0025


class RigWorld:
    """One robot, one object, one table. `reset` first.

    Args:
      objects: names that `reset` may be asked for.
      randomise: draw sizes, masses, frictions and dynamics within `random`; poses are always drawn.
      random: half-ranges of what is drawn.
    """

    def __init__(self, objects: Sequence[str], randomise: bool = True, random: RandomConfig | None = None):
        self.objects = {name: get_object(name) for name in objects}
        self._random = random or RandomConfig()
        self._randomise = randomise
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
        size = self._set_object(rng)
        self._set_dynamics(rng)
        mujoco.mj_setConst(self.model, self.data)  # inertia that MuJoCo precomputes for free bodies
        mujoco.mj_resetData(self.model, self.data)
        self._set_pose(rng, self._spec.rest_height_m * size)
        mujoco.mj_forward(self.model, self.data)
        self._branch = float(
            grasp_math.yaw_branch(self.data.qpos[QPOS.object_quat], self._spec.grasp_symmetry)
        )
        self._hold_steps = 0

    def state(self) -> tuple[np.ndarray, float]:
        """Arm joint positions (7,) rad and the gripper's opening (m)."""
        return self.data.qpos[QPOS.arm].copy(), float(self.data.qpos[QPOS.fingers].sum())

    def command(self, q_target_rad: np.ndarray, close: bool) -> None:
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
            self._hold_steps = self._hold_steps + 1 if self._held() else 0

    def observation(self) -> np.ndarray:
        """(40,) what the teacher sees; for the teacher alone."""
        return grasp_math.observation(
            self.data.qpos, self.data.qvel, np.asarray(self._spec.grasp_symmetry), self._branch,
            np.log(self._spec.category_id), offset_m=np.asarray(self._spec.grasp_offset_m),
        )  # fmt: skip

    def success(self) -> bool:
        """Whether the object has been at the lift target for the last HOLD_STEPS control steps."""
        return self._hold_steps >= contract.HOLD_STEPS

    def _held(self) -> bool:
        away_m = np.linalg.norm(self.data.qpos[QPOS.object_pos] - np.array(contract.LIFT_TARGET_M))
        return bool(away_m < contract.LIFT_TOLERANCE_M)

    def _around(self, rng: np.random.Generator, half_range: float, shape=()) -> np.ndarray:
        scale = half_range if self._randomise else 0.0
        return 1.0 + scale * rng.uniform(-1.0, 1.0, shape)

    def _choose_pose(self, rng: np.random.Generator, spec: ObjectSpec) -> ObjectSpec:
        other = rng.random() < self._random.other_pose_share
        return spec.in_other_pose() if other and spec.other_pose is not None else spec

    def _set_object(self, rng: np.random.Generator) -> float:
        random = self._random
        ranges = (random.size, random.object_mass, random.object_friction)
        size, mass, friction = (float(self._around(rng, half_range)) for half_range in ranges)
        scene.fill_slots(self.model, self._spec, self._layout, size, mass, friction)
        return size

    def _set_dynamics(self, rng: np.random.Generator) -> None:
        base, model, random = self._base, self.model, self._random
        links = [model.body(link.name).id for link in scene.ARM_LINKS]
        factor = self._around(rng, random.link_mass, len(links))
        model.body_mass[links] = base.body_mass[links] * factor
        model.body_inertia[links] = base.body_inertia[links] * factor[:, None]
        arm = np.arange(scene.N_ARM)
        model.dof_damping[arm] = base.dof_damping[arm] * self._around(rng, random.damping, scene.N_ARM)
        if self._randomise:
            model.dof_frictionloss[arm] = random.friction_nm * rng.uniform(size=scene.N_ARM)
        gain = self._around(rng, random.stiffness, scene.N_ARM)
        model.actuator_gainprm[arm, 0] = base.actuator_gainprm[arm, 0] * gain
        model.actuator_biasprm[arm, 1:3] = base.actuator_biasprm[arm, 1:3] * gain[:, None]

    def _set_pose(self, rng: np.random.Generator, rest_height_m: float) -> None:
        q = np.array(scene.HOME_RAD) + self._random.joint_rad * rng.uniform(-1, 1, scene.N_ARM)
        half = np.array(contract.WORKSPACE_SIZE_M) / 2
        xy = np.array(contract.WORKSPACE_CENTER_M) + half * rng.uniform(-1, 1, 2)
        yaw = rng.uniform(-np.pi, np.pi)
        self.data.qpos[QPOS.arm] = q
        self.data.qpos[QPOS.fingers] = contract.GRIPPER_MAX_WIDTH_M / 2
        self.data.qpos[QPOS.object_pos] = (*xy, rest_height_m)
        self.data.qpos[QPOS.object_quat] = kinematics.quat_about_z(np.asarray(yaw))
        self.command(q, close=False)
