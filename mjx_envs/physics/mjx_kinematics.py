"""Poses of bodies and geoms for MJX-JAX: what `mjx.kinematics` computes, with a barrier between links.

XLA's CPU compiler fuses the whole chain of links into the programs that read it, and there computes each
link's parent again for every component that is read: the time doubles and more with every link (1,280 ms
instead of a fraction of one for this scene). A barrier keeps it from fusing across a link. `docs/physics.md`
has the measurements, and a test holds the times.
"""

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from mjx_envs import kinematics as quaternions

_FREE, _HINGE, _SLIDE = (
    mujoco.mjtJoint.mjJNT_FREE,
    mujoco.mjtJoint.mjJNT_HINGE,
    mujoco.mjtJoint.mjJNT_SLIDE,
)


def kinematics(mx: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`data` of one environment with anchors and axes of joints, poses of bodies, their centres of mass and
    geoms (JAX). Joints are hinges, slides and free ones; poses of sites are left as they were.
    """
    origin = jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0])
    poses, anchors, axes = [origin], [], []
    for body in range(1, mx.nbody):
        parent_pos, parent_quat = poses[mx.body_parentid[body]]
        pos, quat = _compose(parent_pos, parent_quat, mx.body_pos[body], mx.body_quat[body])
        first = int(mx.body_jntadr[body])
        for joint in range(first, first + int(mx.body_jntnum[body])):
            pos, quat, anchor, axis = _move(mx, data.qpos, joint, pos, quat)
            anchors.append(anchor)
            axes.append(axis)
        poses.append(jax.lax.optimization_barrier((pos, quat)))
    pos, quat = (jnp.stack(part) for part in zip(*poses, strict=True))
    inertia_pos, inertia_quat = _compose(pos, quat, mx.body_ipos, mx.body_iquat)
    on = mx.geom_bodyid
    geom_pos, geom_quat = _compose(pos[on], quat[on], mx.geom_pos, mx.geom_quat)
    return data.replace(
        xanchor=jnp.stack(anchors),
        xaxis=jnp.stack(axes),
        xpos=pos,
        xquat=quat,
        xmat=quaternions.quat_to_mat(quat, jnp),
        xipos=inertia_pos,
        ximat=quaternions.quat_to_mat(inertia_quat, jnp),
        geom_xpos=geom_pos,
        geom_xmat=quaternions.quat_to_mat(geom_quat, jnp),
    )


def _move(mx: mjx.Model, qpos: jax.Array, joint: int, pos, quat):
    """A body's pose (3,), (4,) moved by one of its joints; the joint's anchor and axis (3,) in the world."""
    kind, at = mx.jnt_type[joint], mx.jnt_qposadr[joint]
    if kind == _FREE:
        turn = qpos[at + 3 : at + 7]
        return qpos[at : at + 3], turn / jnp.linalg.norm(turn), qpos[at : at + 3], jnp.array([0.0, 0.0, 1.0])
    local_axis, local_anchor = mx.jnt_axis[joint], mx.jnt_pos[joint]
    anchor = pos + quaternions.rotate(quat, local_anchor, jnp)
    axis = quaternions.rotate(quat, local_axis, jnp)
    moved = qpos[at] - mx.qpos0[at]
    if kind == _SLIDE:
        return pos + axis * moved, quat, anchor, axis
    assert kind == _HINGE, f"joint {joint} of the scene is neither free, a hinge nor a slide"
    turn = jnp.concatenate([jnp.cos(moved / 2)[None], jnp.sin(moved / 2) * local_axis])
    quat = quaternions.quat_mul(quat, turn, jnp)
    return anchor - quaternions.rotate(quat, local_anchor, jnp), quat, anchor, axis


def _compose(pos, quat, local_pos, local_quat):
    """Poses (..., 3), (..., 4) given in other poses."""
    return pos + quaternions.rotate(quat, local_pos, jnp), quaternions.quat_mul(quat, local_quat, jnp)
