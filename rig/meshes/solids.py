"""Closed surfaces: lofts through rings, surfaces of revolution, rounded boxes, unions. JAX-free.

Lengths here and in the shapes made of it are millimetres; `Part.scaled` ends that.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh
from jaxtyping import Float64
from scipy.interpolate import CubicSpline

SIDES = 48
"""Points around a ring."""
_INSIDE = 1e-3
"""A shell of which no larger share stands out of another lies inside of it."""

Points = Sequence[Sequence[float]]
Vector = tuple[float, float, float]
Angles = Float64[np.ndarray, " n"]


@dataclass(frozen=True)
class Part:
    """One closed surface of an object in one colour."""

    name: str
    mesh: trimesh.Trimesh
    rgb: Vector
    concave: bool = False
    """Whether its convex hull will not do for contact: it is then decomposed."""

    def scaled(self, factor: float) -> "Part":
        """A copy with all lengths times `factor`."""
        return self.moved(np.diag([factor, factor, factor, 1.0]))

    def moved(self, transform: Float64[np.ndarray, "4 4"]) -> "Part":
        """A copy after the homogeneous `transform` (4, 4)."""
        return replace(self, mesh=self.mesh.copy().apply_transform(transform))


def spline(points: Points, count: int = 40) -> Float64[np.ndarray, "k 2"]:
    """(count, 2) along a cubic spline through `points`, by length of chord."""
    knots = np.asarray(points, float)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    return CubicSpline(along, knots)(np.linspace(0.0, along[-1], count))


def around(count: int = SIDES) -> Angles:
    """(count,) angles evenly around a turn, rad."""
    return np.linspace(0.0, 2 * np.pi, count, endpoint=False)


def loft(rings: Float64[np.ndarray, "k n 3"]) -> trimesh.Trimesh:
    """The closed surface through K rings of N points each, both ends closed by fans to their middle."""
    count, sides, _ = rings.shape
    grid = np.arange(count * sides).reshape(count, sides)
    a, b = grid[:-1].ravel(), np.roll(grid[:-1], -1, axis=1).ravel()
    c, d = grid[1:].ravel(), np.roll(grid[1:], -1, axis=1).ravel()
    first, last = grid.size, grid.size + 1
    faces = np.concatenate([
        np.stack([a, b, d], 1), np.stack([a, d, c], 1),
        np.stack([np.full(sides, first), np.roll(grid[0], -1), grid[0]], 1),
        np.stack([np.full(sides, last), grid[-1], np.roll(grid[-1], -1)], 1),
    ])  # fmt: skip
    vertices = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(axis=1)])
    mesh = trimesh.Trimesh(vertices, faces, process=True)
    mesh.fix_normals()
    return mesh


def turned(
    profile: Float64[np.ndarray, "k 2"],
    shape: Callable[[Angles, float], Angles] = lambda angle, share: np.ones_like(angle),
) -> trimesh.Trimesh:
    """A surface about z through `profile` (radius, height), from one pole to the other.

    `shape(angles, share)` multiplies the radii; `share` runs from 0 to 1 along the profile.
    """
    angle = around()
    shares = np.linspace(0.0, 1.0, len(profile))
    radii = np.stack(
        [max(r, 1e-3) * shape(angle, share) for (r, _), share in zip(profile, shares, strict=True)]
    )
    heights = np.broadcast_to(profile[:, 1:], radii.shape)
    return loft(np.stack([radii * np.cos(angle), radii * np.sin(angle), heights], axis=-1))


def tube(path: Points, radii: Sequence[float], sides: int = 16) -> trimesh.Trimesh:
    """A round rod whose axis runs through `path`, thick as `radii` say at each point."""
    return sweep(path, radii, np.stack([np.cos(around(sides)), np.sin(around(sides))], axis=1))


def sweep(path: Points, scales: Sequence[float], section: Float64[np.ndarray, "n 2"]) -> trimesh.Trimesh:
    """`section` (N, 2) times `scales`, carried along a smooth curve through `path` which lies in a plane."""
    knots = np.asarray(path, float)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    at = np.linspace(0.0, along[-1], 8 * len(knots))
    curve = CubicSpline(along, knots)
    centres, ahead = curve(at), curve(at, 1)
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    normal = _plane_normal(knots)
    aside = np.cross(normal, ahead)
    size = np.interp(at, along, scales)[:, None, None]
    offsets = section[:, :1] * aside[:, None] + section[:, 1:] * normal
    return loft(centres[:, None] + size * offsets)


def rounded_box(size: Vector, radius: float) -> trimesh.Trimesh:
    """A box of outer `size` whose edges are rounded: the hull of eight balls."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius).vertices
    centres = corners * (np.array(size) / 2 - radius)
    return trimesh.convex.convex_hull((centres[:, None] + ball).reshape(-1, 3))


def lathe(profile: Points) -> trimesh.Trimesh:
    """The surface of revolution about z of `profile` (radius, height), closed or ending on the axis."""
    mesh = trimesh.creation.revolve(np.asarray(profile, float), sections=SIDES)
    mesh.fix_normals()
    return mesh


def union(meshes: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One surface around all of `meshes`, which must be closed."""
    return trimesh.boolean.union(list(meshes), engine="manifold") if len(meshes) > 1 else meshes[0]


def one_surface(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """`mesh`, closed, without what lies inside of it: shells that overlap become one, hollows stay.

    Overlaps would weigh twice, and CoACD does not survive them. A shell that is inside out and no hollow is
    turned.
    """
    if mesh.body_count == 1:
        return mesh
    shells = mesh.split(only_watertight=False)
    outer, inverted = ([s for s in shells if (s.volume > 0) == sign] for sign in (True, False))
    solid, hollows = union(outer), []
    for shell in inverted:
        shell.invert()
        beyond = without(shell, [solid])
        inside = beyond.is_empty or beyond.volume < _INSIDE * shell.volume
        (hollows if inside else outer).append(shell)
    return without(union(outer), hollows) if hollows else union(outer)


def without(mesh: trimesh.Trimesh, removed: Sequence[trimesh.Trimesh]) -> trimesh.Trimesh:
    """`mesh` less the space of all of `removed`."""
    return trimesh.boolean.difference([mesh, *removed], engine="manifold")


def turn(axis: Vector, degrees: float, at: Vector = (0.0, 0.0, 0.0)) -> Float64[np.ndarray, "4 4"]:
    """(4, 4) turn about `axis` through the origin, then a shift to `at`."""
    transform = trimesh.transformations.rotation_matrix(np.radians(degrees), axis)
    transform[:3, 3] = at
    return transform


def _plane_normal(points: Float64[np.ndarray, "k 3"]) -> Float64[np.ndarray, "3"]:
    """(3,) normal of the plane of `points`; any one across, if they lie on a line."""
    return np.linalg.svd(points - points.mean(axis=0))[2][2]
