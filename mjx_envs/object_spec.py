"""What describes an object: collision and rendered geometry, mass, friction, grasp. JAX-free.

MJX fixes geometry types per model, so all objects share one body with the same slots: one box and a
number of capsules whose sizes and poses differ per environment. Slots an object does not use shrink
to a millimetre and hide inside it. How many slots there are follows from the objects chosen: with
none that needs more, a run has the box and four capsules (`SlotLayout`).

The box and the capsules collide; cylinders (MJX collides none with a box) and plates are drawn only,
around or between them.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from ddgrasp.errors import UserError
from mjx_envs.object_checks import check_rgb, check_thing

_HIDDEN_M = 0.001
_AXIS_POINTS = 33
MOST_REACH_M = 0.14
"""How far a colliding part may reach from its middle: the scene's filters end at 0.15 m (`mjx_envs.scene`),
and objects of random size are up to 5 % larger by default."""
PAD_HALF_WIDTH_M = 0.0105
"""A finger's pad, across the closing direction."""


Factor = Float[AnyArray, ""] | float
Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

_HALF_ROOT = math.sqrt(0.5)
_QUARTER_TURN: dict[str, Quaternion] = {
    "x": (_HALF_ROOT, _HALF_ROOT, 0.0, 0.0),
    "y": (_HALF_ROOT, 0.0, _HALF_ROOT, 0.0),
}


@dataclass(frozen=True)
class SlotLayout:
    """Geoms of the object's body, in this order: one box, capsules, then what is drawn only."""

    capsules: int = 4
    cylinders: int = 0
    plates: int = 0

    @property
    def kinds(self) -> tuple[str, ...]:
        """MuJoCo's geom type of each slot."""
        drawn = ("cylinder",) * self.cylinders + ("box",) * self.plates
        return ("box",) + ("capsule",) * self.capsules + drawn

    @property
    def names(self) -> tuple[str, ...]:
        """Geom names: slot_box, slot_capsule0, ..."""
        numbered = [
            f"slot_{kind}{i}"
            for kind, count in (
                ("capsule", self.capsules),
                ("cylinder", self.cylinders),
                ("plate", self.plates),
            )  # fmt: skip
            for i in range(count)
        ]
        return ("slot_box", *numbered)

    @property
    def colliding_names(self) -> tuple[str, ...]:
        """Names of the slots that touch things."""
        return self.names[: 1 + self.capsules]


DEFAULT_SLOTS = SlotLayout()
"""One box and four capsules: enough for most objects, and the fewest a scene has."""


@dataclass(frozen=True)
class Box:
    """Axes along those of the object frame."""

    half_m: Vector
    center_m: Vector = (0.0, 0.0, 0.0)
    rgb: Vector | None = None
    """None takes the object's colour."""


@dataclass(frozen=True)
class Capsule:
    """Segment between `start_m` and `end_m` in the object frame, swept by a sphere."""

    start_m: Vector
    end_m: Vector
    radius_m: float
    rgb: Vector | None = None
    """None takes the object's colour."""


@dataclass(frozen=True)
class Cylinder:
    """Upright (axis z), drawn only: collision is up to the box and the capsules inside it."""

    radius_m: float
    half_height_m: float
    rgb: Vector | None = None
    """None takes the object's colour."""


@dataclass(frozen=True)
class Plate:
    """A box from the x axis outwards, turned about x; drawn only."""

    half_length_m: float
    height_m: float
    """From the axis."""
    half_thickness_m: float
    roll_rad: float
    """0 stands up, along z."""


@dataclass(frozen=True)
class RestPose:
    """Another way for an object to rest on the table: its shape turned by a quarter turn in its frame."""

    about: str
    """Axis of the quarter turn: "x" or "y"."""
    rest_height_m: float
    """As the object's own, in this pose."""
    grasp_symmetry: int
    """As the object's own, in this pose."""
    grasp_offset_m: Vector = (0.0, 0.0, 0.0)
    """As the object's own, in this pose."""


def _reach_m(part: Box | Capsule) -> float:
    """Largest distance of a surface point from the part's middle along an axis of its own."""
    if isinstance(part, Box):
        return max(part.half_m)
    return math.dist(part.start_m, part.end_m) / 2 + part.radius_m


class ObjectModel(NamedTuple):
    """An object as MuJoCo takes it, in a layout of S slots. NumPy or JAX; a batch may come first."""

    slot_size: Any
    """(S, 3) box half extents; capsule and cylinder (radius, half length, 0), m."""
    slot_pos: Any
    """(S, 3) in the object frame, m."""
    slot_quat: Any
    """(S, 4)"""
    mass_kg: Any
    inertia_kg_m2: Any
    """(3,) principal moments."""
    friction: Any
    """Sliding friction coefficient."""

    def scaled(self, size: Factor, mass: Factor, friction: Factor) -> "ObjectModel":
        """One object with all lengths, its mass and its friction times these factors."""
        return ObjectModel(
            slot_size=self.slot_size * size,
            slot_pos=self.slot_pos * size,
            slot_quat=self.slot_quat,
            mass_kg=self.mass_kg * mass,
            inertia_kg_m2=self.inertia_kg_m2 * mass * size**2,
            friction=self.friction * friction,
        )


@dataclass(frozen=True)
class ObjectSpec:
    """An object that lies on the table with its frame's z axis up.

    The frame's origin is the centre of mass. The gripper comes from above and closes along the
    object's local y axis, at the origin or `grasp_offset_m` from it.
    """

    name: str
    category_id: int
    """1, 2, ...: the teacher sees log(category_id)."""
    mass_kg: float
    friction: float
    """Sliding friction coefficient against whatever touches it: its geoms have MuJoCo's contact priority."""
    rgb: Vector
    rest_height_m: float
    """Height of the frame's origin above the table when the object lies still."""
    grasp_symmetry: int
    """Number of equivalent gripper yaws per turn; 0 = every yaw is as good."""
    box: Box | None = None
    capsules: tuple[Capsule, ...] = ()
    cylinders: tuple[Cylinder, ...] = ()
    plates: tuple[Plate, ...] = ()
    grasp_offset_m: Vector = (0.0, 0.0, 0.0)
    """From the origin to the grasp, object frame; not scaled with the object's randomised size."""
    other_pose: RestPose | None = None
    """Lying, for what stands above; standing, for what lies."""
    turn: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """From the parts' frame to the object frame: nothing or a quarter turn (`in_other_pose`)."""
    source: str = ""
    """Where size, mass and friction come from."""

    def __post_init__(self):
        """UserError for what cannot lie there or be grasped: without a part that collides, mass or friction,
        wider than the hand opens, of a symmetry that a parallel hand has not, or too long to collide."""
        if self.box is None and not self.capsules:
            raise UserError(f"{self.name}: nothing of it collides: give it a box or capsules.")
        check_thing(self.name, self.mass_kg, self.friction, self.grasp_symmetry)
        if self.category_id < 1:
            raise UserError(f"{self.name}: category_id is {self.category_id}; expected 1 or more.")
        own = (part.rgb for part in (self.box, *self.capsules, *self.cylinders) if part is not None)
        for rgb in (self.rgb, *(rgb for rgb in own if rgb is not None)):
            check_rgb(self.name, rgb)
        if (wide_m := 2.0 * self.half_width_m()) > contract.GRIPPER_MAX_WIDTH_M:
            raise UserError(
                f"{self.name}: {wide_m:.3g} m wide where the fingers close; a hand opens by "
                f"{contract.GRIPPER_MAX_WIDTH_M:g} m."
            )
        if self.other_pose is not None:
            try:
                self.in_other_pose()
            except UserError as error:
                raise UserError(f"{error} (Its other pose.)") from None
        reach_m = max(map(_reach_m, (*self.capsules, *((self.box,) if self.box else ()))), default=0.0)
        if reach_m > MOST_REACH_M:
            raise UserError(
                f"{self.name}: a part reaches {reach_m:.3g} m from its middle, and collisions are looked for "
                f"up to {MOST_REACH_M} m: put it together of shorter ones."
            )

    def in_other_pose(self) -> "ObjectSpec":
        """The same object in its other pose, which must exist."""
        assert self.other_pose is not None
        pose = self.other_pose
        return replace(
            self, rest_height_m=pose.rest_height_m, grasp_symmetry=pose.grasp_symmetry,
            grasp_offset_m=pose.grasp_offset_m, turn=_QUARTER_TURN[pose.about], other_pose=None,
        )  # fmt: skip

    def model(self, layout: SlotLayout) -> ObjectModel:
        """What MuJoCo takes, at its nominal size."""
        return ObjectModel(*self.slot_arrays(layout), self.mass_kg, self.inertia_kg_m2(), self.friction)

    def slot_arrays(self, layout: SlotLayout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(S, 3) sizes, (S, 3) positions, (S, 4) quaternions of the slots in the object frame.

        Sizes as MuJoCo's: box half extents; capsule and cylinder (radius, half length, 0).
        """
        count = len(layout.kinds)
        size, pos = np.full((count, 3), _HIDDEN_M), np.zeros((count, 3))
        quat = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        pos[:] = self.capsules[0].start_m if self.capsules else (0.0, 0.0, 0.0)
        if self.box is not None:
            size[0], pos[0] = self.box.half_m, self.box.center_m
        for i, capsule in enumerate(self.capsules, start=1):
            start, end = np.array(capsule.start_m), np.array(capsule.end_m)
            size[i] = (capsule.radius_m, max(np.linalg.norm(end - start) / 2, 1e-4), 0.0)
            pos[i] = (start + end) / 2
            quat[i] = _quat_z_to(end - start)
        for i, cylinder in enumerate(self.cylinders, start=1 + layout.capsules):
            size[i], pos[i] = (cylinder.radius_m, cylinder.half_height_m, 0.0), 0.0
        for i, plate in enumerate(self.plates, start=1 + layout.capsules + layout.cylinders):
            up = np.array([0.0, -math.sin(plate.roll_rad), math.cos(plate.roll_rad)])
            size[i] = (plate.half_length_m, plate.half_thickness_m, plate.height_m / 2)
            pos[i], quat[i] = plate.height_m / 2 * up, _quat_z_to(up)
        for i in range(count):
            mujoco.mju_mulQuat(quat[i], np.array(self.turn), quat[i].copy())
        return size, self._turned(pos), quat

    def slot_rgb(self, layout: SlotLayout) -> np.ndarray:
        """(S, 3) colours of the slots."""
        rgb = np.tile(self.rgb, (len(layout.kinds), 1))
        parts = {0: self.box, **dict(enumerate(self.capsules, start=1))}
        parts |= dict(enumerate(self.cylinders, start=1 + layout.capsules))
        for i, part in parts.items():
            if part is not None and part.rgb is not None:
                rgb[i] = part.rgb
        return rgb

    def inertia_kg_m2(self) -> np.ndarray:
        """(3,) principal moments of the bounding box filled evenly (solid cuboid formula)."""
        x, y, z = 2 * self.half_extents_m()
        return self.mass_kg / 12 * np.array([y * y + z * z, x * x + z * z, x * x + y * y])

    def half_extents_m(self) -> np.ndarray:
        """(3,) half sizes of the smallest axis-aligned box centred at the frame's origin."""
        return np.abs(self._bounds_m()).max(axis=0)

    def extents_m(self) -> np.ndarray:
        """(3,) length, width and height as it lies."""
        lower, upper = self._bounds_m()
        return upper - lower

    def half_width_m(self) -> float:
        """Half of what the fingers close on: along y, within a pad's width of the grasp."""
        widest = 0.0
        if self.box is not None:
            corners = np.add(self.box.center_m, np.outer((-1, 1), self.box.half_m))
            x, y = self._from_grasp(corners)
            if x.min() < PAD_HALF_WIDTH_M and x.max() > -PAD_HALF_WIDTH_M:
                widest = np.abs(y).max()
        for capsule in self.capsules:
            x, y = self._from_grasp(np.linspace(capsule.start_m, capsule.end_m, _AXIS_POINTS))
            beyond = np.maximum(np.abs(x) - PAD_HALF_WIDTH_M, 0.0)
            nearest = beyond == beyond.min()  # of a capsule beside the pads, its round end
            if (reach := capsule.radius_m**2 - beyond.min() ** 2) > 0.0:
                widest = max(widest, np.abs(y[nearest]).max() + math.sqrt(reach))
        return float(widest)

    def _from_grasp(self, points_m: np.ndarray) -> np.ndarray:
        """(2, N) x and y, from the grasp, of points (N, 3) of the parts' frame."""
        return (self._turned(points_m) - self.grasp_offset_m)[:, :2].T

    def _bounds_m(self) -> np.ndarray:
        """(2, 3) lower and upper corner of the box and the capsules together, object frame."""
        lower, upper = [], []
        if self.box is not None:
            lower.append(np.subtract(self.box.center_m, self.box.half_m))
            upper.append(np.add(self.box.center_m, self.box.half_m))
        for c in self.capsules:
            lower.append(np.minimum(c.start_m, c.end_m) - c.radius_m)
            upper.append(np.maximum(c.start_m, c.end_m) + c.radius_m)
        corners = np.stack([np.min(lower, axis=0), np.max(upper, axis=0)])
        return np.sort(self._turned(corners), axis=0)

    def _turned(self, points_m: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the parts' frame in the object frame."""
        matrix = np.zeros(9)
        mujoco.mju_quat2Mat(matrix, np.array(self.turn))
        return points_m @ matrix.reshape(3, 3).T


def slot_layout(specs: Iterable[ObjectSpec]) -> SlotLayout:
    """The smallest layout, but not below DEFAULT_SLOTS, that holds every one of `specs`."""
    specs = list(specs)
    return SlotLayout(
        capsules=max([DEFAULT_SLOTS.capsules, *(len(s.capsules) for s in specs)]),
        cylinders=max([DEFAULT_SLOTS.cylinders, *(len(s.cylinders) for s in specs)]),
        plates=max([DEFAULT_SLOTS.plates, *(len(s.plates) for s in specs)]),
    )


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
