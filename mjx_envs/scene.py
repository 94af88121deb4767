"""The scene: a Franka arm with its parallel gripper, a table, and one object body with slots. JAX-free.

Kinematics and limits: Franka's published Denavit-Hartenberg table and interface specification.
Link masses, centres of mass and inertias: Gaz, Cognetti, Oliva, Robuffo Giordano, De Luca, "Dynamic
Identification of the Franka Emika Panda Robot", RA-L 2019. Geometry is our own: primitives only.
"""

import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from types import ModuleType

import mujoco
import numpy as np
from jaxtyping import Bool, Float

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from ddgrasp.layout import CONTROLS, QPOS, QVEL
from mjx_envs.object_spec import DEFAULT_SLOTS, PAD_HALF_WIDTH_M, ObjectSpec, SlotLayout
from mjx_envs.objects import OBJECTS

_S = 0.7071067811865476  # cos 45 degrees


@dataclass(frozen=True)
class Link:
    """A body of the chain: pose in its parent, inertia, rendered geoms (MJCF attributes)."""

    name: str
    pos_m: tuple[float, float, float]
    quat: tuple[float, float, float, float]
    mass_kg: float
    com_m: tuple[float, float, float]
    fullinertia_kg_m2: tuple[float, float, float, float, float, float]
    geoms: tuple[str, ...]


ARM_LINKS = (
    Link("link1", (0, 0, 0.333), (1, 0, 0, 0), 4.970684, (0.003875, 0.002081, -0.04762),
         (0.70337, 0.70661, 0.0091170, -0.00013900, 0.0067720, 0.019169),
         ('type="capsule" fromto="0 0 -0.19 0 0 -0.02" size="0.062"',
          'type="capsule" fromto="0 -0.06 0 0 0.06 0" size="0.062"')),
    Link("link2", (0, 0, 0), (_S, -_S, 0, 0), 0.646926, (-0.003141, -0.02872, 0.003495),
         (0.0079620, 0.028110, 0.025995, -0.003925, 0.010254, 0.000704),
         ('type="capsule" fromto="0 -0.08 0 0 -0.2 0" size="0.06"',)),
    Link("link3", (0, -0.316, 0), (_S, _S, 0, 0), 3.228604, (0.027518, 0.039252, -0.066502),
         (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805),
         ('type="capsule" fromto="0 0 -0.1 0.04 0 -0.02" size="0.058"',
          'type="capsule" fromto="0.0825 -0.04 0 0.0825 0.04 0" size="0.056"')),
    Link("link4", (0.0825, 0, 0), (_S, _S, 0, 0), 3.587895, (-0.05317, 0.104419, 0.027454),
         (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641),
         ('type="capsule" fromto="-0.04 0.04 0 -0.0825 0.12 0" size="0.055"',)),
    Link("link5", (-0.0825, 0.384, 0), (_S, -_S, 0, 0), 1.225946, (-0.011953, 0.041065, -0.038437),
         (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229),
         ('type="capsule" fromto="0 0 -0.25 0 0.03 -0.12" size="0.052"',
          'type="capsule" fromto="0 0.06 -0.1 0 0.02 0" size="0.045"')),
    Link("link6", (0, 0, 0), (_S, _S, 0, 0), 1.666555, (0.060149, -0.014117, -0.010517),
         (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341),
         ('type="capsule" fromto="0 0 -0.03 0.07 0 0.0" size="0.047"',)),
    Link("link7", (0.088, 0, 0), (_S, _S, 0, 0), 0.735522, (0.010517, -0.004252, 0.061597),
         (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741),
         ('type="cylinder" fromto="0 0 0.03 0 0 0.107" size="0.042"',)),
)  # fmt: skip

HAND_POS_M = (0.0, 0.0, 0.107)
HAND_QUAT = (0.9238795325112867, 0.0, 0.0, -0.3826834323650898)
FINGER_POS_M = (0.0, 0.0, 0.0584)
GRIP_POS_M = (0.0, 0.0, 0.1034)
"""Site between the finger pads, in the hand frame; z points out of the hand, fingers open along y."""

ARM_GAIN_NM_RAD = (3000.0, 3000.0, 3000.0, 2500.0, 2500.0, 2000.0, 2000.0)
"""Stiffness of libfranka's internal joint impedance controller in its examples."""
ARM_DAMPING_NMS_RAD = (140.0, 140.0, 120.0, 110.0, 60.0, 50.0, 50.0)
ARM_ARMATURE_KG_M2 = 0.3
"""Damping is near critical and stays below inertia / time step: the constraint solver does not know
of implicit damping, and beyond that bound grasped objects were thrown."""
ARM_TORQUE_LIMIT_NM = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
"""Joint torque limits: Franka's interface specification."""
FINGER_GAIN_N_M = 2000.0
FINGER_FORCE_LIMIT_N = 20.0
FINGER_DAMPING_NS_M = 400.0
FINGER_ARMATURE_KG = 2.5
"""Force over damping is the Franka Hand's speed, 50 mm/s per finger (its datasheet): 8 cm take 0.8 s. The
inertia keeps the damping below inertia / time step, as for the arm."""
PAD_FRICTION = 1.0
JOINT_DAMPING_NMS_RAD = 1.0

CONTACTS_PER_CAPSULE = 3
"""Contacts that MJX-JAX holds for each capsule among the slots, the deepest ones of all (`max_contacts`). It
computes as many, touching or not, so that 60 cost 257 constraint rows where 12, those of the default slots,
cost 65. The C engine and MJX-Warp do not read it. An object at rest has no more than 4 of its box and 2 of
each capsule; in the guide's grasp a cube has 12 and a ring, of eight capsules, 24.

MJX can also cap the pairs of geoms (`max_geom_pairs`), but it keeps those whose bounding spheres are closest,
and the hand's is so large (11 cm) that its pairs would push out those of the pads."""

N_ARM, N_ROBOT = QPOS.arm.stop, QPOS.fingers.stop
NQ, NV, NU = QPOS.size, QVEL.size, CONTROLS.size


def _arm_xml(depth: int = 0) -> str:
    """Nested bodies of the arm, hand and fingers."""
    if depth == len(ARM_LINKS):
        return _hand_xml()
    link = ARM_LINKS[depth]
    lower, upper = contract.JOINT_LOWER_RAD[depth], contract.JOINT_UPPER_RAD[depth]
    geoms = "".join(f'<geom class="arm" {g}/>' for g in link.geoms)
    return f"""
    <body name="{link.name}" pos="{mjcf(link.pos_m)}" quat="{mjcf(link.quat)}" gravcomp="1">
      <inertial mass="{link.mass_kg}" pos="{mjcf(link.com_m)}" fullinertia="{mjcf(link.fullinertia_kg_m2)}"/>
      <joint name="{contract.ARM_JOINTS[depth]}" axis="0 0 1" range="{lower} {upper}"
             damping="{JOINT_DAMPING_NMS_RAD}" frictionloss="0.1" armature="{ARM_ARMATURE_KG_M2}"/>
      {geoms}{_arm_xml(depth + 1)}
    </body>"""


def _hand_xml() -> str:
    fingers = ""
    for name, joint, quat in (
        ("left_finger", contract.FINGER_JOINTS[0], "1 0 0 0"),
        ("right_finger", contract.FINGER_JOINTS[1], "0 0 0 1"),
    ):
        fingers += f"""
      <body name="{name}" pos="{mjcf(FINGER_POS_M)}" quat="{quat}" gravcomp="1">
        <inertial mass="0.015" pos="0 0.01 0.025" diaginertia="3e-6 3e-6 1e-6"/>
        <joint name="{joint}" type="slide" axis="0 1 0" range="0 0.04" damping="{FINGER_DAMPING_NS_M}"
               armature="{FINGER_ARMATURE_KG}"/>
        <geom class="arm" type="box" size="0.009 0.009 0.013" pos="0 0.012 0.013" rgba="0.2 0.2 0.2 1"/>
        <geom name="{name}_pad" class="pad" type="box" size="{PAD_HALF_WIDTH_M} 0.005 0.0155"
              pos="0 0.005 0.0415"/>
      </body>"""
    return f"""
    <body name="hand" pos="{mjcf(HAND_POS_M)}" quat="{mjcf(HAND_QUAT)}" gravcomp="1">
      <inertial mass="0.73" pos="-0.01 0 0.03" diaginertia="0.001 0.0025 0.0017"/>
      <geom class="arm" type="cylinder" fromto="0 0 -0.005 0 0 0.025" size="0.04"/>
      <geom name="hand_box" class="hand" type="box" size="0.031 0.102 0.02" pos="0 0 0.043"/>
      <site name="grip" pos="{mjcf(GRIP_POS_M)}"/>{fingers}
    </body>"""


def _object_xml(layout: SlotLayout) -> str:
    cube = OBJECTS["cube"]
    slots = "".join(
        f'<geom name="{n}" class="{"" if n in layout.colliding_names else "drawn_"}slot" type="{k}" '
        f'size="{mjcf(s)}" pos="{mjcf(p)}" quat="{mjcf(q)}"/>'
        for n, k, s, p, q in zip(layout.names, layout.kinds, *cube.slot_arrays(layout), strict=True)
    )
    return f"""
    <body name="object" pos="{contract.WORKSPACE_CENTER_M[0]} 0 {cube.rest_height_m}">
      <joint name="object" type="free" damping="0.0005"/>
      <inertial mass="{cube.mass_kg}" pos="0 0 0" diaginertia="{mjcf(cube.inertia_kg_m2())}"/>
      {slots}
    </body>"""


def _actuators_xml() -> str:
    arm = "".join(
        f'<position joint="{j}" kp="{kp}" kv="{kv}" forcerange="-{f} {f}" ctrlrange="{lo} {hi}"/>'
        for j, kp, kv, f, lo, hi in zip(
            contract.ARM_JOINTS, ARM_GAIN_NM_RAD, ARM_DAMPING_NMS_RAD, ARM_TORQUE_LIMIT_NM,
            contract.JOINT_LOWER_RAD, contract.JOINT_UPPER_RAD, strict=True,
        )
    )  # fmt: skip
    fingers = "".join(
        f'<position joint="{j}" kp="{FINGER_GAIN_N_M}" ctrlrange="0 0.04" '
        f'forcerange="-{FINGER_FORCE_LIMIT_N} {FINGER_FORCE_LIMIT_N}"/>'
        for j in contract.FINGER_JOINTS
    )
    return arm + fingers


def _touch_xml(layout: SlotLayout) -> str:
    """Force of the strongest contact of each finger pad with each slot: MJX matches geoms only."""
    return "".join(
        f'<contact geom1="{side}_finger_pad" geom2="{slot}" data="force" reduce="maxforce" num="1"/>'
        for side in ("left", "right")
        for slot in layout.colliding_names
    )


def scene_xml(sim_dt_s: float = 0.005, layout: SlotLayout = DEFAULT_SLOTS) -> str:
    """MJCF of the whole scene, the cube in the object's slots.

    The solver rarely needs more than two iterations; capped at ten, a lying banana was thrown about.
    """
    return f"""
<mujoco model="franka_table">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="{sim_dt_s}" integrator="implicitfast" cone="elliptic" impratio="10"
          iterations="50" ls_iterations="50"><flag eulerdamp="disable" midphase="disable"/></option>
  <default>
    <default class="arm"><geom contype="0" conaffinity="0" group="1" rgba="0.92 0.92 0.92 1"/></default>
    <default class="hand"><geom contype="1" conaffinity="0" group="1" rgba="0.85 0.85 0.85 1"/></default>
    <default class="pad">
      <geom contype="1" conaffinity="0" group="1" condim="4"
            friction="{PAD_FRICTION} 0.01 0.0001" solref="{2 * sim_dt_s} 1" rgba="0.15 0.15 0.15 1"/>
    </default>
    <default class="slot">
      <geom contype="1" conaffinity="1" group="1" condim="4" priority="1" friction="0.9 0.005 0.0001"
            solref="{2 * sim_dt_s} 1"/>
    </default>
    <default class="drawn_slot"><geom contype="0" conaffinity="0" group="1"/></default>
  </default>
  <custom><numeric name="max_contact_points" data="{max_contacts(layout)}"/></custom>
  <visual><global offwidth="1280" offheight="720"/><map znear="0.02" zfar="20"/></visual>
  <worldbody>
    <light pos="0.6 -0.6 2" dir="-0.1 0.3 -1" directional="true"/>
    <geom name="table" type="plane" size="0 0 1" contype="0" conaffinity="1" group="1" condim="4"
          friction="0.7 0.005 0.0001" rgba="0.55 0.5 0.45 1"/>
    <body name="link0">
      <geom class="arm" type="capsule" fromto="-0.05 0 0.05 0.0 0 0.07" size="0.07"/>
      {_arm_xml()}
    </body>
    {_object_xml(layout)}
  </worldbody>
  <equality>
    <joint joint1="{contract.FINGER_JOINTS[0]}" joint2="{contract.FINGER_JOINTS[1]}" solref="{2 * sim_dt_s} 1"
           solimp="0.95 0.99 0.001"/>
  </equality>
  <actuator>{_actuators_xml()}</actuator>
  <sensor>
    {_touch_xml(layout)}
  </sensor>
</mujoco>"""


def build_model(
    sim_dt_s: float = 0.005,
    layout: SlotLayout = DEFAULT_SLOTS,
    edit: Callable[[ET.Element], None] = lambda scene: None,
) -> mujoco.MjModel:
    """A new compiled model; change it freely. `edit` may change the MJCF before."""
    root = ET.fromstring(scene_xml(sim_dt_s, layout))
    edit(root)
    model = mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))
    _widen_object_bounds(model)
    return model


def max_contacts(layout: SlotLayout) -> int:
    """Contacts that MJX-JAX holds in a scene with `layout`."""
    return CONTACTS_PER_CAPSULE * layout.capsules


def slot_ids(model: mujoco.MjModel) -> np.ndarray:
    """(S,) geom ids of the object's slots, in the layout's order."""
    body = model.body("object").id
    return model.body_geomadr[body] + np.arange(model.body_geomnum[body])


def fill_slots(
    model: mujoco.MjModel,
    spec: ObjectSpec,
    layout: SlotLayout,
    size: float = 1.0,
    mass: float = 1.0,
    friction: float = 1.0,
) -> None:
    """Makes the object of `model` (built with `layout`) that of `spec`; the rest are relative factors.

    `mujoco.mj_setConst` must follow: MuJoCo precomputes inertia for free bodies.
    """
    slots, body = slot_ids(model), model.body("object").id
    made = spec.model(layout).scaled(size, mass, friction)
    model.geom_size[slots], model.geom_pos[slots], model.geom_quat[slots] = made[:3]
    model.geom_rbound[slots] = slot_bounding_radii(made.slot_size, np.array(layout.kinds) == "capsule")
    model.geom_friction[slots, 0] = made.friction
    model.geom_rgba[slots, :3] = spec.slot_rgb(layout)
    model.body_mass[body] = made.mass_kg
    model.body_inertia[body] = made.inertia_kg_m2


def slot_bounding_radii(
    size: Float[AnyArray, "*batch slots 3"], is_capsule: Bool[np.ndarray, " slots"], xp: ModuleType = np
) -> Float[AnyArray, "*batch slots"]:
    """(..., S) radii of spheres that hold slots of `size` (..., S, 3); `is_capsule` (S,) bool."""
    return xp.sqrt(xp.sum(size**2, axis=-1)) + size[..., 1] * is_capsule


def _widen_object_bounds(model: mujoco.MjModel) -> None:
    """Make the compiler's shortcuts hold for every object the slots can take.

    Collision filters: the bounding boxes of the body and of its geoms. Kinematics: `geom_sameframe`
    marks geoms that the compiler found centred in their body, whose pose MuJoCo then does not read.
    """
    body = model.body("object").id
    slots = slot_ids(model)
    model.geom_sameframe[slots] = 0
    model.geom_aabb[slots] = [0.0, 0.0, 0.0, 0.15, 0.15, 0.15]
    first, count = model.body_bvhadr[body], model.body_bvhnum[body]
    model.bvh_aabb[first : first + count] = [0.0, 0.0, 0.0, 0.15, 0.15, 0.15]


def mjcf(values: Iterable[float]) -> str:
    """Values as an attribute of MuJoCo's model files has them: nine digits, apart by spaces."""
    return " ".join(f"{float(v):.9g}" for v in values)
