"""Noise grafting (paper III-B2): the sensor's artefacts on the simulation's exact geometry."""

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Bool, Float


def graft(
    d_sim_m: Float[ArrayLike, "*x"], d_pred_m: Float[ArrayLike, "*x"], mask: Bool[ArrayLike, "*x"]
) -> Float[Array, "*x"]:
    """d_final = d_sim (1 - M) + d_pred M (paper eq. 9), by selection: M = 0 pixels keep d_sim's bits.

    Metres, 0 = hole; mask M: ddg_jax/representation.py says what an artefact is.
    """
    return jnp.where(mask, d_pred_m, d_sim_m)
