"""Noise grafting (paper III-B2): the sensor's artefacts on the simulation's exact geometry."""

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike


def artefact_mask(x_pred: ArrayLike, threshold: float) -> Array:
    """M (bool): True where the generated map in diffusion space, any shape, is a hole (see
    ddg_jax/normalise.py).
    """
    return jnp.asarray(x_pred) < threshold


def graft_mask(d_sim_m: ArrayLike, d_pred_m: ArrayLike, mask: ArrayLike) -> Array:
    """d_final = d_sim (1 - M) + d_pred M (paper eq. 5), by selection: M = 0 pixels keep d_sim's bits."""
    return jnp.where(mask, d_pred_m, d_sim_m)


def graft(d_sim_m: ArrayLike, d_pred_m: ArrayLike, threshold_m: float) -> Array:
    """The equation with M = d_pred < threshold: holes of d_pred (0 m) replace d_sim. Same shapes, metres, 0 =
    hole.
    """
    return graft_mask(d_sim_m, d_pred_m, artefact_mask(d_pred_m, threshold_m))
