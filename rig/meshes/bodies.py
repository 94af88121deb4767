"""From a description to what MuJoCo takes: drawn meshes, convex parts, inertia, rest pose. JAX-free.

The body's frame has its origin at the centre of mass and is upright as the object rests; the pose is the
stable one nearest to the shape's own (`trimesh.poses`, Goldberg et al. 1999), found for the convex parts.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.util import find_spec

import mujoco
import numpy as np
import trimesh
from jaxtyping import Float64, Int64
from scipy.spatial.transform import Rotation

from ddgrasp import contract
from ddgrasp.errors import UserError
from ddgrasp.install import pip_install
from mjx_envs.object_checks import check_rgb
from rig.meshes.convex import convex_parts
from rig.meshes.objects import MeshObject, get_mesh_object
from rig.meshes.solids import Part, Vector, one_surface, union

Points = Float64[np.ndarray, "_ 3"]
LEAST_MM = 1.0
"""A shape that is shorter in every direction is one in metres."""
MAX_TILT_RAD = 0.5
"""Between the shape as described and as it rests."""
CONTACT_SOLREF = (0.005, 1.0)
"""Time constant (s) and damping ratio of contacts; half of the time constant bounds the time step."""
VISUAL_GROUP, CONTACT_GROUP = 1, 3
"""MuJoCo draws groups 0 to 2 by default."""
_UNREADABLE = (OSError, ValueError, NotImplementedError)
"""What trimesh raises of a file that is absent, damaged or of a type that it does not know."""
_CONTACT = re.compile(r"contact\d+")
"""What `make_spec` calls contact parts."""


@dataclass(frozen=True)
class Surface:
    """A part as it is drawn."""

    name: str
    vertices_m: Points
    faces: Int64[np.ndarray, "f 3"]
    rgb: Vector


@dataclass(frozen=True)
class MeshBody:
    """An object in the frame in which it rests: origin at the centre of mass, z up, fingers close along y."""

    name: str
    surfaces: tuple[Surface, ...]
    convex_m: tuple[Points, ...]
    """Vertices (V, 3) of each convex part."""
    mass_kg: float
    friction: float
    inertia_kg_m2: Float64[np.ndarray, "3 3"]
    rest_height_m: float
    """Height of the origin above the table when the object lies still."""
    tilt_rad: float
    """From the shape as described to the shape at rest."""
    grasp_offset_m: Vector
    """From the origin to the grip."""
    grasp_symmetry: int
    """Number of equivalent gripper yaws per turn; 0 = every yaw is as good."""

    def extents_m(self) -> Float64[np.ndarray, "3"]:
        """(3,) length, width and height as it rests."""
        vertices = np.concatenate([surface.vertices_m for surface in self.surfaces])
        return np.ptp(vertices, axis=0)


@lru_cache(maxsize=32)
def make_body(name: str) -> MeshBody:
    """The named object of `MESH_OBJECTS`; UserError for other names."""
    return body_of(get_mesh_object(name))


def body_of(described: MeshObject) -> MeshBody:
    """What MuJoCo takes of `described`.

    Raises UserError for parts that cannot be told apart, a surface that is no single mesh or not closed, a
    shape in metres, one that no two opposite sides of fit between the fingers, one that does not rest as
    described, and for a concave one where CoACD is not installed.
    """
    _check_libraries()
    parts = _parts(described)
    _check_names(described.name, parts)
    for part in parts:
        check_rgb(f"{described.name}, {part.name}", part.rgb)
        _check_closed(described.name, part)
    parts = [replace(part, mesh=one_surface(part.mesh)) for part in parts]
    solid = union([part.mesh for part in parts])
    _check_fits(described.name, solid)
    hulls = [hull for part in parts for hull in convex_parts(part)]
    turn = _rest_turn(described.name, np.concatenate(hulls), solid.center_mass)
    transform = np.eye(4)
    transform[:3, :3] = 0.001 * turn
    transform[:3, 3] = -0.001 * turn @ solid.center_mass
    convex_m = tuple(trimesh.transform_points(hull, transform) for hull in hulls)
    at_rest = solid.copy().apply_transform(transform)
    grasp_mm = solid.center_mass if described.grasp_mm is None else described.grasp_mm
    x, y, z = trimesh.transform_points(np.array([grasp_mm]), transform)[0]
    return MeshBody(
        described.name, tuple(_surface(part, transform) for part in parts), convex_m,
        described.mass_kg, described.friction,
        inertia_kg_m2=at_rest.moment_inertia * described.mass_kg / at_rest.volume,
        rest_height_m=-float(np.concatenate(convex_m)[:, 2].min()),
        tilt_rad=float(np.arccos(np.clip(turn[2, 2], -1.0, 1.0))),
        grasp_offset_m=(float(x), float(y), float(z)), grasp_symmetry=described.grasp_symmetry,
    )  # fmt: skip


def make_spec(body: MeshBody) -> mujoco.MjSpec:
    """A model of one free body, "free", with its joint "free" and its origin at the centre of mass.

    Geoms named after the surfaces are drawn and touch nothing; `contact{i}` touch and are not drawn.
    """
    spec = mujoco.MjSpec()
    made = spec.worldbody.add_body(name="free", mass=body.mass_kg, explicitinertial=True)
    xx, yy, zz, xy, xz, yz = body.inertia_kg_m2[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    made.fullinertia = [xx, yy, zz, xy, xz, yz]
    made.add_freejoint(name="free")
    for surface in body.surfaces:
        spec.add_mesh(
            name=surface.name, uservert=surface.vertices_m.ravel(), userface=surface.faces.ravel(),
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )  # fmt: skip
        made.add_geom(
            name=surface.name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=surface.name,
            rgba=[*surface.rgb, 1.0], contype=0, conaffinity=0, group=VISUAL_GROUP, mass=0.0,
        )  # fmt: skip
    for i, vertices in enumerate(body.convex_m):
        spec.add_mesh(name=f"contact{i}", uservert=vertices.ravel())
        made.add_geom(
            name=f"contact{i}", type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"contact{i}", group=CONTACT_GROUP,
            mass=0.0, condim=4, priority=1, friction=[body.friction, 0.005, 0.0001], solref=CONTACT_SOLREF,
        )  # fmt: skip
    return spec


def place(
    body: MeshBody, parent: mujoco.MjsBody, x_m: float, y_m: float, yaw_rad: float = 0.0,
    table_m: float = 0.0, name: str = "object",
) -> mujoco.MjsBody:  # fmt: skip
    """Puts the object at rest on a table of height `table_m` in another model; returns its body there.

    Body and free joint are called `name`, geoms and meshes `{name}_{surface}` and `{name}_contact{i}`.

    Args:
      parent: the world body of any MjSpec; it must have no body of that `name`.
      yaw_rad: about the vertical; the fingers close along the object's y axis.
    """
    frame = parent.add_frame(
        pos=[x_m, y_m, table_m + body.rest_height_m],
        quat=[np.cos(yaw_rad / 2), 0.0, 0.0, np.sin(yaw_rad / 2)],
    )
    placed = frame.attach_body(make_spec(body).body("free"), f"{name}_", "")
    placed.name = placed.joints[0].name = name
    return placed


def _surface(part: Part, transform: Float64[np.ndarray, "4 4"]) -> Surface:
    vertices = trimesh.transform_points(part.mesh.vertices, transform)
    return Surface(part.name, vertices, np.asarray(part.mesh.faces, np.int64), part.rgb)


def _rest_turn(
    name: str, points: Points, center_of_mass: Float64[np.ndarray, "3"]
) -> Float64[np.ndarray, "3 3"]:
    """(3, 3) the smallest rotation that brings `points`, resting on their hull, into a stable pose."""
    hull = trimesh.convex.convex_hull(points)
    transforms, _ = trimesh.poses.compute_stable_poses(hull, center_mass=center_of_mass, seed=0)
    ups = transforms[:, 2, :3]
    up = ups[ups[:, 2].argmax()]
    if np.arccos(np.clip(up[2], -1, 1)) > MAX_TILT_RAD:
        degrees = np.degrees(np.arccos(up[2]))
        raise UserError(
            f"{name!r} rests {degrees:.0f} degrees off from how its shape is given: turn the shape, z up, as "
            "it should lie."
        )
    return Rotation.align_vectors([[0.0, 0.0, 1.0]], [up])[0].as_matrix()


def _check_libraries() -> None:
    missing = [name for name in ("manifold3d", "networkx") if find_spec(name) is None]
    if missing:
        raise UserError(f"Mesh objects need {' and '.join(missing)}: {pip_install('fr3')}.")


def _parts(described: MeshObject) -> Sequence[Part]:
    """What its shape gives. UserError, with the reason, where its file cannot be read, or that is no sequence
    of parts."""
    try:
        parts = described.shape()
    except _UNREADABLE as error:
        raise UserError(f"The shape of {described.name!r} cannot be made ({error}).") from error
    if not isinstance(parts, tuple | list) or not all(isinstance(part, Part) for part in parts):
        raise UserError(f"The shape of {described.name!r} gives {parts!r}; expected a tuple of Part.")
    return parts


def _check_names(name: str, parts: Sequence[Part]) -> None:
    names = [part.name for part in parts]
    if not all(names) or len(set(names)) < max(len(names), 1) or any(map(_CONTACT.fullmatch, names)):
        raise UserError(
            f"The parts of {name!r} are called {names}; expected one or more, each with a name of its own, "
            "none of them contact0, contact1, ...: give Part another name."
        )


def _check_closed(name: str, part: Part) -> None:
    if not isinstance(part.mesh, trimesh.Trimesh):  # what trimesh.load gives of a file with several
        raise UserError(
            f"The surface {part.name!r} of {name!r} is a {type(part.mesh).__name__}, not one mesh: read its "
            "file with trimesh.load_mesh."
        )
    if part.mesh.is_volume:
        return
    joined = part.mesh.copy()
    joined.merge_vertices(merge_tex=True, merge_norm=True)
    if joined.is_volume:
        raise UserError(
            f"The surface {part.name!r} of {name!r} has vertices twice, as at the seams of a texture, and so "
            "open edges: mend it with mesh.merge_vertices(merge_tex=True, merge_norm=True)."
        )
    if part.mesh.is_watertight:
        raise UserError(
            f"The surface {part.name!r} of {name!r} is closed, but inside out, or its faces disagree on what "
            "is outside: mend it with trimesh.repair.fix_normals."
        )
    edges = part.mesh.edges_sorted
    _, counts = np.unique(edges, axis=0, return_counts=True)
    raise UserError(
        f"The surface {part.name!r} of {name!r} is not closed ({(counts != 2).sum()} of {len(counts)} edges "
        "do not have two faces): mend it, for instance with trimesh.repair.fill_holes and fix_normals."
    )


def _check_fits(name: str, solid: trimesh.Trimesh) -> None:
    if (longest_mm := float(solid.extents.max())) < LEAST_MM:
        raise UserError(
            f"{name!r} is {longest_mm:.2g} mm long: shapes are given in millimetres; if this one is in "
            "metres, take Part.scaled(1000)."
        )
    directions = trimesh.creation.icosphere(subdivisions=3).vertices
    thinnest_mm = float(np.ptp(solid.convex_hull.vertices @ directions.T, axis=0).min())
    widest_mm = 1000 * contract.GRIPPER_MAX_WIDTH_M
    if thinnest_mm > widest_mm:
        size = " x ".join(f"{extent:.0f}" for extent in solid.extents)
        raise UserError(
            f"{name!r} ({size} mm) is {thinnest_mm:.0f} mm thick where it is thinnest and the hand opens "
            f"{widest_mm:.0f} mm: scale it to {0.95 * widest_mm / thinnest_mm:.2f} of its size or less."
        )
