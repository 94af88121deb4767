"""The monocular baseline (FetchBot's way in the paper's Table II): depth from colour by a pretrained network.

Its relative inverse depth is made metric frame by frame, by what the camera at hand measured: clean depth in
simulation, recorded depth on the rig. What comes out has no holes, wherever the camera had some.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import UInt8, UInt16

from ddg_jax.network_prior import FEWEST_VALID, DepthNetworkPrior, metric_depth
from ddgrasp.config import DDGConfig
from ddgrasp.depth import to_metres, to_millimetres
from foundation import catalog


class MonocularDepth:
    """Depth Anything V2 Small from the folder where `ddgrasp weights convert` puts it."""

    def __init__(self, config: DDGConfig, weights: str = ""):
        """`config` gives the size of its pictures, its arithmetic and its range; `weights` another folder.

        Raises UserError where there are no weights.
        """
        prior = replace(config.prior, source=catalog.IMAGE_DEPTH, weights=weights, in_sim="rgb")
        self._prior, self._far_m = DepthNetworkPrior(replace(config, prior=prior)), config.depth.far_m

    def __call__(
        self, measured_mm: UInt16[np.ndarray, "B H W"], rgb: UInt8[np.ndarray, "B h w 3"]
    ) -> UInt16[np.ndarray, "B H W"]:
        """(B, H, W) uint16 millimetres at the size and scale of measured depth (0 = invalid).

        A frame with fewer than two valid pixels has no depth at all.
        """
        measured_m = to_metres(measured_mm)
        made_m = np.zeros_like(measured_m)
        for i, frame_m in enumerate(measured_m):
            if np.count_nonzero(frame_m) >= FEWEST_VALID:
                relative = self._prior.relative(rgb[i : i + 1], frame_m.shape)[0]
                made_m[i] = metric_depth(relative, frame_m, self._far_m)
        return to_millimetres(made_m)
