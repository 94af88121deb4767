"""What can be otherwise than in the development rig, one thing at a time: where a policy loses, by cause."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float

from ddgrasp.config import Config

if TYPE_CHECKING:
    from rig.camera import RigCamera
    from rig.world import RigWorld

WorldName = Literal["as it is", "meshes", "furniture", "dark table", "spring"]
SightName = Literal["stereo", "ideal", "full size", "holes", "values", "ripple", "mismatches"]
_STREAM = 0x4F6666
"""Keeps the direction in which a camera is off apart from every other random number ("Off")."""


@dataclass(frozen=True)
class Change:
    """The development rig, but for this."""

    world: WorldName = "as it is"
    """meshes (the test rig's objects), furniture (its table's end, wall and clutter), dark table, or spring
    (the arm follows as the Franka driver's spring has it at full stiffness)."""
    sight: SightName = "stereo"
    """stereo (matched at the policy's size), ideal (no errors), full size (matched at 848x480), or one
    kind of stereo's errors alone (rig/camera_errors.py)."""
    off: tuple[float, float] = (0.0, 0.0)
    """How far the camera stands from where the trial says, in a random direction: metres, degrees."""

    def make_world(self, config: Config) -> "RigWorld":
        """The world of the trials."""
        from rig import other_worlds
        from rig.world import make_world

        objects, random = config.world.objects, config.world.random
        match self.world:
            case "meshes":
                from rig.mesh_world import MeshWorld

                return MeshWorld(objects, random)
            case "furniture":
                return other_worlds.FurnishedWorld(objects, random)
            case "dark table":
                return other_worlds.DarkTableWorld(objects, random)
            case "spring":
                from deploy.devices.franka_spring import DAMPING_S, WEIGHTS

                stiffness = config.deploy.franka.stiffness_nm_rad * WEIGHTS
                return other_worlds.SpringWorld(objects, random, stiffness, DAMPING_S)
        return make_world(config.world)

    def make_camera(self, config: Config, world: "RigWorld") -> "RigCamera":
        """The camera before `world`."""
        from rig.camera import make_camera
        from rig.camera_errors import ERRORS, PartlyWrongCamera

        if self.sight == "full size":
            from deploy.full_size import FullSizeCamera

            return FullSizeCamera(world.model, config.record.stereo, config.world.profile)
        if self.sight in ERRORS:
            return PartlyWrongCamera(world.model, config.record.stereo, config.world.profile, self.sight)
        if self.world == "meshes":
            from rig.mesh_world import MeshCamera

            ideal = self.sight == "ideal"
            return MeshCamera(world.model, config.record.stereo, config.world.profile, ideal)
        return make_camera(config, world, ideal=self.sight == "ideal")

    def displaced(self, T_world_cam: Float[np.ndarray, "4 4"], seed: int) -> Float[np.ndarray, "4 4"]:
        """(4, 4) where the camera stands instead of `T_world_cam`; the direction follows from `seed`."""
        from mjx_envs import draws, kinematics

        metres, degrees = self.off
        if not metres and not degrees:
            return T_world_cam
        shift, axis = np.random.default_rng([_STREAM, seed]).normal(size=(2, 3))
        shift_m = metres * shift / np.linalg.norm(shift)
        turn_rad = np.radians(degrees) * axis / np.linalg.norm(axis)
        return draws.displaced(T_world_cam, shift_m, kinematics.quat_from_rotation_vector(turn_rad))


AS_IT_IS = Change()
