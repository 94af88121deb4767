"""Scenes of training by numbers: enough to set them up once more before another camera."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ddgrasp.layout import OBSERVATION


@dataclass(frozen=True)
class Views:
    """N moments, each of a scene of its own, and where the camera stands."""

    qpos: Float[np.ndarray, "N 16"]
    """Arm (rad), fingers (m), object position (m) and quaternion."""
    variant: Int[np.ndarray, " N"]
    """Which object in which of its rest poses: index into `randomize.ObjectTable`'s arrays."""
    size: Float[np.ndarray, " N"]
    """Factor on the object's size."""
    T_world_cam: Float[np.ndarray, "N 4 4"]

    def __len__(self) -> int:
        return len(self.qpos)


def observed(
    observation: Float[np.ndarray, "N 40"],
    variant: Int[np.ndarray, " N"],
    size: Float[np.ndarray, " N"],
    T_world_cam: Float[np.ndarray, "N 4 4"],
) -> Views:
    """What the teacher saw as `observation` (N, 40); for the rest see `Views`."""
    parts = ("arm", "fingers", "object_pos", "object_quat")
    qpos = np.concatenate([observation[:, getattr(OBSERVATION, part)] for part in parts], axis=1)
    return Views(qpos, variant, size, T_world_cam)
