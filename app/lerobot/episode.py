"""What is made into a dataset: episodes, wherever they lie, and what there is to say of them."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32, UInt8, UInt16

Picture = tuple[UInt16[np.ndarray, "H W"], UInt8[np.ndarray, "h w 3"] | None]
"""Depth (H, W) uint16 millimetres, 0 = none there; colour (h, w, 3) uint8 where the source has it."""


@dataclass(frozen=True)
class Episode:
    """T control steps; pictures are read as they are asked for."""

    name: str
    """What a message calls it."""
    object_name: str
    """What was to be grasped; empty where nobody noted it."""
    success: bool
    state: Float32[np.ndarray, "T 8"]
    """Joints (rad), the gripper's opening (m), as `ddgrasp.layout.STATE`."""
    action: Float32[np.ndarray, "T 8"]
    """Joint steps in [-1, 1] and the gripper's command, as `ddgrasp.layout.ACTION`."""
    pictures: Callable[[], Iterator[Picture]]
    """T pictures in order."""
    held: Bool[np.ndarray, " T"]
    """Steps in which the control loop held the arm where it was, whatever the policy said."""
    by: Sequence[str] | None = None
    """Who asked for each step's action, policy or retry (`deploy.loop_report.By`); empty where the loop held
    the arm and where nobody noted it. None where no loop drove."""
    missed: int = 0
    """Control periods without a step, since the loop came late."""
    T_world_cam: Float32[np.ndarray, "4 4"] | None = None
    """The camera's pose, metres, OpenCV axes; None where it is unknown."""
    color_aligned: bool = True
    """Whether colour is seen from where depth is; else it is the colour camera's own picture."""

    @property
    def task(self) -> str:
        """What a person would ask for."""
        return f"grasp the {self.object_name or 'object'} and lift it"


@dataclass(frozen=True)
class Source:
    """Episodes that go into one dataset."""

    kind: str
    """demonstrations, or deployments."""
    robot: str
    """LeRobot's `robot_type`."""
    about: Mapping[str, str]
    """Title -> sentence for the dataset's card: robot, camera, how the episodes were made."""
    episodes: Sequence[Callable[[], Episode]]
    """Each is read when it is called."""
    left_out: Sequence[str] = field(default=())
    """Why which episodes are none of these, a line each."""
