"""MJX: the same scene on any JAX device. `docs/physics.md` has what its parts cost."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from mjx_envs import scene
from mjx_envs.object_spec import SlotLayout
from mjx_envs.physics import mjx_solver
from mjx_envs.physics.interface import ModelIndex, ModelParams, PhysicsState
from mjx_envs.physics.mjx_collision import collide
from mjx_envs.physics.mjx_kinematics import kinematics
from mjx_envs.precision import exact

ITERATIONS = 20
LINE_STEPS = 30
TOLERANCE = 1e-8
"""The solver's. From the last step's solution two iterations are the rule; the batch goes on until its last
environment is done."""


class _Moving(NamedTuple):
    """What goes from one physics step to the next, and what is reported of the last."""

    qpos: jax.Array
    qvel: jax.Array
    warmstart: jax.Array
    touch: jax.Array
    dropped: jax.Array


class JaxPhysics:
    """MJX-JAX; carries no `mjx.Data` between control steps, so the state stays small."""

    def __init__(self, sim_dt_s: float, substeps: int, layout: SlotLayout):
        model = scene.build_model(sim_dt_s, layout)
        self.empty = mjx.make_data(model, impl="jax")
        self.model = mjx.put_model(_all_contacts(model), impl="jax")
        self._substeps = substeps
        self._max_contacts = scene.max_contacts(layout)
        self._index = ModelIndex(model)
        self._pads = np.array([model.geom(f"{side}_finger_pad").id for side in ("left", "right")])
        self._slots = np.array([model.geom(name).id for name in layout.colliding_names])

    @exact
    def step(self, params: ModelParams, state: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        """See `Physics.step`."""
        fields = self._index.fields(self.model, params, jnp)
        mx = self.model.replace(**fields, **self._index.derived(self.model, fields))
        start = _Moving(state.qpos, state.qvel, state.warmstart, jnp.zeros(2), jnp.int32(0))
        new, _ = jax.lax.scan(
            lambda now, _: (self._substep(mx, now, ctrl), None), start, None, self._substeps
        )
        return PhysicsState(**new._asdict())

    def _substep(self, mx: mjx.Model, now: _Moving, ctrl: jax.Array) -> _Moving:
        """`mjx.step` less what the scene has none of: sensors, tendons, cameras, applied forces."""
        data = self.empty.replace(qpos=now.qpos, qvel=now.qvel, ctrl=ctrl)
        data = mjx.crb(mx, mjx.com_pos(mx, kinematics(mx, data)))
        contact, dropped = collide(mx, data, self._max_contacts)
        data = data.tree_replace({"_impl.contact": contact})
        data = mjx.transmission(mx, mjx.make_constraint(mx, data))
        data = mjx.fwd_actuation(mx, mjx.fwd_velocity(mx, data))
        task = mjx_solver.problem(mx, data)
        acceleration, force = mjx_solver.solve(task, now.warmstart, ITERATIONS, LINE_STEPS, TOLERANCE)
        data = data.replace(qacc=acceleration, qfrc_smooth=task.force, qfrc_constraint=force @ task.jacobian)
        touch = self._touch(data, force)
        data = _advance(mx, data)
        return _Moving(data.qpos, data.qvel, acceleration, touch, now.dropped + dropped)

    def _touch(self, data: mjx.Data, force: jax.Array) -> jax.Array:
        """(2,) N, as the scene's sensors have it: the strongest contact of a pad with each slot, summed."""
        contact = data._impl.contact
        cones = force[-mjx_solver.CONE * len(contact.dist) :].reshape(-1, mjx_solver.CONE)
        strength = jnp.sqrt(jnp.sum(cones[:, :3] ** 2, axis=1))
        pads = jnp.any(contact.geom == self._pads[:, None, None], axis=-1)
        slots = jnp.any(contact.geom == self._slots[:, None, None], axis=-1)
        return jnp.max(jnp.where(pads[:, None] & slots, strength, 0.0), axis=-1).sum(axis=-1)


def _all_contacts(model: mujoco.MjModel) -> mujoco.MjModel:
    """`model`, whose fields change, of which `mjx.collision` returns every contact: we choose and count."""
    model.numeric_data[model.numeric_adr[model.numeric("max_contact_points").id]] = -1
    return model


def _advance(mx: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mjx.implicit`, but an actuator at its force limit damps nothing.

    The C engine and MJX-Warp leave such actuators out of the velocity derivative; MJX-JAX does not,
    which held back the arm's weak wrist by 0.13 rad in a fast swing.
    """
    low, high = mx.actuator_forcerange[:, 0], mx.actuator_forcerange[:, 1]
    free = (data.actuator_force > low) & (data.actuator_force < high)
    damping = jnp.where(free, mx.actuator_biasprm[:, 2], 0.0)
    return mjx.implicit(mx.replace(actuator_biasprm=mx.actuator_biasprm.at[:, 2].set(damping)), data)
