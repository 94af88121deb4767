"""The geoms of a MuJoCo model that a camera sees, and how they look. JAX-free."""

from typing import NamedTuple

import mujoco
import numpy as np

from ddgrasp.errors import UserError
from mjx_envs.render import ray_geometry

VISIBLE_GROUPS = (0, 1, 2)
"""MuJoCo's own default: groups 3 and above are collision geometry and are not drawn."""

BACKGROUND_RGB = (0.72, 0.74, 0.78)
AMBIENT = 0.45
"""Share of the albedo that shows without direct light."""
LIGHT_DIRECTION_W = (0.3244428, -0.4866643, 0.8111071)
"""Unit vector towards the light, world frame."""

_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], np.float32)
"""MuJoCo's: a geom that has it takes its material's colour."""

_TYPE_NAMES = {
    int(mujoco.mjtGeom.mjGEOM_PLANE): "plane",
    int(mujoco.mjtGeom.mjGEOM_SPHERE): "sphere",
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): "capsule",
    int(mujoco.mjtGeom.mjGEOM_BOX): "box",
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): "cylinder",
}


class VisibleGeoms(NamedTuple):
    """G geoms, in the model's order."""

    ids: np.ndarray
    """(G,) int32 geom id in the model."""
    types: tuple[str, ...]
    """Keys of `ray_geometry.HIT`."""
    size: np.ndarray
    """(G, 3) float32, metres, MuJoCo's conventions."""
    rgb: np.ndarray
    """(G, 3) float32 albedo in [0, 1]."""


def visible_geoms(model: mujoco.MjModel) -> VisibleGeoms:
    """The geoms of groups 0 to 2 that are not fully transparent.

    Raises UserError for a type without an analytic intersection (mesh, height field, ellipsoid).
    """
    rgba = rgba_of(model)
    ids = np.flatnonzero(np.isin(model.geom_group, VISIBLE_GROUPS) & (rgba[:, 3] > 0)).astype(np.int32)
    return VisibleGeoms(
        ids=ids,
        types=tuple(_type_name(model, int(i)) for i in ids),
        size=model.geom_size[ids].astype(np.float32),
        rgb=rgba[ids, :3].astype(np.float32),
    )


def rgba_of(model: mujoco.MjModel) -> np.ndarray:
    """(ngeom, 4) colours as MuJoCo's visualiser picks them: the material's unless the geom has its own."""
    rgba = np.array(model.geom_rgba)
    from_material = (model.geom_matid >= 0) & np.all(rgba == _DEFAULT_RGBA, axis=1)
    rgba[from_material] = model.mat_rgba[model.geom_matid[from_material]]
    return rgba


def _type_name(model: mujoco.MjModel, geom_id: int) -> str:
    name = _TYPE_NAMES.get(int(model.geom_type[geom_id]))
    if name is None:
        kind = mujoco.mjtGeom(int(model.geom_type[geom_id])).name
        raise UserError(
            f"geom {model.geom(geom_id).name!r} (id {geom_id}) is a {kind}; the ray casters draw "
            f"{', '.join(ray_geometry.HIT)}: use primitives, or put it into group 3 to hide it"
        )
    return name
