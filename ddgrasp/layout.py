"""Names for the parts of the project's vectors: what `qpos[9:12]` is, said once.

A part is a slice of the last axis, the same for NumPy, JAX and the exported graph:

    qpos[..., QPOS.object_pos]

This module imports the standard library alone, so that the robot side can use it.
"""

from collections.abc import Iterator
from typing import Any


class Layout:
    """Ordered parts of a vector; each is an attribute, a slice.

    Args:
      sizes: part -> how many numbers it has, in order.
    """

    def __init__(self, **sizes: int):
        self._parts: dict[str, slice] = {}
        self.size = 0
        """Length of the vector."""
        for name, size in sizes.items():
            self._parts[name] = slice(self.size, self.size + size)
            self.size += size

    def __getattr__(self, name: str) -> slice:
        """The part called `name`; AttributeError if there is none."""
        parts = self.__dict__.get("_parts", {})  # absent while a copy is being made
        if name not in parts:
            raise AttributeError(f"no part {name!r}; there are {', '.join(parts)}")
        return parts[name]

    def items(self) -> Iterator[tuple[str, slice]]:
        """(name, slice) of every part, in order."""
        return iter(self._parts.items())


QPOS = Layout(arm=7, fingers=2, object_pos=3, object_quat=4)
"""Configuration of the scene: joints (rad), finger positions (m), the object's pose in the world."""
QVEL = Layout(arm=7, fingers=2, object_linear=3, object_angular=3)
"""Its velocities; the object's linear one in the world frame, its angular one in its own."""
CONTROLS = Layout(arm=7, fingers=2)
"""Actuators' targets: joints (rad), finger positions (m)."""
OBSERVATION = Layout(
    arm=7, fingers=2, arm_velocity=7, finger_velocity=2, grip_pos=3, grip_quat=4, object_pos=3, object_quat=4,
    grasp_pos=3, grasp_quat=4, category=1,
)  # fmt: skip
"""What the teacher sees; `contract.OBSERVATION_PARTS` has the same in coarser parts. Positions in metres,
quaternions (w, x, y, z), world frame; the category is the logarithm of its id."""
STATE = Layout(arm=7, width=1)
"""What the robot tells of itself: joints (rad) and the gripper's opening (m)."""
POLICY_STATE = Layout(arm=7, width=1, width_change=1)
"""What a student is told of the robot: that, and how much the opening has changed since the control step
before (m), which is how a hand that closes differs from one that is stopped by what it holds."""
ACTION = Layout(arm=7, gripper=1)
"""Joint steps in [-1, 1] and the gripper's command, see `closes`."""


def closes(action: Any) -> Any:
    """(...,) bool, whether actions (..., 8) close the gripper: a command above 0 does, others open it."""
    return action[..., ACTION.gripper.start] > 0
