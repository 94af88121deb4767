"""One description per object: collision and rendered geometry, mass, friction, grasp. JAX-free.

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

import mujoco
import numpy as np

from ddgrasp.errors import unknown_name

_HIDDEN_M = 0.001

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

    def in_other_pose(self) -> "ObjectSpec":
        """The same object in its other pose, which must exist."""
        assert self.other_pose is not None
        pose = self.other_pose
        return replace(
            self, rest_height_m=pose.rest_height_m, grasp_symmetry=pose.grasp_symmetry,
            grasp_offset_m=pose.grasp_offset_m, turn=_QUARTER_TURN[pose.about], other_pose=None,
        )  # fmt: skip

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


def _banana_arc(length_m: float, bend_rad: float, radius_m: float) -> tuple[Capsule, ...]:
    """Four capsules along an arc in the x-y plane, centred on the arc's centroid so that it lies flat."""
    arc_radius = length_m / bend_rad
    angles = np.linspace(-bend_rad / 2, bend_rad / 2, 5)
    centroid = arc_radius * (1 - math.sin(bend_rad / 2) / (bend_rad / 2))
    points = [(arc_radius * math.sin(a), arc_radius * (1 - math.cos(a)) - centroid, 0.0) for a in angles]
    return tuple(Capsule(points[i], points[i + 1], radius_m) for i in range(4))


def _ball(x_m: float, y_m: float, z_m: float, radius_m: float, rgb: Vector | None = None) -> Capsule:
    """A sphere, as a capsule without length."""
    return Capsule((x_m, y_m, z_m), (x_m, y_m, z_m), radius_m, rgb)


def _along_x(
    half_m: float, radius_m: float, y_m: float = 0.0, z_m: float = 0.0, rgb: Vector | None = None
) -> Capsule:
    """A capsule parallel to x, with `half_m` from its middle to the centre of either end."""
    return Capsule((-half_m, y_m, z_m), (half_m, y_m, z_m), radius_m, rgb)


def _upright(half_m: float, radius_m: float, x_m: float, y_m: float) -> Capsule:
    """A capsule parallel to z."""
    return Capsule((x_m, y_m, -half_m), (x_m, y_m, half_m), radius_m)


def _around_z(count: int, ring_m: float, phase_rad: float = 0.0) -> list[tuple[float, float]]:
    """`count` points evenly on a circle in the x-y plane."""
    angles = [phase_rad + 2 * math.pi * i / count for i in range(count)]
    return [(ring_m * math.cos(a), ring_m * math.sin(a)) for a in angles]


def _torus(ring_m: float, radius_m: float) -> tuple[Capsule, ...]:
    """Eight capsules around z; the corners of their octagon reach as far out as a torus would."""
    corners = [(x, y, 0.0) for x, y in _around_z(8, ring_m, math.pi / 8)]
    return tuple(Capsule(corners[i - 1], corners[i], radius_m) for i in range(8))


def _staves(radius_m: float, half_m: float, edge_m: float) -> tuple[Capsule, ...]:
    """Eight capsules of radius `edge_m` parallel to z; between two of them lies the cylinder's radius."""
    ring_m = (radius_m - edge_m) / math.cos(math.pi / 8)
    return tuple(_upright(half_m, edge_m, x, y) for x, y in _around_z(8, ring_m, math.pi / 8))


def _disc(across_m: float, height_m: float) -> tuple[Capsule, ...]:
    """A flattened ball: four capsules crossing at the origin, lying in the x-y plane."""
    radius = height_m / 2
    ends = [(x, y, 0.0) for x, y in _around_z(8, across_m / 2 - radius)]
    return tuple(Capsule(ends[i], ends[i + 4], radius) for i in range(4))


def _star_edges(ring_m: float, radius_m: float, half_m: float) -> tuple[Capsule, ...]:
    """Five capsules along x around it, one of them straight up."""
    return tuple(_along_x(half_m, radius_m, y, z) for z, y in _around_z(5, ring_m))


def _star_sides(ring_m: float, radius_m: float, half_m: float) -> tuple[Plate, ...]:
    """Five plates from the axis to the edges."""
    return tuple(Plate(half_m, ring_m, radius_m, 2 * math.pi * i / 5) for i in range(5))


_FRUIT = "friction: golden apple on rubber 0.42 to 0.48 (Ooi Abdullah and Ch'ng 2022)"
_GREEN, _BROWN = (0.25, 0.45, 0.15), (0.35, 0.25, 0.15)

OBJECTS: dict[str, ObjectSpec] = {
    spec.name: spec
    for spec in (
        ObjectSpec(
            "cube", 1, mass_kg=0.12, friction=0.9, rgb=(0.85, 0.65, 0.35), rest_height_m=0.025,
            grasp_symmetry=4, box=Box((0.025, 0.025, 0.025)),
            source="a 5 cm cube of dense wood",
        ),
        ObjectSpec(
            "apple", 2, mass_kg=0.15, friction=0.8, rgb=(0.75, 0.12, 0.10), rest_height_m=0.033,
            grasp_symmetry=0, capsules=(Capsule((0.0, 0.0, -0.001), (0.0, 0.0, 0.001), 0.032),),
            source="a small apple, 64 mm; USDA FoodData Central 171688: small (70 mm) 149 g",
        ),
        ObjectSpec(
            "banana", 3, mass_kg=0.12, friction=0.8, rgb=(0.90, 0.80, 0.15), rest_height_m=0.018,
            grasp_symmetry=2, capsules=_banana_arc(length_m=0.145, bend_rad=1.0, radius_m=0.018),
            source="a medium banana, 18 cm; USDA FoodData Central 173944: medium 118 g",
        ),
        ObjectSpec(
            "pear", 4, mass_kg=0.178, friction=0.5, rgb=(0.66, 0.72, 0.22), rest_height_m=0.030,
            grasp_symmetry=2,
            capsules=(
                _ball(-0.009, 0.0, 0.003, 0.033),
                Capsule((0.004, 0.0, -0.0035), (0.010, 0.0, -0.0035), 0.0265),
                Capsule((0.020, 0.0, -0.0095), (0.026, 0.0, -0.0095), 0.0205),
                _ball(0.041, 0.0, -0.013, 0.017),
            ),
            box=Box((0.007, 0.0015, 0.0015), (0.062, 0.0, -0.011), rgb=_BROWN),
            source="66 x 100 mm: YCB pear (Calli et al. 2015); USDA FoodData Central 169118: medium 178 g; "
            + _FRUIT,
        ),
        ObjectSpec(
            "peach", 5, mass_kg=0.137, friction=0.5, rgb=(0.92, 0.58, 0.28), rest_height_m=0.0295,
            grasp_symmetry=0,
            capsules=(_ball(0.0, -0.0008, 0.0, 0.0295), _ball(0.0, 0.0008, 0.0, 0.0295, (0.85, 0.33, 0.26))),
            box=Box((0.010, 0.004, 0.0006), (0.006, 0.0, 0.0297), rgb=_GREEN),
            source="61 x 60 x 59 mm, 137 g: Emadi et al. 2011 (Tabrizi); " + _FRUIT,
        ),
        ObjectSpec(
            "block", 6, mass_kg=0.028, friction=0.7, rgb=(0.70, 0.30, 0.22), rest_height_m=0.025,
            grasp_symmetry=2, box=Box((0.0375, 0.025, 0.025)),
            other_pose=RestPose("y", 0.0375, grasp_symmetry=4, grasp_offset_m=(0.0, 0.0, 0.010)),
            source="50 x 75 x 50 mm, 28 g: YCB foam brick (Calli et al. 2015); friction: our estimate",
        ),
        ObjectSpec(
            "persimmon", 7, mass_kg=0.150, friction=0.5, rgb=(0.90, 0.42, 0.08), rest_height_m=0.027,
            grasp_symmetry=0, capsules=_disc(across_m=0.064, height_m=0.054),
            box=Box((0.009, 0.009, 0.001), (0.0, 0.0, 0.027), rgb=_GREEN),
            source="64 mm across: USDA FoodData Central 169941; 1.23 g/cm3: Khormandy, 73 g in 59 cm3; "
            + _FRUIT,
        ),
        ObjectSpec(
            "starfruit", 8, mass_kg=0.091, friction=0.5, rgb=(0.82, 0.80, 0.20), rest_height_m=0.0223,
            grasp_symmetry=2,
            capsules=(_along_x(0.034, 0.012), *_star_edges(ring_m=0.022, radius_m=0.0045, half_m=0.036)),
            plates=_star_sides(ring_m=0.022, radius_m=0.0045, half_m=0.038),
            source="92 mm long, 91 g: USDA FoodData Central 171715, medium; " + _FRUIT,
        ),
        ObjectSpec(
            "lemon", 9, mass_kg=0.108, friction=0.5, rgb=(0.95, 0.85, 0.20), rest_height_m=0.027,
            grasp_symmetry=2,
            capsules=(_along_x(0.003, 0.027), _along_x(0.013, 0.021), _along_x(0.031, 0.007)),
            source="54 mm thick: YCB lemon (Calli et al. 2015); USDA FoodData Central: 108 g with peel; "
            + _FRUIT,
        ),
        ObjectSpec(
            "can", 10, mass_kg=0.349, friction=0.5, rgb=(0.75, 0.10, 0.12), rest_height_m=0.0505,
            grasp_symmetry=0, grasp_offset_m=(0.0, 0.0, 0.020),
            box=Box((0.0233, 0.0233, 0.0505)),
            capsules=_staves(radius_m=0.033, half_m=0.0425, edge_m=0.008),
            other_pose=RestPose("y", rest_height_m=0.033, grasp_symmetry=2),
            cylinders=(Cylinder(0.033, 0.0495), Cylinder(0.031, 0.0507, rgb=(0.75, 0.75, 0.78))),
            source="66 x 101 mm, 349 g: YCB tomato soup can (Calli et al. 2015); friction: our estimate",
        ),
        ObjectSpec(
            "wheel", 11, mass_kg=0.040, friction=0.9, rgb=(0.22, 0.22, 0.23), rest_height_m=0.0135,
            grasp_symmetry=8, capsules=_torus(ring_m=0.0195, radius_m=0.0135),
            cylinders=(Cylinder(0.016, 0.0126, rgb=(0.90, 0.75, 0.10)), Cylinder(0.004, 0.0129)),
            source="the 65 mm rubber-tyred wheel of hobby gear motors; width, mass, friction: our estimates",
        ),
        ObjectSpec(
            "bread", 12, mass_kg=0.044, friction=0.5, rgb=(0.72, 0.48, 0.22), rest_height_m=0.019,
            grasp_symmetry=2,
            capsules=(
                _along_x(0.050, 0.019, y_m=-0.008), _along_x(0.050, 0.019, y_m=0.008),
                _along_x(0.048, 0.017, z_m=0.005), _along_x(0.045, 0.005, z_m=0.0185, rgb=(0.90, 0.78, 0.55)),
            ),
            source="a hot-dog roll, USDA FoodData Central: 44 g; size and friction: our estimates",
        ),
    )
}  # fmt: skip


def get_object(name: str) -> ObjectSpec:
    """The object of that name; UserError with the nearest right name otherwise."""
    if name not in OBJECTS:
        raise unknown_name("object", name, OBJECTS)
    return OBJECTS[name]
