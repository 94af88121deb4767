"""Shapes of what is not fruit, millimetres, z up as each rests or close to it. JAX-free.

Outlines are drawn by hand after things as they are sold, those of training's twelve to the sizes of
`mjx_envs/objects.py`.
"""

import numpy as np
import trimesh

from rig.meshes.solids import (
    SIDES,
    Part,
    around,
    lathe,
    loft,
    rounded_box,
    spline,
    sweep,
    tube,
    turn,
    turned,
    union,
    without,
)  # fmt: skip

_STEEL = (0.72, 0.73, 0.75)


def cube() -> tuple[Part, ...]:
    """A wooden toy cube: rounded edges, a round hollow in the middle of each face."""
    block = rounded_box((50, 50, 50), 3.0)
    hollow = trimesh.creation.icosphere(subdivisions=3, radius=30)
    axes = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
    hollows = [hollow.copy().apply_translation(53 * np.array(axis)) for axis in axes]
    return (Part("wood", without(block, hollows), (0.85, 0.65, 0.35)),)


def block() -> tuple[Part, ...]:
    """A foam brick with soft edges."""
    return (Part("foam", rounded_box((75, 50, 50), 6.0), (0.70, 0.30, 0.22)),)


def can() -> tuple[Part, ...]:
    """A soup tin: a beaded rim at both ends, lids set back, a tab to pull."""
    r, half = 33.0, 50.5
    lower = [(0, -half + 3), (29, -half + 3), (30, -half), (r, -half), (r, -half + 3), (31.8, -half + 4.5)]
    profile = [*lower, *((x, -z) for x, z in reversed(lower))]
    tab = rounded_box((22, 13, 1.6), 0.7).apply_transform(turn((0, 1, 0), 3, at=(12, 0, half - 1.9)))
    label = trimesh.creation.cylinder(radius=32.2, height=84, sections=SIDES)
    return (
        Part("tin", lathe(profile), _STEEL), Part("label", label, (0.75, 0.10, 0.12)),
        Part("tab", tab, _STEEL),
    )  # fmt: skip


def wheel() -> tuple[Part, ...]:
    """A tyre with lugs on a rim of five spokes, with a hub and an axle's hole; lying on its side."""
    angle = around(SIDES * 2)
    outline = spline([(21.5, -11), (25, -13.3), (29, -12), (31, -7), (31.4, 0)], 12)
    half = np.concatenate([outline, outline[-2::-1] * [1, -1]])
    lug = np.where(np.sin(16 * angle) > 0, 0.55, -0.55)
    rings = []
    for r, z in [*half, *[(21.5, z) for z in np.linspace(8, -8, 4)]]:
        radii = r + lug * np.clip((r - 28.5) / 2, 0, 1)
        rings.append(np.column_stack([radii * np.cos(angle), radii * np.sin(angle), np.full_like(angle, z)]))
    tyre = _ring_surface(np.stack(rings))
    rim = lathe([(19, -10.5), (22, -10.5), (22, 10.5), (19, 10.5), (18, 3), (18, -3), (19, -10.5)])
    spokes = [
        trimesh.creation.box((16, 5, 8)).apply_transform(turn((0, 0, 1), 72 * i)).apply_translation(
            (11.5 * np.cos(np.radians(72 * i)), 11.5 * np.sin(np.radians(72 * i)), 0)
        )
        for i in range(5)
    ]  # fmt: skip
    hub = lathe([(2.5, -12), (6, -12), (6, 12), (2.5, 12), (2.5, -12)])
    hub_and_rim = union([rim, hub, *spokes])
    bore = trimesh.creation.cylinder(radius=2.5, height=40, sections=SIDES)
    return (
        Part("tyre", tyre, (0.13, 0.13, 0.14), concave=True),
        Part("rim", without(hub_and_rim, [bore]), (0.90, 0.75, 0.10), concave=True),
    )  # fmt: skip


def bread() -> tuple[Part, ...]:
    """A hot-dog roll: flat below, domed above, split along the top."""
    rings = []
    angle = around(120)
    for x in np.linspace(-69, 69, 41):
        size = max(0.02, 1 - (abs(x) / 69.3) ** 3.2) ** 0.5
        y = 27 * size * np.sign(np.cos(angle)) * np.abs(np.cos(angle)) ** 0.85
        z = np.where(np.sin(angle) > 0, 28.5, 17.0) * size**0.8 * np.sin(angle)
        z = np.sign(z) * np.abs(z) ** np.where(z < 0, 0.8, 1.0) * np.where(z < 0, 17.0**0.2, 1.0)
        z = np.maximum(z - 7.0 * size * np.exp(-((y / 3.5) ** 2)) * (z > 0), -14.0)
        rings.append(np.column_stack([np.full_like(angle, x), y, z]))
    return (Part("crust", loft(np.stack(rings)), (0.72, 0.48, 0.22)),)


def mug() -> tuple[Part, ...]:
    """An espresso mug, hollow, its handle along x."""
    outer = [(0, 0), (24, 0), (27, 3), (30, 12), (32, 40), (32.5, 66)]
    inner = [(31.5, 67), (29.5, 66), (28.8, 40), (26.5, 12), (23, 6), (0, 5)]
    handle = sweep(
        [(30, 0, 52), (44, 0, 54), (50, 0, 38), (44, 0, 20), (29, 0, 15)], [1.0] * 5,
        np.stack([3.2 * np.cos(around(16)), 5.0 * np.sin(around(16))], axis=1),
    )  # fmt: skip
    cup = lathe([*outer, *inner])
    room = lathe([(0, 4.9), *((r + 0.05, z) for r, z in reversed(inner[1:-1])), (29.5, 80), (0, 80)])
    blue = (0.25, 0.45, 0.62)
    return (
        Part("cup", cup, blue, concave=True),
        Part("handle", without(handle, [room]), blue, concave=True),
    )  # fmt: skip


def bottle() -> tuple[Part, ...]:
    """A small juice bottle with a waist, a neck and a screw cap; standing."""
    glass = spline(
        [(27, 3), (28.5, 12), (28, 40), (25.5, 58), (28, 76), (27, 92), (19, 108), (13.5, 118)], 36
    )
    body = lathe([(0, 0), (24, 0), *glass.tolist(), (13.5, 128), (0, 128)])
    ridges = 1 + 0.03 * np.sign(np.sin(24 * around()))
    cap = turned(
        np.array([(0, 121), (15.2, 121), (15.2, 138), (14, 139.5), (0, 139.5)]), lambda angle, _: ridges
    )
    return Part("glass", body, (0.85, 0.48, 0.12), concave=True), Part("cap", cap, (0.92, 0.92, 0.90))


def screwdriver() -> tuple[Part, ...]:
    """A fluted handle with a collar, a round shaft, a flat blade; along x."""
    profile = spline([(0, -50), (9, -49), (13, -43), (14.5, -25), (13, 0), (13.5, 22), (11, 40), (8, 46)], 32)

    def flutes(angle: np.ndarray, share: float) -> np.ndarray:
        return 1 - 0.13 * np.sin(np.pi * share) * np.clip(np.cos(6 * angle), 0, 1)

    handle = turned(np.concatenate([profile, [(0, 46)]]), flutes)
    shaft = tube([(0, 0, 44), (0, 0, 122)], [3.0, 3.0])
    blade = _tapered((6.0, 5.6), (7.4, 1.0), 120, 134)
    lying = turn((0, 1, 0), 90)
    return (
        Part("handle", handle, (0.80, 0.22, 0.10)).moved(lying),
        Part("shaft", union([shaft, blade]), _STEEL).moved(lying),
    )


def milk() -> tuple[Part, ...]:
    """A gable-top carton with a screw cap on the roof's slope; standing, the ridge along y."""
    walls = [(x, y, z) for x in (-28.0, 28.0) for y in (-28.0, 28.0) for z in (0.0, 78.0)]
    roof = [(x, y, 99.0) for x in (-1.5, 1.5) for y in (-28.0, 28.0)]
    carton = trimesh.convex.convex_hull(np.array(walls + roof))
    ridge = trimesh.creation.box((3, 56, 14)).apply_translation((0, 0, 105))
    cap = trimesh.creation.cylinder(radius=9, height=9, sections=SIDES)
    cap.apply_transform(turn((0, 1, 0), 51.6, at=(17.3, 0, 91.5)))
    white = (0.93, 0.94, 0.95)
    return (
        Part("carton", carton, white), Part("ridge", ridge, white), Part("cap", cap, (0.15, 0.35, 0.75))
    )  # fmt: skip


def hammer() -> tuple[Part, ...]:
    """A small joiner's hammer: a steel head along y with a face and a wedge, a wooden handle along x."""
    section = np.stack([10.5 * np.cos(around(32)), 7.0 * np.sin(around(32))], axis=1)
    handle = sweep([(-160, 0, 0), (-100, 0, 0), (-35, 0, 0), (12, 0, 0)], [1.15, 1.2, 0.85, 0.8], section)
    cheek = rounded_box((20, 26, 18), 2.0)
    face = lathe([(0, 10), (7.5, 10), (7.5, 26), (9.5, 30), (9.5, 40), (8.5, 41), (0, 41)])
    face.apply_transform(turn((1, 0, 0), -90))
    wedge = _tapered((18, 16), (18, 2.0), 10, 44).apply_transform(turn((1, 0, 0), 90))
    steel = (0.35, 0.36, 0.38)
    return (
        Part("cheek", cheek, steel), Part("face", face, steel), Part("wedge", wedge, steel),
        Part("handle", handle, (0.78, 0.58, 0.34)),
    )  # fmt: skip


def bulb() -> tuple[Part, ...]:
    """A light bulb: frosted glass, a threaded cap, a contact; lying, its axis along x."""
    glass = spline([(0, 62), (12, 60), (24, 51), (30, 36), (28, 20), (20, 4), (14.5, -10), (13, -18)], 32)
    thread = [(13 + 0.9 * np.cos(np.pi * i), -18 - 1.7 * i) for i in range(13)]
    cap = [(0, -46), (4.5, -46), (5, -43), (11, -40), *reversed(thread), (13.5, -16), (0, -16)]
    lying = turn((0, 1, 0), 90)
    return (
        Part("glass", lathe([(0, -18), *reversed(glass.tolist())]), (0.95, 0.94, 0.88)).moved(lying),
        Part("cap", lathe(cap), _STEEL).moved(lying),
    )


def _tapered(near: tuple[float, float], far: tuple[float, float], z0: float, z1: float) -> trimesh.Trimesh:
    """The hull of a rectangle `near` (x, y) at height `z0` and a rectangle `far` at `z1`."""
    ends = ((near, z0), (far, z1))
    corners = [(x * w / 2, y * d / 2, z) for (w, d), z in ends for x in (-1, 1) for y in (-1, 1)]
    return trimesh.convex.convex_hull(np.array(corners))


def _ring_surface(rings: np.ndarray) -> trimesh.Trimesh:
    """The closed surface through rings (K, N, 3) whose last one joins the first: a torus."""
    count, sides, _ = rings.shape
    grid = np.arange(count * sides).reshape(count, sides)
    a, b = grid.ravel(), np.roll(grid, -1, axis=1).ravel()
    c, d = np.roll(grid, -1, axis=0).ravel(), np.roll(grid, (-1, -1), axis=(0, 1)).ravel()
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    mesh = trimesh.Trimesh(rings.reshape(-1, 3), faces, process=True)
    mesh.fix_normals()
    return mesh
