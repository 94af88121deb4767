"""A depth picture drawn from places beside the camera that took it. NumPy.

What the picture does not show (behind a nearer surface, beyond the border) is taken to be the farther of the
row's nearest surfaces, continued at its depth. Enough for the imagers and the projector of a stereo camera,
which stand a few centimetres apart along the rows.
"""

from collections.abc import Callable, Iterator

import numpy as np
from jaxtyping import Float

from ddgrasp.contract import CameraProfile
from mjx_envs.camera import Buffers, Camera

NOTHING_M = 100.0
"""Invalid pixels are drawn as if this far away, and reported as 0 again."""
SAME_SURFACE = 1.08
"""Neighbouring depths less than this ratio apart belong to one surface."""
MOST_STRETCH_PX = 4
"""Two neighbours of one surface are drawn at most this far apart."""


def from_beside(
    depth_m: Float[np.ndarray, "H W"],
    rgb: Float[np.ndarray, "H W 3"],
    profile: CameraProfile,
    T_world_cam: Float[np.ndarray, "4 4"],
) -> Callable[[Camera], Buffers]:
    """A renderer of the surfaces in one picture, for cameras moved along its rows.

    Args:
        depth_m: (H, W) planar metres, 0 = nothing there.
        rgb: (H, W, 3) in [0, 1].
        profile: the camera that took it.
        T_world_cam: its pose.
    """
    inverse = 1.0 / np.where(depth_m > 0, depth_m, NOTHING_M).astype(np.float32)
    normal_w = (_normals(inverse, profile) @ T_world_cam[:3, :3].T).astype(np.float32)

    def render(camera: Camera) -> Buffers:
        offset_m = float((camera.T_world_cam[:3, 3] - T_world_cam[:3, 3]) @ T_world_cam[:3, 0])
        columns = np.arange(inverse.shape[1], dtype=np.float32)
        place = columns + camera.cx_px - profile.cx_px - profile.fx_px * offset_m * inverse
        seen, source = _warped(place, inverse, camera.width_px)
        rows = np.arange(camera.height_px) + round(profile.cy_px - camera.cy_px)
        rows = np.clip(rows, 0, len(inverse) - 1)
        seen, source = seen[rows], source[rows]
        at = rows[:, None], source
        depth = np.where(seen > 1.01 / NOTHING_M, 1.0 / seen, 0).astype(np.float32)
        ids = np.where(depth > 0, 0, -1).astype(np.int32)
        return Buffers(depth, rgb[at].astype(np.float32), ids, normal_w[at])

    return render


def _normals(inverse: np.ndarray, profile: CameraProfile) -> np.ndarray:
    """(H, W, 3) unit normals towards the camera: inverse depth is affine in the picture of a plane."""
    height, width = inverse.shape
    u = (np.arange(width) + 0.5 - profile.cx_px)[None, :]
    v = (np.arange(height) + 0.5 - profile.cy_px)[:, None]
    w_u, w_v = _slope(inverse, 1), _slope(inverse, 0)
    normal = -np.stack([profile.fx_px * w_u, profile.fy_px * w_v, inverse - w_u * u - w_v * v], axis=-1)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _slope(values: np.ndarray, axis: int) -> np.ndarray:
    """The smaller one of the two one-sided differences, so that edges do not bend the surface."""
    step = np.diff(values, axis=axis)
    first, last = np.take(step, [0], axis), np.take(step, [-1], axis)
    before, after = (np.concatenate(p, axis) for p in ((first, step), (step, last)))
    return np.where(np.abs(before) < np.abs(after), before, after)


def _warped(place: np.ndarray, inverse: np.ndarray, width_px: int) -> tuple[np.ndarray, np.ndarray]:
    """(H, W') inverse depth and source column of what is nearest at every column of the moved picture."""
    height = len(inverse)
    near = np.zeros((height, width_px), np.float32)
    source = np.full((height, width_px), -1)
    drawn = list(_points(place, inverse))
    row, column, value, origin = (np.concatenate([p[i] for p in drawn]) for i in range(4))
    inside = (column >= 0) & (column < width_px)
    order = np.argsort(value[inside], kind="stable")  # of several points at one pixel, the nearest is last
    row, column, value, origin = (a[inside][order] for a in (row, column, value, origin))
    near[row, column], source[row, column] = value, origin
    return _filled(near, source)


def _points(place: np.ndarray, inverse: np.ndarray) -> Iterator[tuple[np.ndarray, ...]]:
    """(row, column, inverse depth, source column) of the whole columns between neighbours of one surface."""
    grid = np.indices(place.shape)
    rows, columns = grid[0], grid[1]
    a, b = inverse[:, :-1], inverse[:, 1:]
    joined = np.maximum(a, b) < SAME_SURFACE * np.minimum(a, b)
    left, right = place[:, :-1], place[:, 1:]
    for k in range(MOST_STRETCH_PX):
        at = np.ceil(left) + k
        on = joined & (at <= right)
        t = (at - left) / np.maximum(right - left, 1e-6)
        origin = columns[:, :-1] + (t > 0.5)
        yield rows[:, :-1][on], at[on].astype(int), (a + t * (b - a))[on], origin[on]
    # A pixel at its surface's end covers half a pixel more.
    end = np.ones(place.shape, bool)
    end[:, 1:-1] = ~(joined[:, :-1] & joined[:, 1:])
    yield rows[end], np.rint(place[end]).astype(int), inverse[end], columns[end]


def _filled(near: np.ndarray, source: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns that nothing reached take the farther of the row's nearest reached ones."""
    reached = source >= 0
    width = near.shape[1]
    columns = np.arange(width)
    before = np.maximum.accumulate(np.where(reached, columns, -1), axis=1)
    after = np.minimum.accumulate(np.where(reached, columns, width)[:, ::-1], axis=1)[:, ::-1]
    left = np.where(before >= 0, np.take_along_axis(near, np.maximum(before, 0), 1), np.inf)
    right = np.where(after < width, np.take_along_axis(near, np.minimum(after, width - 1), 1), np.inf)
    chosen = np.clip(np.where(left <= right, before, after), 0, width - 1)
    return np.take_along_axis(near, chosen, 1), np.maximum(np.take_along_axis(source, chosen, 1), 0)
