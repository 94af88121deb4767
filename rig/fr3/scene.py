"""What stands around the rig's FR3: table, wall, clutter, and one object to grasp. JAX-free.

The world frame is the robot's base, as in the contract: x forward, z up, table top at z = 0.
"""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

import numpy as np

from ddgrasp import contract
from mjx_envs.object_checks import check_symmetry
from mjx_envs.object_spec import ObjectSpec, SlotLayout, slot_layout
from mjx_envs.objects import get_object
from mjx_envs.scene import mjcf

OBJECT_BODY, OBJECT_JOINT = "object", "object_free"
TABLE, TABLE_RGBA = "table", "0.55 0.5 0.45 1"
FLOOR_Z_M = -0.75
TABLE_CENTER_M, TABLE_HALF_M = (0.45, 0.0, -0.02), (0.85, 0.75, 0.02)
WALL_CENTER_M, WALL_HALF_M = (-0.62, 0.0, 0.6), (0.02, 1.5, 1.35)
CLUTTER_X_M, CLUTTER_Y_M = (0.30, 0.75), (0.40, 0.60)
"""Where clutter stands, on either side: outside the workspace, and beside what the hand sweeps above it."""
CLUTTER_COUNT = 4
_HIDDEN_M = 0.0011
"""Slots of an object that are no larger than this hold nothing."""


@dataclass(frozen=True)
class SceneObject:
    """One free body as MJCF: whatever gives these strings can be put on the rig's table."""

    name: str
    geoms_xml: str
    """Children of its <body>: geoms, and an <inertial> if density is not to give it. The body's origin is
    what the rig reports as the object's position."""
    rest_height_m: float
    """Height of that origin above the table, as it lies."""
    assets_xml: str = ""
    """Children of <asset>; mesh files by absolute path."""
    grasp_offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """From the origin to where a hand grips it from above, its fingers closing along the body's y."""
    grasp_symmetry: int = 2
    """Yaws per turn in which it can be gripped alike; 0 = every yaw."""

    def __post_init__(self):
        """UserError for a symmetry that no parallel hand has."""
        check_symmetry(self.name, self.grasp_symmetry)


def primitive(name: str) -> SceneObject:
    """One of the project's own objects. Raises UserError for an unknown name."""
    spec = get_object(name)
    layout = slot_layout([spec])
    inertia = mjcf(spec.inertia_kg_m2())
    inertial = f'<inertial mass="{spec.mass_kg}" pos="0 0 0" diaginertia="{inertia}"/>'
    geoms = inertial + _slot_geoms(spec, layout)
    grasp = {"grasp_offset_m": spec.grasp_offset_m, "grasp_symmetry": spec.grasp_symmetry}
    return SceneObject(name, geoms, spec.rest_height_m, **grasp)


def meshed(name: str) -> SceneObject:
    """One of the mesh objects. Raises UserError for an unknown name, or without the extra [fr3]."""
    from rig.meshes.bodies import CONTACT_SOLREF, make_body

    body = make_body(name)
    xx, yy, zz, xy, xz, yz = body.inertia_kg_m2[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    inertia = mjcf((xx, yy, zz, xy, xz, yz))
    geoms = [f'<inertial mass="{body.mass_kg}" pos="0 0 0" fullinertia="{inertia}"/>']
    assets = []
    for surface in body.surfaces:
        mesh = quoteattr(f"{OBJECT_BODY}_{surface.name}")
        vertices, faces = mjcf(surface.vertices_m.ravel()), " ".join(map(str, surface.faces.ravel()))
        assets.append(f'<mesh name={mesh} vertex="{vertices}" face="{faces}" inertia="shell"/>')
        look = f'rgba="{mjcf(surface.rgb)} 1" contype="0" conaffinity="0" group="1"'
        geoms.append(f'<geom name={mesh} type="mesh" mesh={mesh} {look} mass="0"/>')
    touching = _touching(body.friction, mjcf(CONTACT_SOLREF))
    for i, vertices_m in enumerate(body.convex_m):
        mesh = f"{OBJECT_BODY}_contact{i}"
        assets.append(f'<mesh name="{mesh}" vertex="{mjcf(vertices_m.ravel())}"/>')
        geoms.append(f'<geom name="{mesh}" type="mesh" mesh="{mesh}" group="3" mass="0" {touching}/>')
    grasp = {"grasp_offset_m": body.grasp_offset_m, "grasp_symmetry": body.grasp_symmetry}
    return SceneObject(name, "".join(geoms), body.rest_height_m, "".join(assets), **grasp)


def furnish(scene: ET.Element, thing: SceneObject, seed: int, bare: bool = False) -> None:
    """Adds table, wall, clutter and the object to franky-sim's scene; its ground becomes the floor.

    Args:
      scene: root of the MJCF, before it is compiled.
      seed: clutter and the object's place on the table follow from it.
      bare: the object alone, on the ground on which the arm stands.
    """
    option = scene.find("option")
    assert option is not None
    # Friction cones and their stiffness as in the project's own scenes: else what is held creeps.
    option.attrib |= {"cone": "elliptic", "impratio": "10"}
    world = scene.find("worldbody")
    ground = scene.find("worldbody/geom[@name='ground']")
    assets = scene.find("asset")
    assert world is not None and ground is not None and assets is not None
    rng = np.random.default_rng(seed)
    if not bare:
        ground.set("pos", f"0 0 {FLOOR_Z_M}")
        _box(world, TABLE, TABLE_CENTER_M, TABLE_HALF_M, TABLE_RGBA)
        add_surroundings(world, rng)
    assets.extend(ET.fromstring(f"<asset>{thing.assets_xml}</asset>"))
    xy_m, yaw_rad = start_pose(rng)
    world.append(_object(thing, xy_m, yaw_rad))


def add_surroundings(world: ET.Element, rng: np.random.Generator) -> None:
    """The wall, and clutter as drawn, into a <worldbody>."""
    _box(world, "wall", WALL_CENTER_M, WALL_HALF_M, "0.75 0.75 0.72 1")
    for index in range(CLUTTER_COUNT):
        _clutter(world, index, rng)


def start_pose(rng: np.random.Generator) -> tuple[tuple[float, float], float]:
    """Where the object lies: x and y within the contract's workspace, metres, and a yaw, radians."""
    center, size = np.array(contract.WORKSPACE_CENTER_M), np.array(contract.WORKSPACE_SIZE_M)
    x, y = center + rng.uniform(-0.5, 0.5, 2) * size
    return (float(x), float(y)), float(rng.uniform(-np.pi, np.pi))


def _object(thing: SceneObject, xy_m: tuple[float, float], yaw_rad: float) -> ET.Element:
    place = f'pos="{mjcf((*xy_m, thing.rest_height_m))}" euler="0 0 {yaw_rad}"'
    free = f'<freejoint name="{OBJECT_JOINT}"/>'
    return ET.fromstring(f'<body name="{OBJECT_BODY}" {place}>{free}{thing.geoms_xml}</body>')


def _slot_geoms(spec: ObjectSpec, layout: SlotLayout) -> str:
    """Geoms of a primitive; those that only show (cylinders, plates) do not collide."""
    touching = _touching(spec.friction, "0.004 1")
    geoms = ""
    columns = zip(layout.names, layout.kinds, *spec.slot_arrays(layout), spec.slot_rgb(layout), strict=True)
    for name, kind, size, pos, quat, rgb in columns:
        if max(size) <= _HIDDEN_M:
            continue
        contact = touching if name in layout.colliding_names else 'contype="0" conaffinity="0"'
        shape = f'type="{kind}" size="{mjcf(size)}" pos="{mjcf(pos)}" quat="{mjcf(quat)}"'
        geoms += f'<geom name="{name}" {shape} mass="0" rgba="{mjcf(rgb)} 1" {contact}/>'
    return geoms


def _touching(friction: float, solref: str) -> str:
    return f'condim="4" priority="1" friction="{friction} 0.005 0.0001" solref="{solref}"'


def _clutter(world: ET.Element, index: int, rng: np.random.Generator) -> None:
    """A box or a cylinder that stands on the table beside the workspace; sides alternate."""
    half = rng.uniform((0.02, 0.02, 0.02), (0.05, 0.05, 0.07))
    x, y = rng.uniform(*CLUTTER_X_M), rng.uniform(*CLUTTER_Y_M) * (-1) ** index
    rgba = f"{mjcf(rng.uniform(0.2, 0.8, 3))} 1"
    _box(world, f"clutter{index}", (x, y, half[2]), half, rgba, "box" if index < 2 else "cylinder")


def _box(parent: ET.Element, name: str, center_m, half_m, rgba: str, kind: str = "box") -> None:
    size = half_m if kind == "box" else (half_m[0], half_m[2])
    geom = {"name": name, "type": kind, "pos": mjcf(center_m), "size": mjcf(size), "rgba": rgba}
    ET.SubElement(parent, "geom", geom)
