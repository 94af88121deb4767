"""The development rig with one thing changed in its world: surroundings, table, controller. JAX-free.

Everything else of a trial follows from its seed as in `RigWorld`. For other shapes: `rig.mesh_world`.
"""

import xml.etree.ElementTree as ET
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.config import RandomConfig
from ddgrasp.layout import CONTROLS, QPOS
from mjx_envs import draws, scene
from rig.fr3.scene import FLOOR_Z_M, TABLE_CENTER_M, TABLE_HALF_M, add_surroundings
from rig.world import SIM_DT_S, RigWorld

DARK_RGBA = "0.2 0.15 0.1 1"
"""A table of dark wood."""


_CLUTTER = 1
"""Stream of a trial's seed that clutter is drawn from."""


class FurnishedWorld(RigWorld):
    """The test rig's table, which ends, its wall, and clutter that differs from trial to trial."""

    def _put(self, seed: int, size: float, mass: float, friction: float) -> float:
        """See RigWorld; compiles a new model."""
        rng = np.random.default_rng([seed, _CLUTTER])  # not the draws that make the object heavy or large
        self.model = scene.build_model(SIM_DT_S, self._layout, lambda root: _furnish(root, rng))
        self.data = mujoco.MjData(self.model)
        return super()._put(seed, size, mass, friction)


class DarkTableWorld(RigWorld):
    """A dark table."""

    def __init__(self, objects: Sequence[str], random: RandomConfig | None = None):
        """See RigWorld."""
        super().__init__(objects, random)
        self.model.geom("table").rgba[:] = [float(share) for share in DARK_RGBA.split()]


class SpringWorld(RigWorld):
    """The arm follows as `deploy.devices.franka_spring` lets it: weakly, about the middle of each step."""

    def __init__(
        self,
        objects: Sequence[str],
        random: RandomConfig | None,
        stiffness_nm_rad: Float[np.ndarray, "7"],
        damping_s: float,
    ):
        """`damping_s` is damping over stiffness."""
        self._stiffness_nm_rad, self._damping_s = stiffness_nm_rad, damping_s
        super().__init__(objects, random)
        self.model.actuator_ctrllimited[CONTROLS.arm] = 0  # the reference runs ahead of the joint

    def command(self, q_target_rad: Float[np.ndarray, "7"], close: bool) -> None:
        """See RigWorld. K (q_ref - q) + D (v_ref - v) with q_ref amid the step and v_ref the step's speed:
        one position, D / K v_ref further on."""
        q_rad = self.data.qpos[QPOS.arm]
        step = np.clip(q_target_rad, contract.JOINT_LOWER_RAD, contract.JOINT_UPPER_RAD) - q_rad
        super().command(q_target_rad, close)
        self.data.ctrl[CONTROLS.arm] = q_rad + step / 2 + self._damping_s * step / contract.CONTROL_DT_S

    def _set_dynamics(self, drawn: draws.Dynamics) -> None:
        super()._set_dynamics(drawn)
        arm, stiffness = np.arange(scene.N_ARM), self._stiffness_nm_rad
        self.model.actuator_gainprm[arm, 0] = stiffness
        self.model.actuator_biasprm[arm, 1:3] = np.outer(stiffness, (-1.0, -self._damping_s))


def _furnish(root: ET.Element, rng: np.random.Generator) -> None:
    """The table ends where the test rig's does; there is a floor below it, a wall behind, clutter on it."""
    world = root.find("worldbody")
    assert world is not None
    table = world.find("geom[@name='table']")
    assert table is not None
    table.attrib |= {"type": "box", "pos": scene.mjcf(TABLE_CENTER_M), "size": scene.mjcf(TABLE_HALF_M)}
    ET.SubElement(
        world, "geom", {"name": "floor", "type": "plane", "size": "0 0 1", "pos": f"0 0 {FLOOR_Z_M}"}
    )
    add_surroundings(world, rng)
