"""Depth in metres <-> the space in which the diffusion model works.

    x = -1                                                        hole (depth 0)
    x = (1/d - 1/far) / (1/near - 1/far), clipped to [0, 1]       valid: 0 from far_m on, 1 up to near_m

Inverse depth is proportional to disparity, in which a stereo camera's noise is uniform. The empty band
between -1 and 0 is as wide as the whole range of valid depths: a threshold inside it (`noise_threshold` in
the paper's III-B2) separates holes from surfaces.
"""

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike

HOLE = -1.0
VALID_LOW = 0.0
VALID_HIGH = 1.0


def to_diffusion(depth_m: ArrayLike, near_m: float, far_m: float) -> Array:
    """Planar metres, 0 = invalid, any shape -> x in {-1} or [0, 1], float32."""
    depth_m = jnp.asarray(depth_m)
    inverse = 1.0 / jnp.maximum(depth_m, 1e-6)
    x = (inverse - 1 / far_m) / (1 / near_m - 1 / far_m)
    return jnp.where(depth_m > 0, jnp.clip(x, VALID_LOW, VALID_HIGH), HOLE).astype(jnp.float32)


def to_depth(x: ArrayLike, near_m: float, far_m: float, threshold: float) -> Array:
    """x, any shape -> planar metres in [near_m, far_m]; exactly 0 where x < threshold."""
    x = jnp.asarray(x)
    inverse = 1 / far_m + jnp.clip(x, VALID_LOW, VALID_HIGH) * (1 / near_m - 1 / far_m)
    return jnp.where(x < threshold, 0.0, 1.0 / inverse).astype(jnp.float32)
