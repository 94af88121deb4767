"""Convex parts for contact: a hull where that will do, CoACD (Wei et al. 2022) where it will not. JAX-free.

CoACD takes seconds to minutes. What it found for the shapes of this package lies beside this file, so that
the test rig is the same on every machine; what it finds for others is kept in the user's cache. Either is
named by a hash of the mesh and the settings. `python -m rig.meshes.convex` makes the file anew.
"""

import hashlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import trimesh
from jaxtyping import Float64

from ddgrasp.errors import UserError
from ddgrasp.files import DAMAGED_NPZ, atomic_path, user_cache
from ddgrasp.install import pip_install
from rig.meshes.solids import Part

SHIPPED = Path(__file__).with_name("convex.npz")
SETTINGS = {
    "threshold": 0.05, "max_convex_hull": 24, "preprocess_mode": "off", "seed": 0,
    "mcts_iterations": 40, "mcts_nodes": 10, "mcts_max_depth": 2,
}  # fmt: skip
"""For `coacd.run_coacd`; `threshold` is its concavity, about a share of the shape's size."""
MAX_VERTICES = 200
"""Per part; smooth hulls have more, and keep those that stick out furthest in evenly spread directions."""
_SIMPLIFY_MM = 0.3
"""CoACD's time goes with the number of faces."""
_STORED_MM = 0.01
"""What a unit of the stored integers is."""

Hull = Float64[np.ndarray, "_ 3"]


def convex_parts(part: Part) -> list[Hull]:
    """Vertices (V, 3) of each convex part, millimetres; UserError without CoACD where that is needed."""
    if not part.concave:
        return [_reduced(part.mesh)]
    key = _key(part.mesh)
    for file in (SHIPPED, _cached(key)):
        if (found := _read(file, key)) is not None:
            return found
    _write(_cached(key), {key: _decompose(part)})
    found = _read(_cached(key), key)
    assert found is not None
    return found


def _decompose(part: Part) -> list[Hull]:
    try:
        import coacd
    except ImportError:
        raise UserError(
            f"{part.name!r} is not convex and CoACD is not installed: {pip_install('fr3')}."
        ) from None
    coacd.set_log_level("error")
    mesh = _simplified(part.mesh)
    found = coacd.run_coacd(coacd.Mesh(mesh.vertices, mesh.faces), **SETTINGS)
    return [_reduced(trimesh.convex.convex_hull(vertices)) for vertices, _ in found]


def _simplified(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """`mesh` with as few faces as stay within `_SIMPLIFY_MM` of it."""
    import manifold3d

    made = manifold3d.Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.uint32))
    simple = manifold3d.Manifold(made).simplify(_SIMPLIFY_MM).to_mesh()
    return trimesh.Trimesh(simple.vert_properties, simple.tri_verts, process=False)


def _reduced(mesh: trimesh.Trimesh) -> Hull:
    """(V, 3) vertices of the hull of `mesh`, about MAX_VERTICES at most; faces across an axis stay flat."""
    vertices = np.asarray(mesh.convex_hull.vertices)
    if len(vertices) <= MAX_VERTICES:
        return vertices
    directions = trimesh.creation.icosphere(subdivisions=2).vertices
    kept = set((vertices @ directions.T).argmax(axis=0).tolist())
    for axis in np.concatenate([np.eye(3), -np.eye(3)]):
        reach = vertices @ axis
        kept |= set(np.flatnonzero(reach > reach.max() - 1e-3).tolist())
    return vertices[sorted(kept)]


def _key(mesh: trimesh.Trimesh) -> str:
    """Hash of the mesh to the micrometre, and of the settings."""
    digest = hashlib.sha256(repr(sorted(SETTINGS.items())).encode())
    digest.update(np.rint(1000 * mesh.vertices).astype(np.int32).tobytes())
    digest.update(np.asarray(mesh.faces, np.int32).tobytes())
    return digest.hexdigest()[:16]


def _cached(key: str) -> Path:
    return user_cache("meshes") / f"{key}.npz"


def _read(file: Path, key: str) -> list[Hull] | None:
    """What is stored; None where nothing is, or a file that is damaged and can be made again."""
    with suppress(FileNotFoundError, *DAMAGED_NPZ), np.load(file) as stored:
        if key in stored:
            ends = np.cumsum(stored[f"{key}-counts"])[:-1]
            return np.split(_STORED_MM * stored[key], ends)
    return None


def _write(file: Path, found: dict[str, list[Hull]]) -> None:
    arrays: dict[str, np.ndarray] = {}
    for key, hulls in found.items():
        arrays[key] = np.rint(np.concatenate(hulls) / _STORED_MM).astype(np.int32)
        arrays[f"{key}-counts"] = np.array([len(hull) for hull in hulls])
    with atomic_path(file) as temporary:
        np.savez_compressed(temporary, allow_pickle=False, **arrays)


def main() -> None:
    """Decompose every shape of the table anew, by way of the user's cache, into the file shipped."""
    from rig.meshes.objects import MESH_OBJECTS

    found = {}
    for described in MESH_OBJECTS.values():
        for part in described.shape():
            if part.concave:
                found[_key(part.mesh)] = convex_parts(part)
                print(f"{described.name} {part.name}: {len(found[_key(part.mesh)])} convex parts", flush=True)
    _write(SHIPPED, found)


if __name__ == "__main__":
    main()
