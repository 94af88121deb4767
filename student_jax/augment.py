"""What a camera does to pixels that it does report. Grafting keeps simulated depth there to the last bit.

A student trained on exact surfaces takes every ripple of a far table for an object: in the rig it let go
of what it had lifted, and on ideal depth never. So training ripples them.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Float, Key

from ddgrasp.config import StudentConfig
from ddgrasp.contract import CameraProfile

CORRELATION_PX = 2
"""Neighbouring pixels share their matching window; the rig's residuals correlate by 0.65 at one pixel."""
SPURIOUS_SHARE = 0.002
SPURIOUS_PX = 8.0
"""Largest disparity error of a wrong match, and the share of 2x2 cells that have one."""
_MIN_DISPARITY_PX = 0.5


def disparity_noise(
    key: Key[jax.Array, ""],
    depth_m: Float[jax.Array, "B F H W"],
    profile: CameraProfile,
    config: StudentConfig,
) -> Float[jax.Array, "B F H W"]:
    """Depth with correlated disparity noise and a few wrong matches on its valid pixels.

    disparity = f b / depth, so that depth errors grow with the square of depth (Nguyen et al. 2012). Each
    sample draws its own strength, uniform up to `config.disparity_noise_px`; half of the variance stays
    the same in all frames of a stack, as a camera's does.

    Args:
        depth_m: (B, F, H, W) planar metres, 0 = invalid.

    Returns:
        The same shape; invalid pixels stay so.
    """
    batch, frames, height, width = depth_m.shape
    k_strength, k_shared, k_own, k_where, k_wrong = jax.random.split(key, 5)
    coarse = (batch, frames, -(-height // CORRELATION_PX), -(-width // CORRELATION_PX))
    shared = jax.random.normal(k_shared, (batch, 1, *coarse[2:]))
    field = (shared + jax.random.normal(k_own, coarse)) / jnp.sqrt(2.0)
    strength = config.training.disparity_noise_px * jax.random.uniform(k_strength, (batch, 1, 1, 1))
    wrong = jax.random.bernoulli(k_where, SPURIOUS_SHARE, coarse)
    field = strength * field + wrong * jax.random.uniform(k_wrong, coarse, minval=-1.0) * SPURIOUS_PX
    field = jnp.repeat(jnp.repeat(field, CORRELATION_PX, axis=2), CORRELATION_PX, axis=3)
    fb = profile.fx_px * profile.baseline_m
    disparity = fb / jnp.maximum(depth_m, 1e-3) + field[:, :, :height, :width]
    return jnp.where(depth_m > 0, fb / jnp.maximum(disparity, _MIN_DISPARITY_PX), 0.0)
