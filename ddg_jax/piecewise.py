"""Recorded depth made whole and piecewise smooth: the geometry of rooms that nobody modelled.

Simulated depth has no holes, no noise, and surfaces that end at sharp edges. Recorded depth gets there by the
total generalised variation of inverse depth, in which planes cost nothing (Bredies, Kunisch & Pock 2010),
with edge weights as in depth upsampling (Ferstl et al. 2013). How near that comes to the true geometry is
measured where it is known, on the rig: `benchmarks/surfaces.py`.
"""

from typing import NamedTuple

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from learning.programs import Program, shape
from sensors.statistics.holes import fill_from_background

FIDELITY = 0.5
"""Price of a pixel that is off its measured value, against 1 for the same step between neighbours."""
BENDING = 8.0
"""Price of a change of slope."""
EDGE = 0.05
"""Relative step of inverse depth between neighbours at which a step costs half; larger ones cost less."""
LEAST_WEIGHT = 0.01
"""What a step costs at the sharpest edges."""
ITERATIONS = 600
_UNIT_PER_M = 0.01
"""Inverse depth is solved for in this unit, near the size of the steps that are to go."""
_STEP = 12**-0.5
"""Primal and dual step: the operator's squared norm is at most 12."""


def piecewise_smooth(inverse: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """(H, W) inverse depth in 1/m, 0 = unknown -> without unknowns, noise and blurred edges; 0 if all are."""
    start = fill_from_background(inverse)
    fidelity = FIDELITY * (inverse > 0).astype(np.float32)
    solved = _solved(jnp.asarray(start) / _UNIT_PER_M, jnp.asarray(fidelity), jnp.asarray(_edges(start)))
    return np.where(start > 0, np.maximum(np.asarray(solved) * _UNIT_PER_M, start.min()), 0)


def program(height_px: int, width_px: int) -> Program:
    """What solves a picture of that size."""
    return _solved, (shape(height_px, width_px),) * 3


def _edges(inverse: np.ndarray) -> np.ndarray:
    """(H, W) price of a step to the next row and column: 1 on surfaces, LEAST_WEIGHT at sharp edges."""
    calm = cv2.medianBlur(inverse, 5)
    down, right = (np.diff(calm, axis=axis, append=np.take(calm, [-1], axis)) for axis in (0, 1))
    relative = (np.abs(down) + np.abs(right)) / np.maximum(calm, 1e-3)
    return np.maximum(1 / (1 + (relative / EDGE) ** 2), LEAST_WEIGHT).astype(np.float32)


# --- the solver ----------------------------------------------------------------------------------
# min over u and its slope v:  sum f |u - u_0| + w |Du - v| + b |Ev|,  E the symmetrised derivative
# Vectors are tuples of (H, W): stacked, XLA would copy them at every step instead of fusing.


class _State(NamedTuple):
    """u and its slope v (rows, columns), where they lead to, and the duals p of Du - v, q of Ev (its two
    diagonal entries, then the other one).
    """

    u: Array
    v: tuple[Array, Array]
    u_ahead: Array
    v_ahead: tuple[Array, Array]
    p: tuple[Array, Array]
    q: tuple[Array, Array, Array]


def _minimise(u_0: Array, fidelity: Array, weight: Array) -> Array:
    """First-order primal-dual iterations (Chambolle & Pock 2011, algorithm 1)."""

    def iterate(_: Array, s: _State) -> _State:
        v_0, v_1 = s.v_ahead
        p_0, p_1 = (p + _STEP * (_next(s.u_ahead, i) - s.v_ahead[i]) for i, p in enumerate(s.p))
        over = jnp.maximum(1, jnp.sqrt(p_0**2 + p_1**2) / weight)
        p_0, p_1 = p_0 / over, p_1 / over
        q_0, q_1 = s.q[0] + _STEP * _next(v_0, 0), s.q[1] + _STEP * _next(v_1, 1)
        q_2 = s.q[2] + _STEP * (_next(v_0, 1) + _next(v_1, 0)) / 2
        over = jnp.maximum(1, jnp.sqrt(q_0**2 + q_1**2 + 2 * q_2**2) / BENDING)
        q_0, q_1, q_2 = q_0 / over, q_1 / over, q_2 / over
        away = s.u + _STEP * (_last(p_0, 0) + _last(p_1, 1)) - u_0
        u = u_0 + jnp.sign(away) * jnp.maximum(jnp.abs(away) - _STEP * fidelity, 0)
        v = (
            s.v[0] + _STEP * (p_0 + _last(q_0, 0) + _last(q_2, 1)),
            s.v[1] + _STEP * (p_1 + _last(q_2, 0) + _last(q_1, 1)),
        )
        v_ahead = (2 * v[0] - s.v[0], 2 * v[1] - s.v[1])
        return _State(u, v, 2 * u - s.u, v_ahead, (p_0, p_1), (q_0, q_1, q_2))

    o = jnp.zeros_like(u_0)
    first = _State(u_0, (o, o), u_0, (o, o), (o, o), (o, o, o))
    return jax.lax.fori_loop(0, ITERATIONS, iterate, first).u


_solved = jax.jit(_minimise)
"""`_minimise` as one program."""


def _next(u: Array, axis: int) -> Array:
    """The next one minus this one along an axis, 0 at the end."""
    if axis:
        return jnp.pad(u[:, 1:] - u[:, :-1], ((0, 0), (0, 1)))
    return jnp.pad(u[1:] - u[:-1], ((0, 1), (0, 0)))


def _last(p: Array, axis: int) -> Array:
    """This one minus the one before: the negative adjoint of `_next`."""
    if axis:
        inner = p[:, :-1]
        return jnp.pad(inner, ((0, 0), (0, 1))) - jnp.pad(inner, ((0, 0), (1, 0)))
    return jnp.pad(p[:-1], ((0, 1), (0, 0))) - jnp.pad(p[:-1], ((1, 0), (0, 0)))
