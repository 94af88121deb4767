"""Shapes of the fruit, millimetres, z up as each lies or close to it. JAX-free.

Outlines are drawn by hand after the fruit, to the sizes of `mjx_envs/objects.py`; none is a primitive.
"""

import numpy as np
from jaxtyping import Float64

from rig.meshes.solids import Angles, Part, around, loft, spline, sweep, tube, turn, turned

_BROWN, _GREEN = (0.33, 0.24, 0.14), (0.27, 0.45, 0.16)
_STAR_POINTS = 60
_BANANA_BEND_MM = 118
"""Radius of a banana's axis."""


def apple() -> tuple[Part, ...]:
    """A dimple with a stem above, a shallower one with five bumps around it below."""
    profile = spline([
        (0, -25), (5, -26), (11, -29), (19, -27), (28, -15), (32, 1), (30, 15), (23, 25), (14, 28), (6, 24.5),
        (0, 19),
    ])  # fmt: skip

    def lobes(angle: Angles, share: float) -> Angles:
        return 1 + 0.05 * max(0.0, 0.55 - share) * np.cos(5 * angle)

    stem = tube([(0, 0, 17), (0.5, 0, 25), (3, 0, 36)], [1.2, 1.3, 2.0])
    return Part("skin", turned(profile, lobes), (0.75, 0.12, 0.10)), Part("stem", stem, _BROWN)


def pear() -> tuple[Part, ...]:
    """A round bottom, a waist, a narrow neck and a bent stem; lying, the stem along x."""
    profile = spline([
        (0, -32), (6, -33.5), (16, -31), (27, -21), (33, -4), (30.5, 14), (23.5, 29), (18.5, 41), (16, 52),
        (12, 60), (6, 63.5), (0, 62),
    ])  # fmt: skip
    stem = tube([(0, 0, 60), (1, 0, 68), (4, 0, 77)], [1.4, 1.4, 2.2])
    lying = turn((0, 1, 0), 90)
    parts = Part("skin", turned(profile), (0.66, 0.72, 0.22)), Part("stem", stem, _BROWN)
    return tuple(part.moved(lying) for part in parts)


def peach() -> tuple[Part, ...]:
    """A cleft down one side, a dimple above, a point below."""
    profile = spline([
        (0, -29.5), (3, -28.5), (12, -26), (24, -16), (30, -1), (27.5, 15), (19, 26), (9, 29.5), (3, 28),
        (0, 24),
    ])  # fmt: skip

    def cleft(angle: Angles, share: float) -> Angles:
        depth = 0.09 * np.sin(np.pi * min(1.0, 1.15 * share))
        return 1 - depth * np.exp(-((_wrapped(angle) / 0.16) ** 2))

    return (Part("skin", turned(profile, cleft), (0.92, 0.58, 0.28)),)


def persimmon() -> tuple[Part, ...]:
    """Flat and almost square from above, with a calyx of four leaves."""
    profile = spline([
        (0, -25), (10, -25.8), (22, -21), (30, -9), (31.6, 3), (28.5, 15), (20, 23), (10, 24.5), (0, 21.5),
    ])  # fmt: skip

    def square(angle: Angles, share: float) -> Angles:
        return 1 + 0.035 * np.sin(np.pi * share) * np.cos(4 * angle)

    leaf = sweep(
        [(2, 0, 23.4), (8, 0, 25), (14, 0, 25.2), (19, 0, 25.6)], [4, 7.5, 6.5, 0.6],
        np.stack([0.15 * np.cos(around(12)), np.sin(around(12))], axis=1),
    )  # fmt: skip
    leaves = [Part(f"leaf{i}", leaf, _GREEN).moved(turn((0, 0, 1), 90 * i + 45)) for i in range(4)]
    stalk = tube([(0, 0, 20), (0, 0, 29)], [4.0, 2.6])
    skin = Part("skin", turned(profile, square), (0.90, 0.42, 0.08))
    return skin, *leaves, Part("stalk", stalk, _BROWN)


def starfruit() -> tuple[Part, ...]:
    """A five-pointed star carried along x, smaller towards both ends, resting on two of its ribs."""
    rings = []
    for x in np.linspace(-46, 46, 33):
        size = max(0.06, 1 - (abs(x) / 46.5) ** 3.5) ** 0.6
        rings.append(np.column_stack([np.full(_STAR_POINTS, x), size * _star()]))
    return (Part("skin", loft(np.stack(rings)), (0.82, 0.80, 0.20), concave=True),)


def lemon() -> tuple[Part, ...]:
    """An ellipsoid with a nipple at one end and a knob at the other; along x."""
    profile = spline([
        (0, -37), (4, -36.5), (8, -33.5), (17, -26), (24.5, -13), (27, 0), (25, 12), (18, 24), (9.5, 31),
        (6, 34.5), (4, 38), (0, 39),
    ])  # fmt: skip
    return (Part("skin", turned(profile), (0.95, 0.85, 0.20)).moved(turn((0, 1, 0), 90)),)


def banana() -> tuple[Part, ...]:
    """Bent, with five sides, thinner towards the tip, with a stalk."""
    bend = np.linspace(-0.69, 0.69, 9)
    path = [(_BANANA_BEND_MM * np.sin(a), -_BANANA_BEND_MM * np.cos(a), 0.0) for a in bend]
    section = 1 + 0.06 * np.cos(5 * around(40))
    section = section[:, None] * np.stack([np.cos(around(40)), np.sin(around(40))], axis=1)
    flesh = sweep(path, [7.0, 13.5, 16.5, 17.4, 17.5, 17.2, 16.0, 12.5, 5.5], section)
    tip = sweep([path[0], _beyond(bend[0], -6)], [6.2, 4.0], section)
    stalk = sweep([path[-1], _beyond(bend[-1], 7), _beyond(bend[-1], 17)], [5.4, 4.6, 5.2], section)
    return (
        Part("skin", flesh, (0.90, 0.80, 0.15), concave=True), Part("tip", tip, _BROWN),
        Part("stalk", stalk, (0.62, 0.60, 0.18)),
    )  # fmt: skip


def _star() -> Float64[np.ndarray, "n 2"]:
    """(60, 2) cross-section of a starfruit: five ribs with rounded edges, one of them straight up."""
    angle = around(_STAR_POINTS)
    near = np.abs(_wrapped(5 * (angle - np.pi / 2))) / np.pi  # 0 on a rib, 1 in a valley
    radius = 12 + 14.7 * (1 - near) ** 1.6
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def _beyond(angle: float, distance: float) -> tuple[float, float, float]:
    """A point `distance` past the banana's end at `angle`, straight on."""
    sin, cos = np.sin(angle), np.cos(angle)
    return _BANANA_BEND_MM * sin + distance * cos, -_BANANA_BEND_MM * cos + distance * sin, 0.0


def _wrapped(angle: Angles) -> Angles:
    """The same angles in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
