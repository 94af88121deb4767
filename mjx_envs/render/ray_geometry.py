"""Where a ray enters a primitive, and the surface's normal there.

Written once for an array namespace `xp` (numpy or jax.numpy); this module imports neither.
Everything is in the geom's local frame, sizes follow MuJoCo's conventions. A vector is a tuple of
three arrays, so that a loop over geoms fuses into one pass over pixels. A ray is
`origin + t * direction`; with `direction` of unit camera z, t is planar depth.

Solids are seen from outside only: a ray that starts inside one passes through it, as OpenGL's
back-face culling has it, so a camera inside a geom is not blinded. Shapes without volume are
never hit, apart from planes, which are seen from above (+z).
"""

from collections.abc import Callable, Iterable
from types import ModuleType
from typing import Any

Array = Any
Vector = tuple[Array, Array, Array]

MISS = float("inf")
_TINY = 1e-12


def vector(components: Iterable[Array]) -> Vector:
    """The three components as a tuple; ValueError if there are not three."""
    x, y, z = components
    return x, y, z


def _dot(a: Vector, b: Vector) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _nonzero(xp: ModuleType, a: Array) -> Array:
    return xp.where(abs(a) < _TINY, _TINY, a)


def hit_plane(xp: ModuleType, origin: Vector, direction: Vector, size: Array) -> Array:
    """t of the plane z = 0 seen from above; size (x half, y half, -), 0 = infinite."""
    t = origin[2] / xp.maximum(-direction[2], _TINY)
    hit = (direction[2] < 0) & (t > 0)
    for axis in (0, 1):
        half = xp.where(size[axis] > 0, size[axis], MISS)
        hit &= abs(origin[axis] + t * direction[axis]) <= half
    return xp.where(hit, t, MISS)


def _sphere_entry(xp: ModuleType, origin: Vector, direction: Vector, radius: Array) -> tuple[Array, Array]:
    """(t of entry, whether the line meets the sphere).

    The discriminant is taken from the line's point closest to the centre: the textbook's
    b^2 - 4ac loses half the digits of a float32.
    """
    inverse = 1 / _dot(direction, direction)
    t_closest = -_dot(origin, direction) * inverse
    closest = vector(o + t_closest * d for o, d in zip(origin, direction, strict=True))
    chord = radius * radius - _dot(closest, closest)
    return t_closest - xp.sqrt(xp.maximum(chord, 0) * inverse), chord > 0


def _tube_span(
    xp: ModuleType, origin: Vector, direction: Vector, radius: Array
) -> tuple[Array, Array, Array]:
    """(t of middle, half length in t, whether it is met) inside the infinite cylinder about z."""
    inverse = 1 / xp.maximum(direction[0] * direction[0] + direction[1] * direction[1], _TINY)
    t_closest = -(origin[0] * direction[0] + origin[1] * direction[1]) * inverse
    x, y = origin[0] + t_closest * direction[0], origin[1] + t_closest * direction[1]
    chord = radius * radius - x * x - y * y
    return t_closest, xp.sqrt(xp.maximum(chord, 0) * inverse), chord > 0


def _slab_span(xp: ModuleType, origin: Array, direction: Array, half: Array) -> tuple[Array, Array]:
    """t of entry into and of exit from the slab |coordinate| <= half."""
    inverse = 1 / _nonzero(xp, direction)
    middle, reach = -origin * inverse, half * abs(inverse)
    return middle - reach, middle + reach


def hit_sphere(xp: ModuleType, origin: Vector, direction: Vector, size: Array) -> Array:
    """t of entry; size (radius, -, -)."""
    t, hit = _sphere_entry(xp, origin, direction, size[0])
    return xp.where(hit & (t > 0), t, MISS)


def hit_capsule(xp: ModuleType, origin: Vector, direction: Vector, size: Array) -> Array:
    """t of entry; size (radius, half length of the cylindrical part, -), axis z.

    A ray that enters the infinite cylinder above (below) the cylindrical part can enter the
    capsule only through the upper (lower) sphere, so one sphere is enough.
    """
    radius, half = size[0], size[1]
    t_middle, t_half, hit = _tube_span(xp, origin, direction, radius)
    t_tube = t_middle - t_half
    z = origin[2] + t_tube * direction[2]
    on_tube = abs(z) <= half
    cap = (origin[0], origin[1], origin[2] - xp.where(z > 0, half, -half))
    t_cap, hit_cap = _sphere_entry(xp, cap, direction, radius)
    t = xp.where(on_tube, t_tube, t_cap)
    return xp.where(hit & (on_tube | hit_cap) & (t > 0), t, MISS)


def hit_box(xp: ModuleType, origin: Vector, direction: Vector, size: Array) -> Array:
    """t of entry; size (x, y, z half)."""
    t_in, t_out = _slab_span(xp, origin[0], direction[0], size[0])
    for axis in (1, 2):
        entry, leave = _slab_span(xp, origin[axis], direction[axis], size[axis])
        t_in, t_out = xp.maximum(t_in, entry), xp.minimum(t_out, leave)
    return xp.where((t_in < t_out) & (t_in > 0), t_in, MISS)


def hit_cylinder(xp: ModuleType, origin: Vector, direction: Vector, size: Array) -> Array:
    """t of entry; size (radius, half height, -), axis z."""
    t_middle, t_half, hit = _tube_span(xp, origin, direction, size[0])
    entry, leave = _slab_span(xp, origin[2], direction[2], size[1])
    t_in, t_out = xp.maximum(t_middle - t_half, entry), xp.minimum(t_middle + t_half, leave)
    return xp.where(hit & (t_in < t_out) & (t_in > 0), t_in, MISS)


def _unit(xp: ModuleType, v: Vector) -> Vector:
    scale = 1 / xp.sqrt(xp.maximum(_dot(v, v), _TINY * _TINY))
    return (v[0] * scale, v[1] * scale, v[2] * scale)


def normal_plane(xp: ModuleType, point: Vector, size: Array) -> Vector:
    """Outward unit normal: +z everywhere."""
    zero = xp.zeros_like(point[0])
    return (zero, zero, zero + 1)


def normal_sphere(xp: ModuleType, point: Vector, size: Array) -> Vector:
    """Outward unit normal at `point` on the surface."""
    return _unit(xp, point)


def normal_capsule(xp: ModuleType, point: Vector, size: Array) -> Vector:
    """Outward unit normal at `point` on the surface: away from the axis segment."""
    return _unit(xp, (point[0], point[1], point[2] - xp.clip(point[2], -size[1], size[1])))


def normal_box(xp: ModuleType, point: Vector, size: Array) -> Vector:
    """Outward unit normal at `point` on the surface: the face that it is nearest to."""
    x, y, z = (abs(point[axis]) - size[axis] for axis in range(3))
    on_x = (x >= y) & (x >= z)
    on_y = ~on_x & (y >= z)
    zero = xp.zeros_like(point[0])
    return (
        xp.where(on_x, xp.sign(point[0]), zero),
        xp.where(on_y, xp.sign(point[1]), zero),
        xp.where(on_x | on_y, zero, xp.sign(point[2])),
    )


def normal_cylinder(xp: ModuleType, point: Vector, size: Array) -> Vector:
    """Outward unit normal at `point` on the surface: an end's, or away from the axis."""
    radial = xp.sqrt(point[0] * point[0] + point[1] * point[1])
    on_end = abs(point[2]) - size[1] >= radial - size[0]
    scale = xp.where(on_end, 0, 1 / xp.maximum(radial, _TINY))
    return (point[0] * scale, point[1] * scale, xp.where(on_end, xp.sign(point[2]), 0))


Hit = Callable[[ModuleType, Vector, Vector, Array], Array]
Normal = Callable[[ModuleType, Vector, Array], Vector]

HIT: dict[str, Hit] = {
    "plane": hit_plane,
    "sphere": hit_sphere,
    "capsule": hit_capsule,
    "box": hit_box,
    "cylinder": hit_cylinder,
}
"""`t = HIT[type](xp, origin, direction, size)`, inf for a miss."""

NORMAL: dict[str, Normal] = {
    "plane": normal_plane,
    "sphere": normal_sphere,
    "capsule": normal_capsule,
    "box": normal_box,
    "cylinder": normal_cylinder,
}
"""Unit normal: `NORMAL[type](xp, point on the surface, size)`."""
