"""How well the convex parts follow the surfaces that are drawn. JAX-free."""

from dataclasses import dataclass

import trimesh
from scipy.spatial import cKDTree

from rig.meshes.bodies import MeshBody
from rig.meshes.solids import union, without

_SAMPLES = 30_000


@dataclass(frozen=True)
class Fit:
    """Contact shape against drawn shape."""

    volume_ratio: float
    """Contact over drawn."""
    outside_m: float
    """How far the contact shape stands out of the drawn one, at most: half of the Hausdorff distance."""
    inside_m: float
    """How far the drawn shape stands out of the contact one, at most: the other half."""


def fit(body: MeshBody) -> Fit:
    """Compares the unions of both; distances are to 30,000 points of a surface, so up to 1 mm too long."""
    drawn = union([trimesh.Trimesh(surface.vertices_m, surface.faces) for surface in body.surfaces])
    contact = union([trimesh.convex.convex_hull(vertices) for vertices in body.convex_m])
    return Fit(contact.volume / drawn.volume, _beyond(contact, drawn), _beyond(drawn, contact))


def _beyond(solid: trimesh.Trimesh, other: trimesh.Trimesh) -> float:
    """Largest distance of what `solid` has outside of `other` to the surface of `other`, at its corners."""
    excess = without(solid, [other])
    if excess.is_empty:
        return 0.0
    points, _ = trimesh.sample.sample_surface(other, _SAMPLES, seed=0)
    away, _ = cKDTree(points).query(excess.vertices)
    return float(away.max())
