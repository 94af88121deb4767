"""MuJoCo Playground's PandaPickCube on a robot without meshes.

Playground takes its robot's file from a checkout of MuJoCo Menagerie, which cannot be downloaded everywhere.
Here it gets one of the same chain, masses, joints, gains and colliding geoms (hand capsule, two finger pads)
and no meshes, which spares it the poses of some seventy geoms that are only drawn. Environment, scene, solver
settings, observation and reward are Playground's own.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import jax
from mujoco.mjx._src import scan
from mujoco_playground import MjxEnv, State, manipulation

from ddgrasp import contract
from mjx_envs import scene

ARM_JOINTS = tuple(f"joint{i}" for i in range(1, 8))
FINGER_JOINTS = ("finger_joint1", "finger_joint2")
"""Names that Playground looks for."""
_GAINS = ((1000, 20), (1000, 20), (750, 4), (750, 4), (300, 2), (300, 2), (300, 2))
"""Stiffness and damping of the position controllers, as Menagerie has them for MJX."""
_JOINT_DAMPING = (40, 40, 40, 40, 2, 2, 2)
_CONTACT = 'condim="3" solimp="0.99 0.995 0.01" solref="0.01 1" friction="1 0.005 0.0001"'


def make_env() -> MjxEnv:
    """PandaPickCube at its default configuration (50 Hz control, four substeps of 5 ms) on MJX-JAX."""
    pick = manipulation.panda_pick
    scenes = Path(pick.__file__).parent / "xmls"
    assets = {path.name: path.read_bytes() for path in scenes.glob("*.xml")}
    assets["mjx_panda.xml"] = _robot_xml().encode()
    with mock.patch.object(pick.panda, "get_assets", lambda: assets):
        return pick.PandaPickCube(config_overrides={"impl": "jax"})


class WithBarriers:
    """Playground's environment with a barrier between a link and the next, the cure of `docs/physics.md`.

    Faster than without XLA's fusion emitters, which only a flag of older versions turns off.
    """

    def __init__(self, env: MjxEnv):
        self._env = env
        self.action_size = env.action_size

    def reset(self, rng: jax.Array) -> State:
        """As the environment's."""
        with _barriers():
            return self._env.reset(rng)

    def step(self, state: State, action: jax.Array) -> State:
        """As the environment's."""
        with _barriers():
            return self._env.step(state, action)


@contextmanager
def _barriers() -> Iterator[None]:
    """While MJX is traced, every body waits for its parent."""
    body_tree = scan.body_tree

    def apart(model: Any, function: Any, *arguments: Any, **options: Any) -> Any:
        def waiting(parent: Any, *rest: Any) -> Any:
            return function(parent if parent is None else jax.lax.optimization_barrier(parent), *rest)

        return body_tree(model, waiting, *arguments, **options)

    with mock.patch.object(scan, "body_tree", apart):
        yield


def _robot_xml() -> str:
    fingers = "".join(
        f"""
      <body name="{side}_finger" pos="{_text(scene.FINGER_POS_M)}" quat="{quat}">
        <inertial mass="0.015" pos="0 0 0" diaginertia="2.4e-6 2.4e-6 7.5e-7"/>
        <joint name="{joint}" type="slide" axis="0 1 0" range="0 0.04" damping="10" armature="0.1"/>
        <geom name="{side}_finger_pad" type="box" size="0.00875 0.0076 0.00825" pos="0 0.0076 0.045"
              contype="0" conaffinity="3" {_CONTACT}/>
      </body>"""
        for side, quat, joint in zip(("left", "right"), ("1 0 0 0", "0 0 0 1"), FINGER_JOINTS, strict=True)
    )
    body = f"""
    <body name="hand" pos="{_text(scene.HAND_POS_M)}" quat="{_text(scene.HAND_QUAT)}">
      <inertial mass="0.73" pos="-0.01 0 0.03" diaginertia="0.001 0.0025 0.0017"/>
      <geom name="hand_capsule" type="capsule" size="0.04 0.06" quat="1 1 0 0" pos="0 0 0.03"
            contype="0" conaffinity="1"/>
      <site name="gripper" pos="0 0 0.1"/>{fingers}
    </body>"""
    actuators = f'<general joint="{FINGER_JOINTS[0]}" ctrlrange="0 0.04" biastype="affine" '
    actuators += 'gainprm="350 0 0" biasprm="0 -350 -10" forcerange="-200 200"/>'
    for i in reversed(range(scene.N_ARM)):
        link, joint, (kp, kv) = scene.ARM_LINKS[i], ARM_JOINTS[i], _GAINS[i]
        limits = f"{contract.JOINT_LOWER_RAD[i]} {contract.JOINT_UPPER_RAD[i]}"
        force = scene.ARM_TORQUE_LIMIT_NM[i]
        body = f"""
    <body name="{link.name}" pos="{_text(link.pos_m)}" quat="{_text(link.quat)}">
      <inertial mass="{link.mass_kg}" pos="{_text(link.com_m)}"
                fullinertia="{_text(link.fullinertia_kg_m2)}"/>
      <joint name="{joint}" axis="0 0 1" range="{limits}" damping="{_JOINT_DAMPING[i]}" armature="0.1"/>
      {body}
    </body>"""
        actuators = (
            f'<position joint="{joint}" kp="{kp}" kv="{kv}" ctrlrange="{limits}" '
            f'forcerange="-{force} {force}"/>{actuators}'
        )
    left, right = FINGER_JOINTS
    return f"""
<mujoco model="panda without meshes">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>{body}
  </worldbody>
  <equality>
    <joint joint1="{left}" joint2="{right}" solimp="0.95 0.99 0.001" solref="0.005 1"/>
  </equality>
  <actuator>{actuators}</actuator>
</mujoco>
"""


def _text(values) -> str:
    return " ".join(str(value) for value in values)
