"""Feature extractors of scores by name: depth maps in metres to vectors. What each is, foundation/ says."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from ddgrasp.config import SCORE_FEATURES
from ddgrasp.depth import inverse_depth
from ddgrasp.errors import unknown_name

NEAR_M, FAR_M = 0.25, 10.0
"""Depths drawn white and black for networks that look at pictures; holes are black, too, so that such
networks cannot tell a hole from what is 9.3 m away or more."""


@dataclass(frozen=True)
class FeatureExtractor:
    """A named function of maps (N, H, W) metres, 0 = invalid, to (N, d) float32."""

    name: str
    source: Any
    """Which weights: goes into reports."""
    function: Callable[[Float[np.ndarray, "N H W"]], Float32[np.ndarray, "N d"]]

    def __call__(self, depth_m: Float[np.ndarray, "N H W"]) -> Float32[np.ndarray, "N d"]:
        """(N, H, W) metres, 0 = invalid -> (N, d)."""
        return self.function(depth_m)


def load(name: str, weights_dir: Path | None = None) -> FeatureExtractor:
    """The extractor of a name in SCORE_FEATURES; UserError for another, or weights that are not there, in
    `weights_dir`, or where they usually are."""
    from foundation import catalog, depth_features, features, store

    if name == depth_features.NAME:
        extractor = depth_features.load()
        return FeatureExtractor(name, extractor.source, extractor)
    if name not in SCORE_FEATURES:
        raise unknown_name("score.features", name, SCORE_FEATURES)
    published = name in (catalog.FID_INCEPTION, catalog.RESNET18)
    network = features.load_extractor((weights_dir or store.WEIGHTS_DIR) / name if published else None)
    return FeatureExtractor(name, network.source, lambda depth_m: network(as_pictures(depth_m)))


def as_pictures(depth_m: Float[np.ndarray, "N H W"]) -> UInt8[np.ndarray, "N H W 3"]:
    """(N, H, W) metres -> (N, H, W, 3) uint8 grey: inverse depth, holes black, on one fixed scale."""
    inverse = inverse_depth(depth_m)
    level = (inverse - 1 / FAR_M) / (1 / NEAR_M - 1 / FAR_M)
    grey = np.rint(255 * np.clip(level, 0, 1)).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)
