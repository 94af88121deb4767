"""Depth Anything V2 (Yang et al. 2024) and Video Depth Anything (Chen et al. 2025): one class, all sizes.

Both give relative inverse depth: large is near, scale and shift are arbitrary. The video network sees a
clip at once, at most 32 frames; longer ones: foundation/video.py.
"""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float, Float32, UInt8

from ddgrasp.errors import UserError, unknown_name
from foundation import pictures
from foundation.dpt import CoarseHead, FineHead
from foundation.resample import resize_corners
from foundation.sizes import PATCH_PX, DepthSize
from foundation.temporal import MAX_FRAMES
from foundation.vit import VisionTransformer

DTYPES = ("float32", "bfloat16")
Taps = tuple[Float[Array, "N gh gw width"], ...]
"""What the head reads: four outputs of the encoder, a token per patch."""


@dataclass(frozen=True)
class DepthNetwork:
    """A depth network; parameters are passed to its methods, as foundation/store.py loads them."""

    size: DepthSize
    video: bool
    dtype: str = "float32"
    """Arithmetic: float32, or bfloat16 (parameters stay float32; its error is in docs/networks.md)."""
    frames_at_once: int = 8
    """Frames that the encoder and the finest layers work on together: bounds memory, changes no result."""

    def __post_init__(self) -> None:
        if self.dtype not in DTYPES:
            raise unknown_name("dtype", self.dtype, DTYPES)

    @property
    def head(self) -> str:
        """The head's name in the checkpoint."""
        return "head" if self.video else "depth_head"

    def param_shapes(self) -> dict[str, Any]:
        """Tree of jax.ShapeDtypeStruct: the parameters, without computing any."""
        return jax.eval_shape(self.init, jax.random.key(0))

    def init(self, key: Array) -> dict[str, Any]:
        """Fresh parameters."""
        picture = jnp.zeros((1, 2 * PATCH_PX, 2 * PATCH_PX, 3))
        taps, pretrained = self._encoder.init_with_output(key, picture)
        maps, coarse = self._coarse.init_with_output(key, taps)
        fine = self._fine.init(key, *maps)
        return {"pretrained": pretrained["params"], self.head: {**coarse["params"], **fine["params"]}}

    def __call__(self, params: dict[str, Any], x: Float[Array, "B *T H W 3"]) -> Float32[Array, "B *T H W"]:
        """Standardised RGB, (B, H, W, 3) or for video (B, T, H, W, 3) -> (B, [T,] H, W) float32 >= 0.

        UserError for sides that are no multiples of 14, or more than 32 frames.
        """
        if not self.video:
            return self.decode(params, self.encode(params, x), 1)
        frames = x.reshape(-1, *x.shape[2:])
        return self.decode(params, self.encode(params, frames), x.shape[1]).reshape(x.shape[:-1])

    def encode(self, params: dict[str, Any], x: Float[Array, "N H W 3"]) -> Taps:
        """(N, H, W, 3) standardised RGB -> four (N, H/14, W/14, width)."""
        if x.shape[1] % PATCH_PX or x.shape[2] % PATCH_PX:
            raise UserError(
                f"The network was given pictures of {x.shape[1]} x {x.shape[2]}; expected multiples of "
                f"{PATCH_PX} (foundation.pictures.network_size finds them)."
            )
        with self._precision():
            encoder = partial(self._encoder.apply, {"params": params["pretrained"]})
            return _in_parts(encoder, x, self.frames_at_once)

    def decode(self, params: dict[str, Any], taps: Taps, frames: int) -> Float32[Array, "N 14*gh 14*gw"]:
        """Taps of (B * `frames`) pictures, a clip's one after the other -> (B * frames, H, W) float32."""
        if frames > MAX_FRAMES:
            raise UserError(
                f"A clip of {frames} frames; the network takes up to {MAX_FRAMES}, foundation/video.py any."
            )
        variables = {"params": params[self.head]}
        with self._precision():
            maps = self._coarse.apply(variables, taps, frames)
            return _in_parts(lambda m: self._fine.apply(variables, *m), maps, self.frames_at_once)

    @property
    def _encoder(self) -> VisionTransformer:
        return VisionTransformer(self.size, jnp.dtype(self.dtype))

    @property
    def _coarse(self) -> CoarseHead:
        return CoarseHead(self.size, self.video, jnp.dtype(self.dtype))

    @property
    def _fine(self) -> FineHead:
        return FineHead(self.size, jnp.dtype(self.dtype))

    def _precision(self) -> AbstractContextManager[Any]:
        """float32 means float32 on every device: accelerators would round products to fewer bits."""
        return jax.default_matmul_precision("highest" if self.dtype == "float32" else "default")


def _in_parts(function: Callable[[Any], Any], values: Any, at_once: int) -> Any:
    """`function` over the leading axis of a tree, `at_once` rows at a time, one compiled body."""
    count = jax.tree.leaves(values)[0].shape[0]
    if count <= at_once:
        return function(values)
    parts = -(-count // at_once)

    def split(x: Array) -> Array:
        filled = jnp.pad(x, [(0, parts * at_once - count)] + [(0, 0)] * (x.ndim - 1))
        return filled.reshape(parts, at_once, *x.shape[1:])

    done = jax.lax.map(function, jax.tree.map(split, values))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], done)


@partial(jax.jit, static_argnums=(0, 3))
def predict(
    network: DepthNetwork, params: dict[str, Any], rgb: UInt8[Array, "B *T H W 3"], input_size: int
) -> Float32[Array, "B *T H W"]:
    """Pictures as cameras give them to depth at their size, in one program.

    Args:
      rgb: (B, H, W, 3) uint8, or for the video network (B, T, H, W, 3), T <= 32.
      input_size: side in pixels that the shorter side is resized to (518 in training).

    Returns:
      (B, [T,] H, W) float32.
    """
    frames = rgb.reshape(-1, *rgb.shape[-3:])
    taps = encode_rgb(network, params, frames, input_size)
    clip = rgb.shape[1] if network.video else 1
    return decode_at(network, params, taps, clip, frames.shape[1:3]).reshape(rgb.shape[:-1])


def encode_rgb(
    network: DepthNetwork, params: dict[str, Any], rgb: UInt8[Array, "N H W 3"], input_size: int
) -> Taps:
    """(N, H, W, 3) uint8 -> taps, at the network's size for such pictures."""
    size = pictures.network_size(rgb.shape[1], rgb.shape[2], input_size, video=network.video)
    return network.encode(params, pictures.standardise(rgb, size))


def decode_at(
    network: DepthNetwork, params: dict[str, Any], taps: Taps, frames: int, size: tuple[int, ...]
) -> Float32[Array, "N {size[0]} {size[1]}"]:
    """Taps -> (B * frames, *size) float32."""
    depth = network.decode(params, taps, frames)
    return resize_corners(depth[..., None], (size[0], size[1]))[..., 0]
