"""What depthfeat is trained on: a random room's depth after one of eight treatments, and what is asked of it.

The treatments are families of sensors and of the mistakes that imitations of sensors make: holes in the wrong
places, holes without noise, noise without holes, pictures too smooth. Which it was, and numbers measured on
geometry and on the result, are the targets. NumPy and OpenCV alone.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt16

from ddgrasp.contract import D455
from ddgrasp.depth import inverse_depth, to_metres
from foundation.depth_feature_noise import ProceduralConfig, corrupt
from sensors.statistics import stats

GRID = (2, 3)
"""Rows and columns of the coarse layout that is asked for."""
EDGE_STEP = 0.06
"""Relative difference of inverse depth between neighbours that counts as a depth edge."""
EDGE_NEAR_PX = 4
"""A hole this close to an edge counts as at it."""


@dataclass(frozen=True)
class Pool:
    """Pictures of many devices, device after device."""

    clean_mm: UInt16[np.ndarray, "N H W"]
    stereo_mm: UInt16[np.ndarray, "N H W"]
    objects: Int[np.ndarray, " N"]
    camera_height_m: Float[np.ndarray, " N"]
    camera_pitch_rad: Float[np.ndarray, " N"]

    def __len__(self) -> int:
        return len(self.clean_mm)


Treatment = Callable[[Pool, int, np.random.Generator], Float[np.ndarray, "H W"]]
"""Picture number -> metres, 0 = invalid."""


def _clean(pool: Pool, at: int, rng: np.random.Generator) -> np.ndarray:
    del rng
    return to_metres(pool.clean_mm[at])


def _stereo(pool: Pool, at: int, rng: np.random.Generator) -> np.ndarray:
    del rng
    return to_metres(pool.stereo_mm[at])


def _procedural(pool: Pool, at: int, rng: np.random.Generator) -> np.ndarray:
    """foundation/depth_feature_noise.py at random strengths."""
    strength = np.exp(rng.normal(0, 0.7, 4))
    config = ProceduralConfig(
        shift_px=0.5 * strength[0],
        shift_scale_px=int(rng.integers(2, 9)),
        disparity_px=0.06 * strength[1],
        disparity_scale_px=int(rng.integers(1, 6)),
        dropout=min(0.3, 0.006 * strength[2] ** 2),
        random_value=min(0.3, 0.003 * strength[3] ** 2),
        sticks=int(rng.integers(0, 9)),
    )
    profile = D455.scaled(pool.clean_mm.shape[2] / D455.width_px)
    return corrupt(to_metres(pool.clean_mm[at]), rng, profile, config)


def _independent(pool: Pool, at: int, rng: np.random.Generator) -> np.ndarray:
    """Every pixel by itself: deviation that grows with the square of depth, and dropout."""
    depth_m = to_metres(pool.clean_mm[at])
    noise = 10 ** rng.uniform(-3.5, -2) * rng.standard_normal(depth_m.shape)
    keep = rng.random(depth_m.shape) >= 10 ** rng.uniform(-2.5, -0.5)
    return np.where(keep & (depth_m > 0), np.maximum(depth_m + noise * depth_m**2, 0.05), 0)


def _foreign_holes(pool: Pool, at: int, rng: np.random.Generator) -> np.ndarray:
    """Clean depth under the holes of another picture: right kind, wrong places."""
    other = int(rng.integers(len(pool)))
    return np.where(pool.stereo_mm[other] > 0, to_metres(pool.clean_mm[at]), 0)


def _holes_alone(pool: Pool, at: int, rng: np.random.Generator) -> np.ndarray:
    """Clean depth under its own holes: no noise on surfaces."""
    del rng
    return np.where(pool.stereo_mm[at] > 0, to_metres(pool.clean_mm[at]), 0)


def _filled(pool: Pool, at: int, rng: np.random.Generator) -> np.ndarray:
    """Holes replaced by what lies there: noise without holes."""
    del rng
    return to_metres(np.where(pool.stereo_mm[at] > 0, pool.stereo_mm[at], pool.clean_mm[at]))


def _smoothed(pool: Pool, at: int, rng: np.random.Generator) -> np.ndarray:
    """A sensor's picture as a blurry network would draw it: surfaces and hole outlines softened."""
    valid = (pool.stereo_mm[at] > 0).astype(np.float32)
    sigma = float(rng.uniform(0.7, 3.0))
    total = cv2.GaussianBlur(to_metres(pool.stereo_mm[at]), (0, 0), sigma)
    weight = cv2.GaussianBlur(valid, (0, 0), sigma)
    return np.where(weight > 0.5, total / np.maximum(weight, 1e-3), 0)


TREATMENTS: dict[str, Treatment] = {
    "clean": _clean,
    "stereo": _stereo,
    "procedural": _procedural,
    "independent": _independent,
    "foreign_holes": _foreign_holes,
    "holes_alone": _holes_alone,
    "filled": _filled,
    "smoothed": _smoothed,
}
MEASURED = (
    "objects", "camera_height_m", "camera_pitch_rad", "edges",
    *(f"layout_{row}{column}" for row in range(GRID[0]) for column in range(GRID[1])),
    "invalid", "components", "noise", "at_edges",
)  # fmt: skip
"""Names of the regression targets, geometry first."""


@dataclass(frozen=True)
class Batch:
    """Depth after treatments, and what is asked of it."""

    depth_m: Float32[np.ndarray, "B H W"]
    family: Int[np.ndarray, " B"]
    """Number of the treatment."""
    measured: Float32[np.ndarray, f"B {len(MEASURED)}"]
    """Not standardised."""


def make_batch(pool: Pool, rows: Int[np.ndarray, " B"], rng: np.random.Generator) -> Batch:
    """Pictures `rows` of the pool, each under a random treatment."""
    family = rng.integers(len(TREATMENTS), size=len(rows))
    treatments = list(TREATMENTS.values())
    depth_m = np.stack(
        [treatments[f](pool, int(at), rng) for f, at in zip(family, rows, strict=True)]
    ).astype(np.float32)
    measured = np.stack([measure(pool, int(at), d) for at, d in zip(rows, depth_m, strict=True)])
    return Batch(depth_m, family, measured.astype(np.float32))


def measure(pool: Pool, at: int, depth_m: Float[np.ndarray, "H W"]) -> Float[np.ndarray, f" {len(MEASURED)}"]:
    """The regression targets of picture `at` after a treatment, in the order of MEASURED."""
    clean_m = to_metres(pool.clean_mm[at])
    inverse = inverse_depth(clean_m)
    edges = depth_edges(clean_m)
    layout = cv2.resize(inverse, GRID[::-1], interpolation=cv2.INTER_AREA)
    holes = depth_m <= 0
    sizes = stats.hole_sizes_px(depth_m)
    both = ~holes & (clean_m > 0)
    noise = np.median(np.abs(inverse_depth(depth_m)[both] - inverse[both])) if both.any() else 0.0
    near = cv2.dilate(edges.astype(np.uint8), np.ones((2 * EDGE_NEAR_PX + 1,) * 2, np.uint8)) > 0
    at_edges = np.mean(near[holes]) if holes.any() else 0.0
    return np.array([
        pool.objects[at], pool.camera_height_m[at], pool.camera_pitch_rad[at], np.sqrt(edges.mean()),
        *layout.ravel(), np.sqrt(holes.mean()), np.log1p(len(sizes)), np.log10(noise + 1e-4), at_edges,
    ])  # fmt: skip


def depth_edges(depth_m: Float[np.ndarray, "H W"]) -> Bool[np.ndarray, "H W"]:
    """(H, W) bool: pixels whose 3 x 3 neighbourhood spans more than EDGE_STEP of their inverse depth.

    depth_m: clean, 0 = nothing in range, which counts as infinitely far.
    """
    inverse = inverse_depth(depth_m)
    span = cv2.morphologyEx(inverse, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    return span > EDGE_STEP * np.maximum(cv2.dilate(inverse, np.ones((3, 3), np.uint8)), 1e-6)
