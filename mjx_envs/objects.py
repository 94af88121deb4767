"""The objects there are, one description each. JAX-free.

`mjx_envs/object_spec.py` says what a description gives: geometry, mass, friction, grasp.
"""

import math

import numpy as np

from ddgrasp.errors import UserError, looked_up
from mjx_envs.object_checks import named
from mjx_envs.object_spec import Box, Capsule, Cylinder, ObjectSpec, Plate, RestPose, Vector


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
_MADE_UP = "all of it ours"
_GREEN, _BROWN = (0.25, 0.45, 0.15), (0.35, 0.25, 0.15)

OBJECTS: dict[str, ObjectSpec] = named(
    (
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
            grasp_offset_m=(0.0, -0.006, 0.0),  # the arc's middle: its centroid lies on the inner side
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
)  # fmt: skip


SHAPES: dict[str, ObjectSpec] = named(
    (
        ObjectSpec(
            "tower", 13, mass_kg=0.100, friction=0.6, rgb=(0.60, 0.60, 0.62), rest_height_m=0.040,
            grasp_symmetry=4, grasp_offset_m=(0.0, 0.0, 0.015), box=Box((0.020, 0.020, 0.040)),
            other_pose=RestPose("y", rest_height_m=0.020, grasp_symmetry=2),
            source="40 x 40 x 80 mm, stands or lies; " + _MADE_UP,
        ),
        ObjectSpec(
            "slab", 14, mass_kg=0.080, friction=0.6, rgb=(0.35, 0.45, 0.55), rest_height_m=0.014,
            grasp_symmetry=2, box=Box((0.045, 0.020, 0.014)),
            source="90 x 40 x 28 mm; " + _MADE_UP,
        ),
        ObjectSpec(
            "stick", 15, mass_kg=0.050, friction=0.6, rgb=(0.55, 0.35, 0.20), rest_height_m=0.014,
            grasp_symmetry=2, capsules=(_along_x(0.050, 0.014),), box=Box((0.040, 0.007, 0.0139)),
            source="128 mm long, 28 mm thick, does not roll; " + _MADE_UP,
        ),
        ObjectSpec(
            "puck", 16, mass_kg=0.070, friction=0.6, rgb=(0.15, 0.15, 0.18), rest_height_m=0.015,
            grasp_symmetry=0, capsules=_disc(across_m=0.058, height_m=0.030),
            source="58 mm across, 30 mm high; " + _MADE_UP,
        ),
        ObjectSpec(
            "ring", 17, mass_kg=0.035, friction=0.7, rgb=(0.30, 0.22, 0.20), rest_height_m=0.011,
            grasp_symmetry=8, capsules=_torus(ring_m=0.018, radius_m=0.011),
            source="58 mm across the corners of its octagon, 22 mm thick, with a hole; " + _MADE_UP,
        ),
        ObjectSpec(
            "tin", 18, mass_kg=0.180, friction=0.5, rgb=(0.20, 0.40, 0.65), rest_height_m=0.035,
            grasp_symmetry=0, grasp_offset_m=(0.0, 0.0, 0.010), box=Box((0.0191, 0.0191, 0.035)),
            capsules=_staves(radius_m=0.027, half_m=0.027, edge_m=0.008),
            cylinders=(Cylinder(0.027, 0.035),),
            other_pose=RestPose("y", rest_height_m=0.027, grasp_symmetry=2),
            source="54 x 70 mm, stands or lies; " + _MADE_UP,
        ),
    )
)  # fmt: skip
"""Plain shapes to train on besides (`--world.objects`), so that a student knows more than six: none is one
of the twelve, and none is tried."""


def _check_apart() -> None:
    """UserError for a name or a category that two have."""
    of_category: dict[int, str] = {}
    for spec in named((*OBJECTS.values(), *SHAPES.values())).values():
        if (other := of_category.setdefault(spec.category_id, spec.name)) != spec.name:
            raise UserError(
                f"{other} and {spec.name} have one category_id, {spec.category_id}, by which the teacher "
                "tells objects apart: give one of them another that is free."
            )


_check_apart()


def get_object(name: str) -> ObjectSpec:
    """The object or shape of that name; UserError with the nearest right name otherwise."""
    return looked_up("object", name, OBJECTS | SHAPES)
