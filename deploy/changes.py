"""What can be otherwise than in the development rig, one thing at a time: where a policy loses, by cause."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, assert_never

import numpy as np
from jaxtyping import Float

from ddgrasp.config import Config

if TYPE_CHECKING:
    from rig.camera import RigCamera
    from rig.world import RigWorld

WorldName = Literal["as it is", "meshes", "furniture", "dark table", "other tables", "spring"]
SightName = Literal[
    "stereo", "ideal", "full size",
    "holes", "small holes", "large holes", "values", "ripple", "mismatches",
    "generator", "generator's holes", "generator's values",
]  # fmt: skip
_STREAM = 0x4F6666
"""Keeps the direction in which a camera is off apart from every other random number ("Off")."""


@dataclass(frozen=True)
class Change:
    """The development rig, but for this."""

    world: WorldName = "as it is"
    """meshes (the test rig's objects), furniture (its table's end, wall and clutter), dark table, other
    tables (light and dark in other places in every trial), or spring (the arm follows as the Franka driver's
    spring has it at full stiffness)."""
    sight: SightName = "stereo"
    """stereo (matched at the policy's size), ideal (no errors), full size (matched at 848x480), one kind of
    stereo's errors alone (rig/camera_errors.py), or a generator's errors instead of all of stereo's, or of
    one kind (deploy/generated_camera.py)."""
    off: tuple[float, float] = (0.0, 0.0)
    """How far the camera stands from where the trial says, in a random direction: metres, degrees."""
    generator: Path | None = None
    """File whose errors a generator's are; None takes the shipped one."""

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
            case "as it is" | "other tables":
                return make_world(config.world)
            case _:
                assert_never(self.world)

    def make_camera(self, config: Config, world: "RigWorld") -> "RigCamera":
        """The camera before `world`."""
        camera = self._camera(config, world)
        camera.other_tables = config.record.other_tables or self.world == "other tables"
        return camera

    def _camera(self, config: Config, world: "RigWorld") -> "RigCamera":
        from deploy.generated_camera import GENERATED, SHIPPED, GeneratedCamera
        from rig.camera import RigCamera
        from rig.camera_errors import ERRORS, PartlyWrongCamera

        before, seen = (world.model, config.record.stereo, config.world.profile), self.sight
        if seen == "full size":
            from deploy.full_size import FullSizeCamera

            return FullSizeCamera(*before)
        if seen in ERRORS:
            return PartlyWrongCamera(*before, seen)
        if seen in GENERATED:
            return GeneratedCamera(*before, seen, self.generator or SHIPPED)
        if seen not in ("stereo", "ideal"):
            raise ValueError(f"no camera sees {seen!r}")
        if self.world == "meshes":
            from rig.mesh_world import MeshCamera

            return MeshCamera(*before, seen == "ideal")
        return RigCamera(*before, seen == "ideal")

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
