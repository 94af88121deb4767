"""Noise grafting (paper III-B2): the sensor's artefacts on the simulation's exact geometry."""

import jax.numpy as jnp
from jax import Array


def artefact_mask(x_pred: Array, threshold: float) -> Array:
    """M (bool): True where the generated map in diffusion space, any shape, is a hole (see ddg_jax/normalise.py)."""
    return x_pred < threshold


def graft_mask(d_sim_m: Array, d_pred_m: Array, mask: Array) -> Array:
    """d_final = d_sim (1 - M) + d_pred M (paper eq. 5), by selection: M = 0 pixels are d_sim's bits. Metres."""
    return jnp.where(mask, d_pred_m, d_sim_m)


def graft(d_sim_m: Array, d_pred_m: Array, threshold_m: float) -> Array:
    """The equation with M = d_pred < threshold: holes of d_pred (0 m) replace d_sim. Same shapes, metres, 0 = hole."""
    return graft_mask(d_sim_m, d_pred_m, d_pred_m < threshold_m)
