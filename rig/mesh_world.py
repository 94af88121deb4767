"""The development rig with the test rig's mesh objects on its table, and the camera before them. JAX-free.

The ray caster knows no meshes, so MuJoCo's own renderer draws.
"""

import xml.etree.ElementTree as ET
from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import Float, UInt8

from ddgrasp import contract
from mjx_envs import scene
from mjx_envs.camera import Buffers, Camera
from mjx_envs.object_spec import ObjectSpec
from rig.camera import RigCamera
from rig.fr3 import picture
from rig.fr3.picture import ScenePicture
from rig.meshes.bodies import MeshBody, make_body, place
from rig.world import SIM_DT_S, RigWorld


class MeshWorld(RigWorld):
    """The test rig's mesh objects under the same names; can and block lie in one pose only."""

    def _choose_pose(self, rng: np.random.Generator, spec: ObjectSpec) -> ObjectSpec:
        """See RigWorld; draws what it draws, so that a seed is the same trial in both."""
        super()._choose_pose(rng, spec)
        body = make_body(spec.name)
        return replace(
            spec, grasp_offset_m=body.grasp_offset_m, grasp_symmetry=body.grasp_symmetry, other_pose=None
        )

    def _put(self, seed: int, size: float, mass: float, friction: float) -> float:
        """See RigWorld; compiles a new model."""
        del seed
        body = scaled(make_body(self._spec.name), size, mass, friction)
        self.model = mesh_model(body)
        self.data = mujoco.MjData(self.model)
        return body.rest_height_m


class MeshCamera(RigCamera):
    """Looks at a model that `rig.fr3.picture.prepare` has seen; anew when `model` changes."""

    _picture: ScenePicture | None = None

    def rgb(self, data: mujoco.MjData, T_world_cam: Float[np.ndarray, "4 4"]) -> UInt8[np.ndarray, "H W 3"]:
        """See RigCamera."""
        return self._posed(data).rgb(self.pinhole(T_world_cam))

    def close(self) -> None:
        """See RigCamera."""
        if self._picture is not None:
            self._picture.close()
        self._picture = None

    def _draw(self, data: mujoco.MjData, camera: Camera) -> Buffers:
        return self._posed(data).buffers(camera)

    def _draw_depth(self, data: mujoco.MjData, camera: Camera) -> Float[np.ndarray, "H W"]:
        return self._posed(data).depth_m(camera)

    def _posed(self, data: mujoco.MjData) -> ScenePicture:
        if self._picture is None or self._picture.model is not self.model:
            self.close()
            self._picture = ScenePicture(self.model)
        self._picture.pose(data.qpos)
        return self._picture


def scaled(body: MeshBody, size: float, mass: float, friction: float) -> MeshBody:
    """`body` by relative factors of its length, mass and friction."""
    x, y, z = (size * offset for offset in body.grasp_offset_m)
    return replace(
        body,
        surfaces=tuple(replace(part, vertices_m=size * part.vertices_m) for part in body.surfaces),
        convex_m=tuple(size * part for part in body.convex_m),
        mass_kg=mass * body.mass_kg,
        friction=friction * body.friction,
        inertia_kg_m2=mass * size**2 * body.inertia_kg_m2,
        rest_height_m=size * body.rest_height_m,
        grasp_offset_m=(x, y, z),
    )


def mesh_model(body: MeshBody) -> mujoco.MjModel:
    """The scene with `body` in the place of the object; joints and actuators are in the same order."""
    root = ET.fromstring(scene.scene_xml(SIM_DT_S))
    world, sensors = root.find("worldbody"), root.find("sensor")
    assert world is not None and sensors is not None
    placed = world.find("body[@name='object']")
    assert placed is not None
    world.remove(placed)
    root.remove(sensors)  # they watch the slots
    picture.prepare(root)
    spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    place(body, spec.worldbody, contract.WORKSPACE_CENTER_M[0], 0.0)
    return spec.compile()
