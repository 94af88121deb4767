"""The geometric prior c: clean relative depth that tells the generator what the scene is (paper III-B1).

The paper takes c from a video depth network on RGB (ddg_jax/network_prior.py, for which the user brings
weights). Any such source fits the `Prior` protocol; the built-in one needs no network: affine-normalised
inverse depth, from simulation directly, from recordings after filling the holes. Filling must not betray
where the holes were, or the generator would look for traces of filling that clean simulated depth never has.
Three things hide them: filled pixels take the background's depth of their own row (the true surface behind an
occlusion shadow), c is smoothed (which hides the noise of recorded surfaces too), and some frames are filled
under decoy holes as well. With `surface` piecewise, planes with sharp edges take the place of filling and
smoothing; with planes, large ones are made flat besides, since what the camera bends there would show in c
and never does in simulation.
"""

from collections.abc import Iterable, Iterator
from itertools import chain
from typing import Protocol, runtime_checkable

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

from ddg_jax.inverse_depth import normalise
from ddg_jax.network_prior import NETWORKS, DepthNetworkPrior, Pictures
from ddg_jax.piecewise import piecewise_smooth
from ddgrasp.config import FILTERED, PIECEWISE, PLANES, DDGConfig
from ddgrasp.depth import inverse_depth
from sensors.statistics.holes import fill_from_background, smooth_surface
from sensors.statistics.planes import on_planes

NEAREST_M = 0.15
"""Closer than any reading of the D435 that the metric prior was tried on (0.23 m): c stays the same from here
on."""
SAME_SURFACE = 0.05
"""Relative inverse-depth difference below which two frames see the same surface (temporal smoothing)."""


@runtime_checkable
class Prior(Protocol):
    """Source of c. Frames of one call belong to one recording or episode, in time order."""

    name: str
    needs_rgb: bool
    """Whether recordings must bring `rgb`; otherwise it is ignored and may be None."""
    needs_sim_rgb: bool
    """The same in simulation."""
    source: str | dict[str, str]
    """For reports: "built-in", or which weights were used."""

    def from_recording(
        self,
        depth_m: Float[np.ndarray, "T H W"],
        rgb: Pictures | None,
        rng: np.random.Generator,
        consecutive: bool = True,
    ) -> Float32[np.ndarray, "T H W"]:
        """depth_m (T, H, W) with holes (0), rgb (T, h, w, 3) uint8 -> c (T, H, W) float32; `consecutive`:
        whether the frames follow each other in time."""
        ...

    def from_sim(
        self, depth_m: Float[np.ndarray, "T H W"], rgb: UInt8[np.ndarray, "T h w 3"] | None
    ) -> Float32[np.ndarray, "T H W"]:
        """Clean depth_m (T, H, W), 0 = nothing within range, rgb likewise -> c (T, H, W) float32."""
        ...


class InverseDepthPrior:
    """c = clip((1/d - median) / (2 mean|1/d - median|)), the statistics over the whole sequence.

    The normalisation is the affine-invariant one of MiDaS (Ranftl et al. 2020, eq. 5-6); relative depth
    networks are trained to give inverse depth up to just that.
    """

    name = "inverse_depth"
    needs_rgb = needs_sim_rgb = False
    source: str | dict[str, str] = "built-in"

    def __init__(self, blur_px: float, decoy_share: float = 0.0, surface: str = FILTERED):
        self.blur_px = blur_px
        self.decoy_share = decoy_share
        self.surface = surface

    def from_recording(
        self,
        depth_m: Float[np.ndarray, "T H W"],
        rgb: Pictures | None,
        rng: np.random.Generator,
        consecutive: bool = True,
    ) -> Float32[np.ndarray, "T H W"]:
        """See `Prior`; `rng` chooses the frames filled under decoy holes and their shapes.

        Frame by frame: each stage of a whole recording's would be as large as the recording.
        """
        inverse = self._with_decoys(depth_m, rng)
        scaled = self._scaled if consecutive else self._scaled_apart
        if self.surface == PIECEWISE:
            return scaled(self._blurred(map(piecewise_smooth, inverse), depth_m.shape))
        filled = map(fill_from_background, inverse)
        smooth = map(smooth_surface, smooth_in_time(filled) if consecutive else filled)
        if self.surface == PLANES:
            smooth = map(on_planes, smooth)
        return scaled(self._blurred(smooth, depth_m.shape))

    def from_sim(
        self, depth_m: Float[np.ndarray, "T H W"], rgb: UInt8[np.ndarray, "T h w 3"] | None = None
    ) -> Float32[np.ndarray, "T H W"]:
        """See `Prior`."""
        inverse = inverse_depth(depth_m)
        # Filters that edges do not survive whole are passed by both sides.
        seen = inverse if self.surface == PIECEWISE else map(smooth_surface, inverse)
        return self._scaled(self._blurred(seen, depth_m.shape))

    def _with_decoys(self, depth_m: np.ndarray, rng: np.random.Generator) -> Iterator[np.ndarray]:
        """Inverse depth of each frame, of some with another frame's holes besides."""
        for frame, decoy in zip(depth_m, rng.random(len(depth_m)) < self.decoy_share, strict=True):
            inverse = inverse_depth(frame)
            if decoy:
                holes = inverse_depth(depth_m[rng.integers(len(depth_m))]) == 0
                inverse[decoy_holes(holes, rng)] = 0
            yield inverse

    def _scaled(self, inverse: np.ndarray) -> np.ndarray:
        """c of inverse depth that nobody else needs."""
        return normalise(inverse)

    def _scaled_apart(self, inverse: np.ndarray) -> np.ndarray:
        """The same of frames that are each a sequence of its own, in their place."""
        for frame in inverse:
            frame[:] = self._scaled(frame[None])[0]
        return inverse

    def _blurred(self, inverse: Iterable[np.ndarray], shape: tuple[int, ...]) -> np.ndarray:
        made = np.empty(shape, np.float32)
        for into, frame in zip(made, inverse, strict=True):
            into[:] = cv2.GaussianBlur(frame, (0, 0), self.blur_px) if self.blur_px > 0 else frame
        return made


class MetricInverseDepthPrior(InverseDepthPrior):
    """c = 2 m / d - 2: what lies one metre away is 0, whatever else the sequence shows.

    A stereo camera's noise, range and shadows depend on metric depth. Normalised by its own sequence, the
    same surface gets another c in every room, which matters to cameras that move.
    """

    name = "metric_inverse_depth"

    def _scaled(self, inverse: np.ndarray) -> np.ndarray:
        np.minimum(inverse, 1 / NEAREST_M, out=inverse)
        inverse *= 2
        inverse -= 2
        return inverse


_BUILT_IN = {kind.name: kind for kind in (InverseDepthPrior, MetricInverseDepthPrior)}


def make_prior(config: DDGConfig) -> Prior:
    """The prior that the configuration names; UserError for weights that are not there."""
    if config.prior.source in NETWORKS:
        return DepthNetworkPrior(config)
    kind = _BUILT_IN[config.prior.source]
    return kind(config.prior.blur_px, config.prior.decoy_holes, config.depth.surface)


def decoy_holes(holes: Bool[np.ndarray, "H W"], rng: np.random.Generator) -> Bool[np.ndarray, "H W"]:
    """A hole mask (H, W) moved to a random place (wrapping around), so that it lies on intact surface."""
    shift = (int(rng.integers(holes.shape[0])), int(rng.integers(holes.shape[1])))
    return np.roll(holes, shift, axis=(0, 1))


def smooth_in_time(inverse: Iterable[Float[np.ndarray, "H W"]]) -> Iterator[Float[np.ndarray, "H W"]]:
    """Mean over each frame (H, W) and its two neighbours, of pixels that still see the same surface."""
    before, now = None, None
    for after in chain(inverse, (None,)):
        if now is not None:
            yield _mean_of_surface(now, [frame for frame in (before, after) if frame is not None])
        before, now = now, after


def _mean_of_surface(inverse: np.ndarray, others: Iterable[np.ndarray]) -> np.ndarray:
    total, count = inverse.copy(), np.ones_like(inverse)
    for other in others:
        same = np.abs(other - inverse) < SAME_SURFACE * inverse
        total += np.where(same, other, 0)
        count += same
    return total / count
