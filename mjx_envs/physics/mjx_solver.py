"""MuJoCo's constraint solver for MJX-JAX: the convex problem of `mjx.solve`, with less work in an iteration.

The acceleration minimises 1/2 (a - a_s)' M (a - a_s) + s(J a - a_ref), a_s being the acceleration without
constraints and s the cost of violating them (MuJoCo's documentation, "Computation: constraint model"); cones
are elliptic. Newton's method with an exact line search. `mjx.solve` builds a dense (rows, rows) matrix for
the cones in every iteration, evaluates three points in every step of its line search and starts by evaluating
the problem three times; here cones are blocks, and a step of the search evaluates one point.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from mujoco import mjx

CONE = 4
"""Rows of a contact: normal, two tangents, torsion (`condim` 4)."""
FLAT = 0.01
"""Share of the slope at its start at which a line search ends (MuJoCo's `ls_tolerance`)."""
_TINY = 1e-15


class Problem(NamedTuple):
    """One environment's; R constraint rows, C contacts whose rows are the last 4 C, v degrees of freedom."""

    mass: jax.Array
    """(v, v)"""
    force: jax.Array
    """(v,) all but the constraints'."""
    jacobian: jax.Array
    """(R, v)"""
    reference: jax.Array
    """(R,) acceleration that a constraint aims at."""
    stiffness: jax.Array
    """(R,) MuJoCo's D."""
    dry_friction: jax.Array
    """(F,) force limits of the rows after the E equalities."""
    cone: jax.Array
    """(C, 4) factors that make the friction cones circular."""
    equalities: int


class _Line(NamedTuple):
    """What the cost along a search direction needs of its start and direction."""

    at: jax.Array
    along: jax.Array
    """(R,) constraint-space acceleration less reference, and its change."""
    slope: jax.Array
    curvature: jax.Array
    """() of the part that is not constraints."""


def problem(mx: mjx.Model, data: mjx.Data) -> Problem:
    """The problem that `mjx.make_constraint` and the smooth dynamics left in `data`."""
    made = data._impl
    assert (made.contact.dim == CONE).all(), "the scene has contacts of other dimensions than 4"
    sliding = made.contact.friction[:, :1]
    circular = jnp.concatenate(
        [sliding / jnp.sqrt(mx.opt.impratio), made.contact.friction[:, : CONE - 1]], axis=1
    )
    return Problem(
        mass=made.M,
        force=data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator,
        jacobian=made.efc_J,
        reference=made.efc_aref,
        stiffness=made.efc_D,
        dry_friction=made.efc_frictionloss[made.ne : made.ne + made.nf],
        cone=circular,
        equalities=made.ne,
    )


def solve(
    task: Problem, start: jax.Array, iterations: int, line_steps: int, tolerance: float
) -> tuple[jax.Array, jax.Array]:
    """Acceleration (v,) and constraint forces (R,), from a first guess (v,) of the acceleration.

    Ends after `iterations`, or when one would improve the cost by less than `tolerance` times the trace of
    the mass matrix (MuJoCo's rule).
    """
    least = tolerance * jnp.trace(task.mass)

    def unfinished(state):
        count, _, _, gain = state
        return (count < iterations) & (gain > least)

    def improve(state):
        count, acceleration, away, _ = state
        force, weighted = _force_and_weighted_rows(task, away)
        gradient = task.mass @ acceleration - task.force - force @ task.jacobian
        hessian = task.mass + task.jacobian.T @ weighted
        direction = -_solve_positive(hessian, gradient)
        gain = -gradient @ direction / 2
        line = _Line(
            at=away,
            along=task.jacobian @ direction,
            slope=direction @ (task.mass @ acceleration - task.force),
            curvature=direction @ task.mass @ direction,
        )
        flat = jnp.maximum(FLAT * 2 * gain, least)
        step = _line_search(task, line, flat, line_steps)
        return count + 1, acceleration + step * direction, away + step * line.along, gain

    away = task.jacobian @ start - task.reference
    _, acceleration, away, _ = jax.lax.while_loop(unfinished, improve, (0, start, away, jnp.float32(jnp.inf)))
    return acceleration, _force_and_weighted_rows(task, away)[0]


def _solve_positive(matrix: jax.Array, right: jax.Array) -> jax.Array:
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(matrix), right)


def _parts(task: Problem, rows: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Rows of equalities (E,), of dry friction (F,), of limits (L,) and of contacts (C, 4)."""
    first, contacts = task.equalities, task.cone.shape[0]
    second = first + task.dry_friction.shape[0]
    third = rows.shape[0] - CONE * contacts
    return rows[:first], rows[first:second], rows[second:third], rows[third:].reshape(contacts, CONE)


def _force_and_weighted_rows(task: Problem, away: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Forces (R,) at `away` (R,) = J a - a_ref, and the cost's second derivative times J (R, v)."""
    equality, friction, limit, contact = _parts(task, away)
    d_equality, d_friction, d_limit, d_contact = _parts(task, task.stiffness)
    loss = task.dry_friction
    cone_force, cone_weight = _cones(task.cone, contact, d_contact)
    forces = [
        -d_equality * equality,
        jnp.clip(-d_friction * friction, -loss, loss),
        -d_limit * jnp.minimum(limit, 0.0),
        cone_force.ravel(),
    ]
    active = [d_equality, d_friction * (jnp.abs(d_friction * friction) < loss), d_limit * (limit < 0)]
    weights = jnp.concatenate(active)
    rows = len(weights)
    blocks = task.jacobian[rows:].reshape(*contact.shape, -1)
    bent = jnp.sum(cone_weight[..., None] * blocks[:, None], axis=2)
    weighted = jnp.concatenate([weights[:, None] * task.jacobian[:rows], bent.reshape(-1, bent.shape[-1])])
    return jnp.concatenate(forces), weighted


def _zones(normal, tangent, mu):
    """Which contacts stick (all rows quadratic) and which slide (on the cone); the others are open."""
    sticks = jnp.where(tangent > 0, mu * normal + tangent <= 0, normal < 0)
    return sticks, (tangent > 0) & (normal < mu * tangent) & ~sticks


def _cones(cone, away, stiffness) -> tuple[jax.Array, jax.Array]:
    """Forces (C, 4) of contacts and their second derivatives (C, 4, 4)."""
    scaled = away * cone
    mu, normal = cone[:, 0], scaled[:, 0]
    tangent = jnp.sqrt(jnp.sum(scaled[:, 1:] ** 2, axis=1))
    sticks, slides = _zones(normal, tangent, mu)
    safe = jnp.maximum(tangent, _TINY)
    rigid = stiffness[:, 0] / (mu**2 * (1 + mu**2))
    outside = normal - mu * tangent
    unit = scaled / safe[:, None]
    ray = jnp.concatenate([jnp.ones_like(mu)[:, None], -mu[:, None] * unit[:, 1:]], axis=1)
    sliding = -(rigid * outside)[:, None] * ray * cone
    forces = jnp.where(sticks[:, None], -stiffness * away, jnp.where(slides[:, None], sliding, 0.0))

    edge = (mu * normal / safe)[:, None, None] * unit[:, :, None] * unit[:, None, :]
    edge += (mu**2 - mu * normal / safe)[:, None, None] * jnp.eye(CONE)
    first = jnp.arange(CONE) == 0
    bent = jnp.where(first[:, None], ray[:, None, :], jnp.where(first, ray[:, :, None], edge))
    bent = bent * (rigid[:, None, None] * cone[:, :, None] * cone[:, None, :])
    stuck = stiffness[:, :, None] * jnp.eye(CONE)
    weights = jnp.where(sticks[:, None, None], stuck, jnp.where(slides[:, None, None], bent, 0.0))
    return forces, weights


def _line_search(task: Problem, line: _Line, flat: jax.Array, steps: int) -> jax.Array:
    """() a step along the line where the cost's slope is at most `flat`: Newton's method, else bisection.

    The cost is convex, so that its slope changes sign once; it falls at zero, and 1 is Newton's own step. A
    search that ends early may have raised the cost, and threw grasped objects.
    """
    slopes = _slopes(task, line)

    def unfinished(state):
        count, _, _, _, done = state
        return (count < steps) & ~done

    def move(state):
        count, low, high, here, _ = state
        slope, curvature = slopes(here)
        low, high = jnp.where(slope < 0, here, low), jnp.where(slope < 0, high, here)
        there = here - slope / curvature
        middle = jnp.where(jnp.isinf(high), here, (low + high) / 2)
        there = jnp.where((there > low) & (there < high), there, middle)
        done = ~(jnp.abs(slope) > flat)  # a state that is not finite keeps no other waiting
        return count + 1, low, high, jnp.where(done, here, there), done

    zero, one = jnp.zeros_like(line.slope), jnp.ones_like(line.slope)
    return jax.lax.while_loop(unfinished, move, (0, zero, zero + jnp.inf, one, zero > 0))[3]


def _slopes(task: Problem, line: _Line):
    """A function of the step: slope and curvature () of the cost along the line."""
    equality, friction, limit, contact = _parts(task, line.at)
    v_equality, v_friction, v_limit, v_contact = _parts(task, line.along)
    d_equality, d_friction, d_limit, d_contact = _parts(task, task.stiffness)
    loss, mu = task.dry_friction, task.cone[:, 0]
    u, v = contact * task.cone, v_contact * task.cone
    uu, uv, vv = (jnp.sum(a[:, 1:] * b[:, 1:], axis=1) for a, b in ((u, u), (u, v), (v, v)))
    rigid = d_contact[:, 0] / (mu**2 * (1 + mu**2))
    stuck_slope = jnp.sum(d_contact * contact * v_contact, axis=1)
    stuck_curvature = jnp.sum(d_contact * v_contact**2, axis=1)
    slope_0 = line.slope + jnp.sum(d_equality * equality * v_equality)
    curvature_0 = line.curvature + jnp.sum(d_equality * v_equality**2)

    def at(step):
        x = friction + step * v_friction
        slope = slope_0 + curvature_0 * step + jnp.sum(v_friction * jnp.clip(d_friction * x, -loss, loss))
        curvature = curvature_0 + jnp.sum(d_friction * v_friction**2 * (jnp.abs(d_friction * x) < loss))
        x = limit + step * v_limit
        slope += jnp.sum(d_limit * v_limit * jnp.minimum(x, 0.0))
        curvature += jnp.sum(d_limit * v_limit**2 * (x < 0))
        normal, half = u[:, 0] + step * v[:, 0], uv + step * vv
        tangent = jnp.sqrt(jnp.maximum(uu + step * (uv + half), 0.0))
        sticks, slides = _zones(normal, tangent, mu)
        safe = jnp.maximum(tangent, _TINY)
        outside, turn = normal - mu * tangent, half / safe
        rate = v[:, 0] - mu * turn
        cone_slope = rigid * outside * rate
        cone_curvature = rigid * (rate**2 - outside * mu * (vv - turn**2) / safe)
        slope += jnp.sum(
            jnp.where(sticks, stuck_slope + step * stuck_curvature, jnp.where(slides, cone_slope, 0.0))
        )
        curvature += jnp.sum(jnp.where(sticks, stuck_curvature, jnp.where(slides, cone_curvature, 0.0)))
        return slope, jnp.maximum(curvature, _TINY)

    return at
