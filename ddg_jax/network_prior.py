"""The geometric prior c from a pretrained depth network on RGB: the paper's own choice (III-B1).

What the paper leaves open is c in simulation. Both readings are here (`DDGConfig.prior.in_sim`): the network
on simulated RGB, or simulated depth itself, inverted and normalised as the network's output is.
"""

from collections.abc import Callable, Iterable, Sequence
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from ddg_jax.inverse_depth import normalise
from ddgrasp.config import DDGConfig
from ddgrasp.depth import inverse_depth, window
from ddgrasp.errors import UserError
from foundation import catalog, store
from foundation.long_video import fit_scale_shift

NETWORKS = (catalog.VIDEO_DEPTH, catalog.IMAGE_DEPTH)
FEWEST_VALID = 2
"""Pixels that fix scale and shift of relative depth."""
_BATCH = 8
"""Pictures that the image network is given together."""

Pictures = UInt8[np.ndarray, "T h w 3"] | Sequence[UInt8[np.ndarray, "h w 3"]]
"""Colour of T frames: an array, or pictures that are read as they are looked at."""


def weights_folder(config: DDGConfig) -> Path:
    """Where the network's converted weights are looked for."""
    return Path(config.prior.weights or store.WEIGHTS_DIR / f"{config.prior.source}_small")


class DepthNetworkPrior:
    """c = affine-normalised output of Video Depth Anything or Depth Anything V2. See `Prior`."""

    needs_rgb = True

    def __init__(self, config: DDGConfig):
        self.name, self._config = config.prior.source, config
        self.needs_sim_rgb = config.prior.in_sim == "rgb"
        self._directory = weights_folder(config)
        manifest = store.read_manifest(self._directory)
        if not manifest.network.startswith(config.prior.source):
            raise UserError(
                f"{self._directory} holds {manifest.network}; ddg.prior.source is {config.prior.source}."
            )
        self.source: str | dict[str, str] = manifest.summary() | {"in_simulation": config.prior.in_sim}

    def from_recording(
        self,
        depth_m: Float[np.ndarray, "T H W"],
        rgb: Pictures | None,
        rng: np.random.Generator,
        consecutive: bool = True,
    ) -> Float32[np.ndarray, "T H W"]:
        """See `Prior`; depth gives the size only."""
        del rng
        size = depth_m.shape[1:]
        if consecutive or rgb is None:
            return self._from_rgb(rgb, size)
        return np.concatenate([self._from_rgb([frame], size) for frame in rgb])

    def from_sim(
        self, depth_m: Float[np.ndarray, "T H W"], rgb: UInt8[np.ndarray, "T h w 3"] | None = None
    ) -> Float32[np.ndarray, "T H W"]:
        """See `Prior`."""
        if self._config.prior.in_sim == "depth":
            return normalise(inverse_depth(depth_m))
        return self._from_rgb(rgb, depth_m.shape[1:])

    def _from_rgb(self, rgb: Pictures | None, size: tuple[int, ...]) -> np.ndarray:
        if rgb is None:
            raise UserError(
                f"ddg.prior.source {self.name} was given no RGB: keep it, or set ddg.prior.in_sim depth."
            )
        return normalise(self.relative(rgb, size))

    def relative(self, rgb: Pictures, size: Sequence[int]) -> Float[np.ndarray, "T {size[0]} {size[1]}"]:
        """Relative inverse depth as the network gives it, at `size`: neither normalised nor clipped."""
        return self._infer(rgb, (size[0], size[1]))

    @cached_property
    def _infer(self) -> Callable[[Pictures, tuple[int, int]], np.ndarray]:
        """T pictures, `size` -> (T, *size) relative inverse depth; loads the weights when first used.

        Each map comes to `size` before the next is made: in pictures' own size they are many times as large.
        """
        from foundation.convert import depth_network
        from foundation.depth import predict
        from foundation.pictures import in_batches
        from foundation.video import stream

        manifest, variables = store.load(self._directory, NETWORKS)
        network = depth_network(manifest.network, dtype=self._config.prior.dtype)
        params, side = variables["params"], self._config.prior.input_px

        def video(rgb: Pictures, size: tuple[int, int]) -> np.ndarray:
            if len(rgb) == 1:  # a frame by itself needs no window of 32
                return shrunk(np.asarray(predict(network, params, np.stack(list(rgb))[None], side))[0], size)
            return shrunk(stream(network, params, rgb, side), size)

        def pictures(rgb: Pictures, size: tuple[int, int]) -> np.ndarray:
            def batch(part: np.ndarray) -> np.ndarray:
                return shrunk(np.asarray(predict(network, params, part, side)), size)

            return batch(np.stack(list(rgb))) if len(rgb) == 1 else in_batches(batch, rgb, _BATCH)

        def shrunk(maps: Iterable[np.ndarray], size: tuple[int, int]) -> np.ndarray:
            return np.stack([at_size(one, size) for one in maps])

        return video if network.video else pictures


def at_size(image: Float[np.ndarray, "H W"], size: tuple[int, int]) -> Float[np.ndarray, "h w"]:
    """(H, W) -> `size`, averaged after a centred crop to its aspect ratio: the part of the scene that depth
    resized by `ddgrasp.depth.crop_nearest` shows.
    """
    (height, width), (rows, columns) = image.shape, window(image.shape, size)
    top, left = (height - rows) // 2, (width - columns) // 2
    cropped = np.ascontiguousarray(image[top : top + rows, left : left + columns])
    mode = cv2.INTER_AREA if rows > size[0] else cv2.INTER_LINEAR
    return cv2.resize(cropped, size[::-1], interpolation=mode)


def metric_depth(
    relative: Float[np.ndarray, "*x"], depth_m: Float[np.ndarray, "*x"], far_m: float
) -> Float32[np.ndarray, "*x"]:
    """The monocular baseline: depth in metres from relative inverse depth, fitted to what a camera measured.

    1 / d = a relative + b by least squares over the valid pixels (Ranftl et al. 2020, eq. 4), d <= `far_m`;
    a >= 0, since a network that tells nothing there, or takes near for far, tells no more than the mean.

    Args:
      relative: relative inverse depth.
      depth_m: measured depth of the same shape, 0 = invalid. UserError if fewer than two pixels are valid.
    """
    valid = depth_m > 0
    if np.count_nonzero(valid) < FEWEST_VALID:
        raise UserError("Relative depth cannot be made metric: the measured depth has no two valid pixels.")
    scale, shift = fit_scale_shift(relative[valid], 1 / depth_m[valid])
    if scale <= 0 or np.ptp(relative[valid]) == 0:
        scale, shift = 0.0, float(np.mean(1 / depth_m[valid]))
    return (1 / np.maximum(scale * relative + shift, 1 / far_m)).astype(np.float32)
