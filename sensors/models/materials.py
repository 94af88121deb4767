"""How surfaces look in the near infrared, where the stereo camera works: the one place for it.

Colour says little there: pigments of fruit and most dyes are transparent at 850 nm, carbon black is not, and
what a smooth skin or bare metal mirrors decides whether the matcher sees the projector's dots. So objects
fail differently, as real ones do: dark rubber and bare metal send too little back, watery flesh sends it back
without the dots.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import mujoco
import numpy as np
from jaxtyping import Float, Float32

from mjx_envs.render.visible_geoms import rgba_of

Colour = Sequence[float | int] | Float[np.ndarray, " channels"]
"""Red, green and blue in [0, 1]; what follows them is ignored."""
NEAR_INFRARED_RGB = (0.7, 0.2, 0.1)
"""Weights by which a guess of the near-infrared reflectance follows the visible colour."""


@dataclass(frozen=True)
class Material:
    """How a surface looks in the near infrared."""

    albedo: float
    """Diffuse reflectance, 0 to 1."""
    specular: float = 0.05
    """Strength of the highlight relative to a white diffuse surface."""
    texture: float = 0.0
    """Relative contrast of its albedo texture (for geoms that do not move)."""

    translucency: float = 0.0
    """Share of the projector's light that comes back from within, spread and without its dots, 0 to 1."""

    @classmethod
    def from_rgb(cls, rgb: Colour, specular: float = 0.05, texture: float = 0.0) -> "Material":
        """A guess: near-infrared reflectance follows red more than green and blue."""
        red, green, blue = (float(c) for c in rgb[:3])
        r, g, b = NEAR_INFRARED_RGB
        return cls(0.05 + 0.9 * (r * red + g * green + b * blue), specular, texture)


@dataclass(frozen=True)
class ObjectMaterial:
    """Materials of an object (mjx_envs/objects.py)."""

    surface: Material
    source: str
    parts: Mapping[str, Material] = field(default_factory=dict)
    """Materials of slots (`SlotLayout.names`) or surfaces of a mesh (`rig.meshes`), where they differ."""


_ESTIMATE = "our estimate"
_FRUIT = (
    "half of the light above 800 nm, whatever the colour (Merzlyak et al. 2003, apples); gloss: " + _ESTIMATE
)
_STALK = Material(0.45, 0.02)
_STEEL = Material(0.02, 4.0)
"""Mirrors and hardly scatters."""
_STALKS: dict[str, Material] = dict.fromkeys(
    ("slot_box", "stem", "stalk", "tip", "leaf0", "leaf1", "leaf2", "leaf3"), _STALK
)

OBJECT_MATERIALS: dict[str, ObjectMaterial] = {
    "cube": ObjectMaterial(Material(0.65, 0.03), "raw softwood; " + _ESTIMATE),
    "apple": ObjectMaterial(Material(0.50, 0.60), "waxed; " + _FRUIT),
    "banana": ObjectMaterial(Material(0.55, 0.15), "satin; " + _FRUIT),
    "pear": ObjectMaterial(Material(0.50, 0.20), "satin; " + _FRUIT, _STALKS),
    "peach": ObjectMaterial(Material(0.55, 0.01), "downy, no gloss; " + _FRUIT, _STALKS),
    "block": ObjectMaterial(Material(0.45, 0.01), "matt foam; " + _ESTIMATE),
    "persimmon": ObjectMaterial(Material(0.50, 0.80), "smooth, waxy; " + _FRUIT, _STALKS),
    "starfruit": ObjectMaterial(
        Material(0.06, 0.40, translucency=0.95),
        "waxy; watery flesh and thin ribs let light through, little returns and not where it entered; "
        + _ESTIMATE,
    ),
    "lemon": ObjectMaterial(Material(0.50, 0.35), "dimpled, oily; " + _FRUIT),
    "can": ObjectMaterial(
        Material(0.45, 0.80),
        "varnished paper label, bare steel lid that mirrors and hardly scatters; " + _ESTIMATE,
        {"slot_cylinder1": _STEEL, "tin": _STEEL, "tab": _STEEL},
    ),
    "wheel": ObjectMaterial(
        Material(0.03, 0.05),
        "tyre of rubber filled with carbon black, which absorbs the near infrared as well; " + _ESTIMATE,
        {"slot_cylinder0": Material(0.60, 0.30), "rim": Material(0.60, 0.30)},
    ),
    "bread": ObjectMaterial(Material(0.55, 0.01), "dry crust; " + _ESTIMATE),
    "mug": ObjectMaterial(Material(0.45, 0.60), "glazed stoneware; " + _ESTIMATE),
    "bottle": ObjectMaterial(
        Material(0.25, 1.00, translucency=0.60),
        "glass before juice; " + _ESTIMATE,
        {"cap": Material(0.70, 0.20)},
    ),
    "screwdriver": ObjectMaterial(
        Material(0.45, 0.60, translucency=0.30), "clear acetate handle; " + _ESTIMATE, {"shaft": _STEEL}
    ),
    "milk": ObjectMaterial(Material(0.75, 0.10), "printed cardboard; " + _ESTIMATE),
    "hammer": ObjectMaterial(
        Material(0.10, 2.00), "forged steel; " + _ESTIMATE, {"handle": Material(0.60, 0.10)}
    ),
    "bulb": ObjectMaterial(
        Material(0.40, 0.80, translucency=0.50), "frosted glass; " + _ESTIMATE, {"cap": _STEEL}
    ),
}
"""By object name. One that is not listed is guessed from its colour (`Material.from_rgb`)."""

DEFAULT_OBJECT_SPECULAR = 0.2
TABLE_TEXTURE = 0.35
"""Wood grain and wear: what makes a table measurable where the projector's dots are dim; our estimate."""
ROBOT_SPECULAR = 0.3
"""Painted metal and plastic; our estimate."""


def rig_materials(model: mujoco.MjModel, object_name: str = "") -> dict[int, Material]:
    """Near-infrared materials of every geom of the rig's model, by geom id."""
    object_body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "object")
    materials = {}
    for geom, rgb in enumerate(geom_rgb(model)):
        name = model.geom(geom).name
        if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE or name == "table":
            materials[geom] = Material.from_rgb(rgb, texture=TABLE_TEXTURE)
        elif model.geom_bodyid[geom] == object_body:
            materials[geom] = object_material(object_name, name.removeprefix("object_"), rgb)
        else:
            materials[geom] = Material.from_rgb(rgb, specular=ROBOT_SPECULAR)
    return materials


def geom_rgb(model: mujoco.MjModel) -> Float32[np.ndarray, "geoms 3"]:
    """(ngeom, 3) colour of every geom, as MuJoCo's visualiser picks it."""
    return rgba_of(model)[:, :3].astype(np.float32)


def object_material(object_name: str, slot: str, rgb: Colour) -> Material:
    """Material of one slot of an object; guessed from its colour if the object is not listed."""
    listed = OBJECT_MATERIALS.get(object_name)
    if listed is None:
        return Material.from_rgb(rgb, specular=DEFAULT_OBJECT_SPECULAR)
    return listed.parts.get(slot, listed.surface)
