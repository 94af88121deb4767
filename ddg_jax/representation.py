"""Depth maps <-> the arrays x (..., C) in which the diffusion model works (`ddg.depth.representation`).

deviation, C = 2: what the sensor did to the surface that it looked at.
    x[0] = -1 hole, +1 valid
    x[1] = asinh(delta / s) / asinh(L / s),  delta = 1/d - 1/d_surface clipped to [-L, L],  0 in holes
  A stereo camera's errors are alike in disparity, so in inverse depth; asinh spreads the many errors of a
  thousandth of a pixel and keeps the few large ones at edges. A generated map is metric wherever the surface
  is, whatever the network does.

depth, C = 1: the depth map itself, as the paper's generator draws it.
    x = -1                                                        hole (depth 0)
    x = (1/d - 1/far) / (1/near - 1/far), clipped to [0, 1]       valid: 0 from far_m on, 1 up to near_m
  The network has to draw the geometry anew from a prior that knows neither scale nor offset.

`noise_threshold` (the paper's, III-B2) separates holes from surfaces in the first channel of either.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Float, Float32

from ddgrasp.config import DEPTH, DEVIATION, DDGConfig

HOLE, VALID = -1.0, 1.0
LIMIT_PER_M = 0.06
"""L: larger deviations of inverse depth (a pixel of disparity for a D455 at 320 px) are clipped."""
KNEE_PER_M = 0.0005
"""s: up to here asinh is nearly linear (a D455's disparity step, 1/32 px of its own)."""
FARTHEST_M = 50.0
"""No generated depth is farther: millimetres must fit 16 bits."""


class Decoded(NamedTuple):
    """What x says."""

    depth_m: Float32[Array, "*b"]
    """The generator's own map, 0 in holes."""
    mask: Bool[Array, "*b"]
    """M, where that is an artefact."""


def channels(config: DDGConfig) -> int:
    """C, the length of x's last axis."""
    return 2 if config.depth.representation == DEVIATION else 1


def correlations(config: DDGConfig) -> tuple[float, ...]:
    """Per channel of x: share of its initial noise that an episode's frames have in common."""
    return (config.sampling.frame_correlation, config.sampling.deviation_correlation)[: channels(config)]


def encode(
    config: DDGConfig, depth_m: Float[ArrayLike, "*b"], surface_m: Float[ArrayLike, "*b"]
) -> Float32[Array, "*b C"]:
    """Measured planar metres (0 = hole) of surfaces at `surface_m`, same shape -> x (..., C) float32."""
    depth_m = jnp.asarray(depth_m)
    if config.depth.representation == DEPTH:
        return _depth_to_x(depth_m, config)[..., None]
    valid = depth_m > 0
    deviation = jnp.where(valid, _inverse(depth_m) - _inverse(surface_m), 0.0)
    x = jnp.stack([jnp.where(valid, VALID, HOLE), _companded(deviation)], axis=-1)
    return x.astype(jnp.float32)


def decode(config: DDGConfig, x: Float[ArrayLike, "*b C"], surface_m: Float[ArrayLike, "*b"]) -> Decoded:
    """x (..., C) on surfaces at `surface_m` (...) metres, 0 = nothing there -> depth and artefact mask (...).

    An artefact is a hole or, in `deviation`, a deviation of `deviation_threshold` or more.
    """
    x, surface_m = jnp.asarray(x), jnp.asarray(surface_m)
    hole = x[..., 0] < config.graft.noise_threshold
    if config.depth.representation == DEPTH:
        return Decoded(jnp.where(hole, 0.0, _x_to_depth(x[..., 0], config)).astype(jnp.float32), hole)
    deviation = _expanded(x[..., 1])
    inverse = jnp.maximum(_inverse(surface_m) + deviation, 1 / FARTHEST_M)
    depth_m = jnp.where(hole | (surface_m <= 0), 0.0, 1 / inverse).astype(jnp.float32)
    return Decoded(depth_m, hole | (jnp.abs(deviation) >= config.graft.deviation_threshold))


def _inverse(depth_m: ArrayLike) -> Array:
    return 1 / jnp.maximum(depth_m, 1e-3)


def _companded(deviation: Array) -> Array:
    limited = jnp.clip(deviation, -LIMIT_PER_M, LIMIT_PER_M)
    return jnp.arcsinh(limited / KNEE_PER_M) / jnp.arcsinh(LIMIT_PER_M / KNEE_PER_M)


def _expanded(x: Array) -> Array:
    return KNEE_PER_M * jnp.sinh(jnp.clip(x, -1, 1) * jnp.arcsinh(LIMIT_PER_M / KNEE_PER_M))


def _depth_to_x(depth_m: Array, config: DDGConfig) -> Array:
    inverse = 1 / jnp.maximum(depth_m, 1e-6)
    x = (inverse - 1 / config.depth.far_m) / (1 / config.depth.near_m - 1 / config.depth.far_m)
    return jnp.where(depth_m > 0, jnp.clip(x, 0, 1), HOLE).astype(jnp.float32)


def _x_to_depth(x: Array, config: DDGConfig) -> Array:
    return 1 / (
        1 / config.depth.far_m + jnp.clip(x, 0, 1) * (1 / config.depth.near_m - 1 / config.depth.far_m)
    )
