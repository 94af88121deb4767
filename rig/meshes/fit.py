"""How well the convex parts follow the surfaces that are drawn. JAX-free."""

from dataclasses import dataclass

import numpy as np
import trimesh
from scipy.spatial import KDTree

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
    drawn = union([
        trimesh.Trimesh(1000 * surface.vertices_m, surface.faces, process=False) for surface in body.surfaces
    ])  # fmt: skip
    contact = union([trimesh.convex.convex_hull(1000 * vertices) for vertices in body.convex_m])
    outside_mm, inside_mm = _beyond(contact, drawn), _beyond(drawn, contact)
    return Fit(contact.volume / drawn.volume, outside_mm / 1000, inside_mm / 1000)


def _beyond(solid: trimesh.Trimesh, other: trimesh.Trimesh) -> float:
    """Largest distance of what `solid` has outside of `other` to the surface of `other`."""
    excess = without(solid, [other])
    if excess.is_empty:
        return 0.0
    points = trimesh.sample.sample_surface(other, _SAMPLES, seed=0)[0]
    probes = trimesh.sample.sample_surface(excess, _SAMPLES // 3, seed=1)[0]
    away, _ = KDTree(points).query(np.concatenate([probes, excess.vertices]))
    return float(away.max())
