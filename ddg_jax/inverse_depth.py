"""Inverse depth, the unit of every prior, normalised as relative depth networks are trained to give it."""

import numpy as np
from jaxtyping import Float, Float32

NORMALISED_LIMIT = 2.5
"""|c| of normalised priors never exceeds this."""
STATISTICS_STRIDE = 7
"""Every how many pixels the statistics are taken."""


def normalise(inverse: Float[np.ndarray, "T H W"]) -> Float32[np.ndarray, "T H W"]:
    """Affine-normalised inverse depth of a sequence (T, H, W): median 0, mean deviation 1/2, clipped."""
    sample = inverse.reshape(-1)[::STATISTICS_STRIDE]
    shift = np.median(sample)
    scale = 2 * np.mean(np.abs(sample - shift)) + 1e-6
    made = np.empty(inverse.shape, np.float32)
    for into, frame in zip(made, inverse, strict=True):  # a long sequence's temporary arrays are as long
        into[:] = np.clip((frame - shift) / scale, -NORMALISED_LIMIT, NORMALISED_LIMIT)
    return made
