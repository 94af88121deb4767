"""The one shape of every camera model: `sense(key, depth_m, rgb) -> depth_m`, jittable, seeded, batched.

Families: ideal (here), procedural (`procedural.py`), active stereo (`stereo_sensor.py`), learned
(`ddg_jax/sensor.py`, which also has the registry by name, since it lies below all of them).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float, Float32, PRNGKeyArray, UInt32

from ddgrasp.errors import UserError

Key = PRNGKeyArray | UInt32[Array, "2"]
Sense = Callable[[Key, ArrayLike, ArrayLike | None], Float32[Array, "*batch H W"]]
"""(key, depth_m (..., H, W), rgb (..., H, W, 3) or None) -> (..., H, W) float32.

Depth is planar metres, 0 = invalid, before and after; an invalid pixel stays invalid. rgb is uint8 or float
in [0, 1]; families that work without it ignore it. Every picture of a batch gets a key of its own, split from
`key`; the same key gives the same result.
"""
SenseFrame = Callable[[Key, Float32[Array, "H W"], Float32[Array, "H W 3"] | None], Float[Array, "H W"]]
"""The same for one picture (H, W)."""


def batched(sense_frame: SenseFrame) -> Sense:
    """A camera model for any number of leading axes, from one for a single picture.

    Raises UserError (while tracing) for depth that is not floating point, or is no picture.
    """

    def sense(key: Key, depth_m: ArrayLike, rgb: ArrayLike | None = None) -> Float32[Array, "*batch H W"]:
        depth = check_depth(depth_m)
        colour = None if rgb is None else to_unit_rgb(rgb)
        if colour is not None and colour.shape != (*depth.shape, 3):
            raise UserError(
                f"rgb is {colour.shape}; expected {(*depth.shape, 3)}, as depth is {depth.shape}."
            )
        if depth.ndim == 2:
            return _keep_invalid(depth, sense_frame(key, depth, colour))
        lead, picture = depth.shape[:-2], depth.shape[-2:]
        flat = depth.reshape(-1, *picture)
        keys = jax.random.split(key, len(flat))
        if colour is None:
            noisy = jax.vmap(lambda k, d: sense_frame(k, d, None))(keys, flat)
        else:
            noisy = jax.vmap(sense_frame)(keys, flat, colour.reshape(-1, *picture, 3))
        return _keep_invalid(depth, noisy.reshape(*lead, *picture))

    return sense


def ideal() -> Sense:
    """The camera that reports what is there."""
    return batched(lambda key, depth_m, rgb: depth_m)


def check_depth(depth_m: ArrayLike) -> Float32[Array, "*batch H W"]:
    """(..., H, W) float32; UserError for integers (millimetres?) or fewer axes."""
    depth = jnp.asarray(depth_m)
    if not jnp.issubdtype(depth.dtype, jnp.floating) or depth.ndim < 2:
        raise UserError(
            f"Depth is {depth.dtype} {depth.shape}; expected (..., H, W) floating-point metres "
            "(divide millimetres by 1000)."
        )
    return depth.astype(jnp.float32)


def to_unit_rgb(rgb: ArrayLike) -> Float32[Array, "..."]:
    """uint8 or float colours to float32 in [0, 1]."""
    colour = jnp.asarray(rgb)
    scale = 1 / 255 if jnp.issubdtype(colour.dtype, jnp.integer) else 1.0
    return colour.astype(jnp.float32) * scale


def _keep_invalid(clean_m: Array, noisy_m: Array) -> Array:
    return jnp.where(clean_m > 0, noisy_m, 0.0).astype(jnp.float32)
