"""One description per object: collision and rendered geometry, mass, friction, grasp. JAX-free.

MJX fixes geometry types per model, so all objects share one body with the same slots: one box and
four capsules whose sizes and poses differ per environment. Slots an object does not use shrink to
a millimetre and hide inside it.
"""

import math
from dataclasses import dataclass

import numpy as np

from ddgrasp.errors import unknown_name

SLOT_NAMES = ("slot_box", "slot_capsule0", "slot_capsule1", "slot_capsule2", "slot_capsule3")
_HIDDEN_M = 0.001


@dataclass(frozen=True)
class Capsule:
    """Segment between `start_m` and `end_m` in the object frame, swept by a sphere."""

    start_m: tuple[float, float, float]
    end_m: tuple[float, float, float]
    radius_m: float


@dataclass(frozen=True)
class ObjectSpec:
    """An object that lies on the table with its frame's z axis up.

    The gripper closes along the object's local y axis, at the frame's origin.
    """

    name: str
    category_id: int
    """1, 2, ...: the teacher sees log(category_id)."""
    mass_kg: float
    friction: float
    """Sliding friction coefficient against the finger pads and the table."""
    rgb: tuple[float, float, float]
    rest_height_m: float
    """Height of the frame's origin above the table when the object lies still."""
    grasp_symmetry: int
    """Number of equivalent gripper yaws per turn; 0 = every yaw is as good."""
    box_half_m: tuple[float, float, float] | None = None
    capsules: tuple[Capsule, ...] = ()

    def slot_arrays(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(5, 3) sizes, (5, 3) positions, (5, 4) quaternions of the slots in the object frame.

        Sizes as MuJoCo's: box half extents; capsule (radius, half length, 0).
        """
        size = np.full((5, 3), _HIDDEN_M)
        pos = np.zeros((5, 3))
        quat = np.tile([1.0, 0.0, 0.0, 0.0], (5, 1))
        hide_at = self.capsules[0].start_m if self.capsules else (0.0, 0.0, 0.0)
        pos[:] = hide_at
        if self.box_half_m is not None:
            size[0], pos[0] = self.box_half_m, 0.0
        for i, capsule in enumerate(self.capsules, start=1):
            start, end = np.array(capsule.start_m), np.array(capsule.end_m)
            size[i] = (capsule.radius_m, max(np.linalg.norm(end - start) / 2, 1e-4), 0.0)
            pos[i] = (start + end) / 2
            quat[i] = _quat_z_to(end - start)
        return size, pos, quat

    def inertia_kg_m2(self) -> np.ndarray:
        """(3,) principal moments of the bounding box filled evenly (solid cuboid formula)."""
        x, y, z = 2 * self.half_extents_m()
        return self.mass_kg / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])

    def half_extents_m(self) -> np.ndarray:
        """(3,) half sizes of the axis-aligned bounding box around the frame's origin."""
        if self.box_half_m is not None:
            return np.array(self.box_half_m)
        ends = np.array([[c.start_m, c.end_m] for c in self.capsules])
        radii = np.array([c.radius_m for c in self.capsules])
        return (np.abs(ends).max(axis=1) + radii[:, None]).max(axis=0)


def _quat_z_to(direction: np.ndarray) -> np.ndarray:
    """Unit quaternion (w, x, y, z) that turns the z axis to `direction`; identity for a null vector."""
    norm = np.linalg.norm(direction)
    if norm < 1e-9:
        return np.array([1.0, 0.0, 0.0, 0.0])
    d = direction / norm
    if d[2] < -1 + 1e-9:
        return np.array([0.0, 1.0, 0.0, 0.0])
    quat = np.array([1.0 + d[2], -d[1], d[0], 0.0])
    return quat / np.linalg.norm(quat)


def _banana_arc(length_m: float, bend_rad: float, radius_m: float) -> tuple[Capsule, ...]:
    """Four capsules along an arc in the x-y plane, centred on the arc's centroid so that it lies flat."""
    arc_radius = length_m / bend_rad
    angles = np.linspace(-bend_rad / 2, bend_rad / 2, 5)
    centroid = arc_radius * (1 - math.sin(bend_rad / 2) / (bend_rad / 2))
    points = [(arc_radius * math.sin(a), arc_radius * (1 - math.cos(a)) - centroid, 0.0) for a in angles]
    return tuple(Capsule(points[i], points[i + 1], radius_m) for i in range(4))


OBJECTS: dict[str, ObjectSpec] = {
    spec.name: spec
    for spec in (
        ObjectSpec(
            "cube", 1, mass_kg=0.12, friction=0.9, rgb=(0.85, 0.65, 0.35), rest_height_m=0.025,
            grasp_symmetry=4, box_half_m=(0.025, 0.025, 0.025),
        ),
        ObjectSpec(
            "apple", 2, mass_kg=0.15, friction=0.8, rgb=(0.75, 0.12, 0.10), rest_height_m=0.033,
            grasp_symmetry=0, capsules=(Capsule((0.0, 0.0, -0.001), (0.0, 0.0, 0.001), 0.032),),
        ),
        ObjectSpec(
            "banana", 3, mass_kg=0.12, friction=0.8, rgb=(0.90, 0.80, 0.15), rest_height_m=0.018,
            grasp_symmetry=2, capsules=_banana_arc(length_m=0.145, bend_rad=1.0, radius_m=0.018),
        ),
    )
}  # fmt: skip
"""Sizes and masses are typical ones: a small apple (66 mm), a 18 cm banana, a 5 cm wooden cube."""


def get_object(name: str) -> ObjectSpec:
    """The object of that name; UserError with the nearest right name otherwise."""
    if name not in OBJECTS:
        raise unknown_name("object", name, OBJECTS)
    return OBJECTS[name]
