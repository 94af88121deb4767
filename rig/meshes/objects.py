"""The objects of the test rig: shape, mass, friction and grasp of each. JAX-free.

The twelve of training by name, size, mass and friction, in other shapes, and six that training does not have.
All shapes are made here by code, so their licence is the project's; docs/objects.md has the table.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

from ddgrasp.errors import UserError, looked_up
from mjx_envs.object_checks import check_thing, named
from mjx_envs.objects import OBJECTS
from rig.meshes import fruit, things
from rig.meshes.solids import Part, Vector


@dataclass(frozen=True)
class MeshObject:
    """What describes a mesh object. Its shape stands or lies as it will rest, but for a small tilt.

    The gripper comes from above and closes along the shape's y axis, as with `ObjectSpec`.
    """

    name: str
    shape: Callable[[], tuple[Part, ...]]
    """Closed surfaces, which may overlap, in millimetres, z up."""
    mass_kg: float
    """Spread evenly over the shape."""
    friction: float
    """Sliding friction coefficient, with MuJoCo's contact priority."""
    grasp_symmetry: int
    """Number of equivalent gripper yaws per turn; 0 = every yaw is as good."""
    source: str
    """Where outline, size, mass and friction come from."""
    grasp_mm: Vector | None = None
    """The grip's place in the shape's frame; None is the centre of mass."""

    def __post_init__(self):
        check_thing(self.name, self.mass_kg, self.friction, self.grasp_symmetry)
        if not callable(self.shape):
            raise UserError(
                f"{self.name}: shape is a {type(self.shape).__name__}; expected a function of no "
                "arguments that makes the parts."
            )
        at_mm = self.grasp_mm
        if at_mm is not None and (len(at_mm) != 3 or not all(map(math.isfinite, at_mm))):
            raise UserError(f"{self.name}: grasp_mm is {at_mm!r}; expected three millimetres, or None.")


def _as_trained(
    name: str,
    shape: Callable[[], tuple[Part, ...]],
    source: str,
    symmetry: int,
    grasp_mm: Vector | None = None,
) -> MeshObject:
    """An object of training in another shape: mass and friction are those of `mjx_envs/objects.py`."""
    spec = OBJECTS[name]
    return MeshObject(name, shape, spec.mass_kg, spec.friction, symmetry, source, grasp_mm)


MESH_OBJECTS: dict[str, MeshObject] = named(
    (
        _as_trained("apple", fruit.apple, "surface of revolution with dimple, five bumps, stem", 0),
        _as_trained("pear", fruit.pear, "surface of revolution with a neck, bent stem", 2),
        _as_trained("peach", fruit.peach, "surface of revolution with a cleft", 2),
        _as_trained("banana", fruit.banana, "sweep of a five-sided section, tapered", 2),
        _as_trained("cube", things.cube, "rounded cube, a hollow in each face", 4),
        _as_trained("block", things.block, "rounded box", 2),
        _as_trained("persimmon", fruit.persimmon, "squarish loft, calyx of four leaves", 4),
        _as_trained("starfruit", fruit.starfruit, "loft of a five-pointed star", 2),
        _as_trained("lemon", fruit.lemon, "surface of revolution with a nipple", 2),
        _as_trained("can", things.can, "surface of revolution with beaded rims", 0, (0.0, 0.0, 20.0)),
        _as_trained("wheel", things.wheel, "tyre with lugs, rim with five spokes and a bore", 0),
        _as_trained("bread", things.bread, "loft with a flat base and a split top", 2),
        MeshObject(
            "mug", things.mug, 0.130, 0.4, 2, "espresso mug, 65 x 67 mm, stoneware; our estimates",
            grasp_mm=(0.0, 0.0, 40.0),
        ),
        MeshObject(
            "bottle", things.bottle, 0.270, 0.4, 0, "quarter-litre juice bottle, full; our estimates",
            grasp_mm=(0.0, 0.0, 120.0),
        ),
        MeshObject(
            "screwdriver", things.screwdriver, 0.085, 0.6, 2,
            "acetate handle 1.2 g/cm3, steel shaft; our estimates",
        ),
        MeshObject(
            "milk", things.milk, 0.290, 0.4, 2, "quarter-litre gable-top carton, full; our estimates",
            grasp_mm=(0.0, 0.0, 80.0),
        ),
        MeshObject("hammer", things.hammer, 0.200, 0.5, 2, "a 200 g joiner's hammer; our estimates"),
        MeshObject("bulb", things.bulb, 0.040, 0.4, 2, "A60 lamp, 60 x 108 mm; our estimates"),
    )
)  # fmt: skip


def get_mesh_object(name: str) -> MeshObject:
    """The mesh object of that name; UserError with the nearest right name otherwise."""
    return looked_up("mesh object", name, MESH_OBJECTS)
