"""Contacts for MJX-JAX: those of `mjx.collision`, one kind that it misses, and no more than are held.

`mjx.collision` sees nothing between a box and a short capsule whose centre is some millimetres beside the
face that it presses: the face is left out, since the centre is beyond its edge, and so is the edge, since it
lies within eight degrees of the face's normal. Pads sank into pears, whose capsules are nearly spheres.
"""

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx
from mujoco.mjx._src.math import make_frame
from mujoco.mjx._src.types import Contact

_CAPSULE, _BOX = int(mujoco.mjtGeom.mjGEOM_CAPSULE), int(mujoco.mjtGeom.mjGEOM_BOX)
_ROUNDS = 4
"""Projections between a capsule's axis and a box; for nearly spherical ones the distance is exact."""


def collide(mx: mjx.Model, data: mjx.Data, cap: int) -> tuple[Contact, jax.Array]:
    """The `cap` deepest contacts of one environment, and () int32 how many touch beyond those.

    Args:
      mx: a model without a cap of its own on contacts or pairs.
      data: with poses of geoms.
      cap: how many to return.
    """
    found = _with_missed(mx, data, mjx.collision(mx, data)._impl.contact)
    _, deepest = jax.lax.top_k(-found.dist, cap)
    dropped = jnp.maximum(jnp.sum(found.dist < 0) - cap, 0)
    return jax.tree.map(lambda x: x[deepest], found), dropped


def _with_missed(mx: mjx.Model, data: mjx.Data, found: Contact) -> Contact:
    """`found`, of which a capsule and a box that touch unseen get their first contact."""
    kinds = jnp.asarray(mx.geom_type)[found.geom]
    mixed = (kinds[:, 0] == _CAPSULE) & (kinds[:, 1] == _BOX)
    first = mixed & (found.geom != jnp.roll(found.geom, 1, axis=0)).any(axis=1)  # of two
    dist, pos, normal = jax.vmap(lambda pair: _capsule_box(mx, data, pair))(found.geom)
    missed = first & (dist < 0) & (found.dist > 0) & (jnp.roll(found.dist, -1) > 0)
    frame = jax.vmap(make_frame)(normal)
    return found.replace(
        dist=jnp.where(missed, dist, found.dist),
        pos=jnp.where(missed[:, None], pos, found.pos),
        frame=jnp.where(missed[:, None, None], frame, found.frame),
    )


def _capsule_box(mx: mjx.Model, data: mjx.Data, pair: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Distance (), midpoint (3,) and normal (3,) from the capsule to the box where they are closest.

    The capsule's axis is taken to be outside of the box; inside, the distance comes out positive.
    """
    capsule, box = pair[0], pair[1]
    turn, half = data.geom_xmat[box], mx.geom_size[box]
    radius, length = mx.geom_size[capsule, 0], mx.geom_size[capsule, 1]
    centre = turn.T @ (data.geom_xpos[capsule] - data.geom_xpos[box])
    axis = turn.T @ data.geom_xmat[capsule][:, 2]
    along = jnp.zeros(())
    for _ in range(_ROUNDS):
        closest = jnp.clip(centre + along * axis, -half, half)
        along = jnp.clip(axis @ (closest - centre), -length, length)
    point = centre + along * axis
    closest = jnp.clip(point, -half, half)
    away = point - closest
    apart = jnp.sqrt(jnp.sum(away**2))
    outward = away / jnp.maximum(apart, 1e-9)
    middle = (closest + point - radius * outward) / 2
    dist = jnp.where(apart > 1e-6, apart - radius, 1.0)
    return dist, data.geom_xpos[box] + turn @ middle, -turn @ outward
