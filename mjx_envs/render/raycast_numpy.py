"""Depth, colour, segmentation and normals of a MuJoCo state by ray casting, NumPy alone.

Quick because a geom is tested only inside its screen-space bounding box and only its visible
pixels are shaded. `raycast.py` renders the same picture under JAX.
"""

from dataclasses import dataclass

import mujoco
import numpy as np

from mjx_envs.camera import Buffers, Camera
from mjx_envs.render import ray_geometry
from mjx_envs.render.ray_geometry import Vector, vector
from mjx_envs.render.visible_geoms import (
    AMBIENT,
    BACKGROUND_RGB,
    LIGHT_DIRECTION_W,
    VisibleGeoms,
    visible_geoms,
)

_NEAR_M = 0.01
"""A bounding box with a corner nearer than this to the camera plane is not projected."""
_CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)

Window = tuple[slice, slice]


@dataclass(frozen=True)
class _View:
    """The visible geoms as the camera sees them; rays have z = 1 in the camera frame."""

    geoms: VisibleGeoms
    origin_g: np.ndarray
    """(G, 3) camera position in each geom's frame."""
    rot_g_cam: np.ndarray
    """(G, 3, 3) camera axes in each geom's frame."""
    rot_w: np.ndarray
    """(G, 3, 3) geom axes in the world frame."""
    x: np.ndarray
    """(1, W) ray x per column."""
    y: np.ndarray
    """(H, 1) ray y per row."""
    windows: list[Window | None]
    """Rows and columns that can show the geom; None if it is behind the camera or off the picture."""


def render(model: mujoco.MjModel, data: mujoco.MjData, camera: Camera, far_m: float = 2.0) -> Buffers:
    """Everything `camera` sees, geom poses as they stand in `data` (call mj_forward yourself).

    Planar depth in metres, 0 beyond `far_m`; the other buffers have no such limit.
    """
    view = _view(model, data, camera)
    t, winner = _cast(view)
    rgb, normal_w = _shaded(view, t, winner)
    segmentation = np.append(view.geoms.ids, np.int32(-1)).take(winner)
    return Buffers(_limited(t, far_m), rgb, segmentation, normal_w)


def render_depth(
    model: mujoco.MjModel, data: mujoco.MjData, camera: Camera, far_m: float = 2.0
) -> np.ndarray:
    """(H, W) float32 planar depth in metres alone; 0 beyond `far_m` or where nothing is hit."""
    t, _ = _cast(_view(model, data, camera))
    return _limited(t, far_m)


def _limited(t: np.ndarray, far_m: float) -> np.ndarray:
    return np.where(t <= far_m, t, np.float32(0))


def _view(model: mujoco.MjModel, data: mujoco.MjData, camera: Camera) -> _View:
    geoms = visible_geoms(model)
    rot_w = data.geom_xmat[geoms.ids].reshape(-1, 3, 3)
    pos_w = data.geom_xpos[geoms.ids]
    rot_w_cam, cam_w = camera.T_world_cam[:3, :3], camera.T_world_cam[:3, 3]
    rot_cam_g = rot_w_cam.T @ rot_w
    pos_cam = (pos_w - cam_w) @ rot_w_cam
    columns = (np.arange(camera.width_px) + 0.5 - camera.cx_px) / camera.fx_px
    rows = (np.arange(camera.height_px) + 0.5 - camera.cy_px) / camera.fy_px
    return _View(
        geoms=geoms,
        origin_g=np.einsum("gji,gj->gi", rot_w, cam_w - pos_w).astype(np.float32),
        rot_g_cam=rot_cam_g.transpose(0, 2, 1).astype(np.float32),
        rot_w=rot_w.astype(np.float32),
        x=columns.astype(np.float32)[None, :],
        y=rows.astype(np.float32)[:, None],
        windows=_windows(geoms, pos_cam, rot_cam_g, camera),
    )


def _half_extents(geoms: VisibleGeoms) -> np.ndarray:
    """(G, 3) half sizes of the local bounding box, metres; infinite for an infinite plane."""
    half = geoms.size.copy()
    for g, (kind, size) in enumerate(zip(geoms.types, geoms.size, strict=True)):
        if kind == "sphere":
            half[g] = size[0]
        elif kind == "capsule":
            half[g] = size[0], size[0], size[0] + size[1]
        elif kind == "cylinder":
            half[g] = size[0], size[0], size[1]
        elif kind == "plane":
            half[g] = size[0] or np.inf, size[1] or np.inf, 0
    return half


def _windows(
    geoms: VisibleGeoms, pos_cam: np.ndarray, rot_cam_g: np.ndarray, camera: Camera
) -> list[Window | None]:
    half = _half_extents(geoms)
    finite = np.all(np.isfinite(half), axis=1)
    corners = np.where(finite[:, None], half, 1.0)[:, None, :] * _CORNERS
    corners = corners @ rot_cam_g.transpose(0, 2, 1) + pos_cam[:, None, :]
    z = corners[..., 2]
    whole = ~finite | (z.min(axis=1) < _NEAR_M)
    behind = finite & (z.max(axis=1) <= 0)
    u = camera.fx_px * corners[..., 0] / np.maximum(z, _NEAR_M) + camera.cx_px
    v = camera.fy_px * corners[..., 1] / np.maximum(z, _NEAR_M) + camera.cy_px
    rows = _pixel_span(v, camera.height_px, whole)
    columns = _pixel_span(u, camera.width_px, whole)
    return [
        None if behind[g] or r[0] >= r[1] or c[0] >= c[1] else (slice(*r), slice(*c))
        for g, (r, c) in enumerate(zip(rows, columns, strict=True))
    ]


def _pixel_span(position: np.ndarray, count: int, whole: np.ndarray) -> list[list[int]]:
    """[first, end) pixel whose centre (+0.5) can lie within (G, 8) `position`, clipped to the picture."""
    first = np.where(whole, 0, np.clip(np.floor(position.min(axis=1) - 0.5), 0, count))
    end = np.where(whole, count, np.clip(np.ceil(position.max(axis=1) - 0.5) + 1, 0, count))
    return np.stack([first, end], axis=1).astype(int).tolist()


def _direction(rot_g_cam: np.ndarray, x: np.ndarray, y: np.ndarray) -> Vector:
    """Rays in the geom's frame; linear in column and row, so one addition per component and pixel."""
    return vector(row[0] * x + (row[1] * y + row[2]) for row in rot_g_cam)


def _cast(view: _View) -> tuple[np.ndarray, np.ndarray]:
    """(H, W) nearest t (inf where nothing is hit) and (H, W) index of the winner (-1)."""
    shape = (view.y.shape[0], view.x.shape[1])
    nearest = np.full(shape, np.inf, np.float32)
    winner = np.full(shape, -1, np.int16)  # few bytes sort quickly
    for g, window in enumerate(view.windows):
        if window is None:
            continue
        direction = _direction(view.rot_g_cam[g], view.x[:, window[1]], view.y[window[0]])
        kind, size = view.geoms.types[g], view.geoms.size[g]
        t = ray_geometry.HIT[kind](np, vector(view.origin_g[g]), direction, size)
        nearer = t < nearest[window]
        np.copyto(nearest[window], t, where=nearer)
        np.copyto(winner[window], np.int16(g), where=nearer)
    return nearest, winner


def _shaded(view: _View, t: np.ndarray, winner: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(H, W, 3) Lambert-shaded colours and (H, W, 3) normals in the world frame.

    What is the same in all pixels of a geom, or where none is, is looked up for all pixels at once.
    """
    count = len(view.windows)
    table = np.zeros((2, count + 1, 3), np.float32)  # the last is for the -1 of pixels that hit nothing
    table[0, -1] = BACKGROUND_RGB
    flat = [g for g, kind in enumerate(view.geoms.types) if kind == "plane"]
    table[1, flat] = view.rot_w[flat, :, 2]
    for g in flat:
        table[0, g] = _lambert(table[1, g][None], view.geoms.rgb[g])
    rgb, normal_w = (values.take(winner, axis=0) for values in table)
    order = np.argsort(winner, axis=None, kind="stable")
    first, *ends = np.cumsum(np.bincount(winner.ravel() + 1, minlength=count + 1)).tolist()
    for g, end in enumerate(ends):
        pixels, first = order[first:end], end
        if len(pixels) and g not in flat:
            normal = _normals(view, g, t, pixels)
            normal_w.reshape(-1, 3)[pixels] = normal
            rgb.reshape(-1, 3)[pixels] = _lambert(normal, view.geoms.rgb[g])
    return rgb, normal_w


def _normals(view: _View, g: int, t: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """(n, 3) normals in the world frame of geom `g` at n `pixels`, counted row by row."""
    rows, columns = np.divmod(pixels, t.shape[1])
    direction = _direction(view.rot_g_cam[g], view.x[0, columns], view.y[rows, 0])
    depth = t.ravel()[pixels]
    point = vector(o + depth * d for o, d in zip(view.origin_g[g], direction, strict=True))
    local = ray_geometry.NORMAL[view.geoms.types[g]](np, point, view.geoms.size[g])
    return np.stack(local, axis=-1) @ view.rot_w[g].T


def _lambert(normal_w: np.ndarray, rgb: np.ndarray) -> np.ndarray:
    """(n, 3) colours of a geom of colour `rgb` where it has those (n, 3) normals."""
    lambert = np.maximum(normal_w @ np.asarray(LIGHT_DIRECTION_W, np.float32), 0)
    shade = np.float32(AMBIENT) + np.float32(1 - AMBIENT) * lambert
    return shade[:, None] * rgb
