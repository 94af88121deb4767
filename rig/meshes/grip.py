"""Whether the hand can hold an object: down from above, close, up, wait. JAX-free.

The hand is that of `mjx_envs/scene.py` on a vertical slide, in MuJoCo's C engine; no arm, no policy.
"""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float64

from ddgrasp import contract
from mjx_envs import scene
from mjx_envs.grasp_math import HAND_DOWN, MIN_GRIP_HEIGHT_M
from rig.meshes.bodies import MeshBody, place

SIM_DT_S = 0.0025
CLEARANCE_M = 0.15
"""Between the grip's place before it descends and where it closes."""
LIFT_M = 0.20
SETTLE_S, DESCEND_S, CLOSE_S, LIFT_S, HOLD_S = 1.0, 1.0, 0.7, 1.5, 2.0
_OPTIONS = ("timestep", "integrator", "cone", "impratio", "iterations", "ls_iterations")
_SLIDE_GAIN_N_M, _SLIDE_DAMPING_NS_M = 20000.0, 1500.0


@dataclass(frozen=True)
class Grip:
    """What became of one attempt."""

    settled_m: float
    """How far the object moved by itself before it was touched."""
    settled_rad: float
    """How far it turned."""
    width_m: float
    """Between the fingers after closing."""
    risen_m: float
    """How far the object rose with the hand's `LIFT_M`."""
    slipped_m: float
    """How far it moved against the hand during the last `HOLD_S`."""

    @property
    def held(self) -> bool:
        """Risen with the hand to 1 cm, still in it, and not slipping by more than 5 mm."""
        return self.risen_m > LIFT_M - 0.01 and self.slipped_m < 0.005 and self.width_m > 0.002


class GripCheck:
    """A table, one object and a hand above its grip that opens along the object's y axis."""

    def __init__(self, body: MeshBody):
        self._grip_height_m = max(body.rest_height_m + body.grasp_offset_m[2], MIN_GRIP_HEIGHT_M)
        x, y, _ = body.grasp_offset_m
        spec = _hand_spec()
        place(body, spec.worldbody, -x, -y)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._slide = self.model.joint("slide").qposadr[0]
        self.data.qpos[self._slide] = self._grip_height_m + CLEARANCE_M
        self._object = slice(adr := self.model.joint("object").qposadr[0], adr + 7)
        self._fingers = [self.model.joint(f"trained_{name}").qposadr[0] for name in contract.FINGER_JOINTS]
        self.data.qpos[self._fingers] = contract.GRIPPER_MAX_WIDTH_M / 2

    def run(self) -> Grip:
        """One attempt, `SETTLE_S` after the object is put down."""
        opened = contract.GRIPPER_MAX_WIDTH_M / 2
        above, low = self._grip_height_m + CLEARANCE_M, self._grip_height_m
        put = self._pose()
        self._move(above, above, opened, SETTLE_S)
        settled = self._pose()
        self._move(above, low, opened, DESCEND_S)
        self._move(low, low, 0.0, CLOSE_S)
        width_m = float(self.data.qpos[self._fingers].sum())
        self._move(low, low + LIFT_M, 0.0, LIFT_S)
        lifted, hand_m = self._pose(), float(self.data.qpos[self._slide])
        self._move(low + LIFT_M, low + LIFT_M, 0.0, HOLD_S)
        held, sunk = self._pose(), np.array([0.0, 0.0, self.data.qpos[self._slide] - hand_m])
        turned = 2 * np.arccos(min(1.0, abs(float(put[3:] @ settled[3:]))))
        return Grip(
            float(np.linalg.norm(settled[:3] - put[:3])), float(turned), width_m,
            float(held[2] - settled[2]), float(np.linalg.norm(held[:3] - lifted[:3] - sunk)),
        )  # fmt: skip

    def _pose(self) -> Float64[np.ndarray, "7"]:
        return self.data.qpos[self._object].copy()

    def _move(self, start_m: float, end_m: float, finger_m: float, seconds: float) -> None:
        """The grip from height `start_m` to `end_m`, smoothly; the fingers' targets jump."""
        steps = round(seconds / SIM_DT_S)
        for i in range(steps):
            share = 0.5 - 0.5 * np.cos(np.pi * (i + 1) / steps)
            self.data.ctrl[:] = [finger_m, finger_m, start_m + share * (end_m - start_m)]
            mujoco.mj_step(self.model, self.data)


def _hand_spec() -> mujoco.MjSpec:
    """A table and the training scene's hand and solver, on a slide whose position is the grip's height."""
    trained, spec = mujoco.MjSpec.from_string(scene.scene_xml(SIM_DT_S)), mujoco.MjSpec()
    for option in _OPTIONS:
        setattr(spec.option, option, getattr(trained.option, option))
    spec.visual.map.znear, spec.visual.map.zfar = trained.visual.map.znear, trained.visual.map.zfar
    spec.worldbody.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], condim=4)
    carriage = spec.worldbody.add_body(name="carriage", mass=1.0, inertia=[0.01] * 3, explicitinertial=True)
    carriage.gravcomp = 1.0
    carriage.add_joint(
        name="slide", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1], damping=_SLIDE_DAMPING_NS_M
    )
    hand = trained.body("hand")
    hand.pos, hand.quat = [0, 0, 0], [1, 0, 0, 0]
    carriage.add_frame(pos=[0, 0, scene.GRIP_POS_M[2]], quat=HAND_DOWN).attach_body(hand, "trained_", "")
    lift = spec.add_actuator(name="slide", target="slide", trntype=mujoco.mjtTrn.mjTRN_JOINT)
    lift.set_to_position(kp=_SLIDE_GAIN_N_M)
    return spec
