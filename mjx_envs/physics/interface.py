"""The physics interface that the environment is written against.

A backend advances one environment by one control step and keeps nothing between calls: all that
matters is in `PhysicsState` and `ModelParams`. Backends: `c_engine` (MuJoCo's C engine), `mjx_jax` (MJX)
and `mjx_warp` (MJX-Warp), chosen in `backends`; `conformance` says how closely they agree. All functions are
for one environment; use `jax.vmap` for many.
"""

import sys
from types import ModuleType
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from flax import struct
from jaxtyping import Float
from mujoco import mjx

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from mjx_envs import scene
from mjx_envs.precision import exact


@struct.dataclass
class ModelParams:
    """What differs between environments of a batch."""

    slot_size: jax.Array
    """(S, 3) MuJoCo sizes of the object's geoms (S slots), m."""
    slot_pos: jax.Array
    """(S, 3) in the object frame, m."""
    slot_quat: jax.Array
    """(S, 4)."""
    object_mass: jax.Array
    """() kg."""
    object_inertia: jax.Array
    """(3,) principal moments, kg m^2."""
    object_friction: jax.Array
    """() sliding friction."""
    link_mass_scale: jax.Array
    """(7,) relative mass and inertia of the arm's links."""
    joint_damping: jax.Array
    """(7,) N m s / rad."""
    joint_friction: jax.Array
    """(7,) dry friction, N m."""
    gain_scale: jax.Array
    """(7,) relative stiffness and damping of the joint position controllers."""


@struct.dataclass
class PhysicsState:
    """Dynamic state between control steps."""

    qpos: jax.Array
    """(16,) arm 7 rad, fingers 2 m, object position 3 m, quaternion 4."""
    qvel: jax.Array
    """(15,)"""
    warmstart: jax.Array
    """(15,) the constraint solver's last solution: with it a step is repeatable to the bit (on the C engine
    and on MJX-JAX on a CPU)."""
    touch: jax.Array
    """(2,) contact force (N) between the object and the left and right finger pad."""
    dropped: jax.Array
    """() int32 contacts beyond what the backend holds, summed over the last control step's physics steps:
    those geoms felt nothing of each other. 0 on the C engine, which holds any number."""


@runtime_checkable
class Physics(Protocol):
    """One control step of one environment."""

    def step(self, params: ModelParams, state: PhysicsState, ctrl: Float[jax.Array, "9"]) -> PhysicsState:
        """Advance by one control period with `ctrl` (9,): seven joint and two finger targets."""
        ...


def initial_state(qpos: Float[jax.Array, "16"]) -> PhysicsState:
    """At rest in `qpos` (16,), touching nothing."""
    return PhysicsState(
        qpos=qpos, qvel=jnp.zeros(scene.NV), warmstart=jnp.zeros(scene.NV), touch=jnp.zeros(2),
        dropped=jnp.zeros((), jnp.int32),
    )  # fmt: skip


def warn_of_dropped(dropped: float, control_steps: float) -> None:
    """Prints `dropped_warning` to standard error, if there is one."""
    if warning := dropped_warning(dropped, control_steps):
        print(warning, file=sys.stderr, flush=True)


def dropped_warning(dropped: float, control_steps: float) -> str | None:
    """One line about contacts that the backend could not hold in so many control steps; None without."""
    if not dropped:
        return None
    return (
        f"warning: {dropped:,.0f} contacts in {control_steps:,.0f} control steps were more than the physics "
        "backend holds and were left out: use --world.backend cpu, or raise CONTACTS_PER_CAPSULE "
        "of mjx_envs/scene.py (jax) or CONTACTS_PER_ENV and CONSTRAINTS_PER_ENV of mjx_warp.py (warp)"
    )


class ModelIndex:
    """Where the fields of `ModelParams` live in the compiled model."""

    def __init__(self, model: mujoco.MjModel):
        self.slots = scene.slot_ids(model)
        self.slot_is_capsule = model.geom_type[self.slots] == mujoco.mjtGeom.mjGEOM_CAPSULE
        self.object_body = model.body("object").id
        self.links = np.array([model.body(link.name).id for link in scene.ARM_LINKS])
        self.arm_dofs = np.array([model.joint(n).dofadr[0] for n in contract.ARM_JOINTS])
        self.arm_actuators = np.arange(scene.N_ARM)
        self._in_subtree = _subtrees(model)

    def fields(
        self, model: mujoco.MjModel | mjx.Model, params: ModelParams, xp: ModuleType = np
    ) -> dict[str, AnyArray]:
        """Model fields with `params` written in; works batched for NumPy (leading dimensions)."""
        batch = params.object_mass.shape

        def base(name):
            return xp.broadcast_to(xp.asarray(getattr(model, name)), batch + getattr(model, name).shape)

        gain = params.gain_scale
        size = params.slot_size
        rbound = scene.slot_bounding_radii(size, self.slot_is_capsule, xp)
        mass_scale, obj = params.link_mass_scale, self.object_body
        friction = xp.broadcast_to(params.object_friction[..., None], batch + self.slots.shape)
        put = _put_numpy if xp is np else _put_jax
        body_mass = put(base("body_mass"), (self.links,), base("body_mass")[..., self.links] * mass_scale)
        inertia = base("body_inertia")
        inertia = put(inertia, (self.links, slice(None)), inertia[..., self.links, :] * mass_scale[..., None])
        arm = self.arm_actuators
        bias = base("actuator_biasprm")
        return {
            "geom_size": put(base("geom_size"), (self.slots, slice(None)), size),
            "geom_pos": put(base("geom_pos"), (self.slots, slice(None)), params.slot_pos),
            "geom_quat": put(base("geom_quat"), (self.slots, slice(None)), params.slot_quat),
            "geom_rbound": put(base("geom_rbound"), (self.slots,), rbound),
            "geom_friction": put(base("geom_friction"), (self.slots, 0), friction),
            "body_mass": put(body_mass, (obj,), params.object_mass),
            "body_inertia": put(inertia, (obj, slice(None)), params.object_inertia),
            "dof_damping": put(base("dof_damping"), (self.arm_dofs,), params.joint_damping),
            "dof_frictionloss": put(base("dof_frictionloss"), (self.arm_dofs,), params.joint_friction),
            "actuator_gainprm": put(
                base("actuator_gainprm"), (arm, 0), base("actuator_gainprm")[..., arm, 0] * gain
            ),
            "actuator_biasprm": put(bias, (arm, slice(1, 3)), bias[..., arm, 1:3] * gain[..., None]),
        }

    @exact
    def derived(self, model: mjx.Model, fields: dict[str, AnyArray]) -> dict[str, jax.Array]:
        """Fields of one environment that MuJoCo precomputes from `fields` and MJX takes as they are (JAX).

        Without the first MJX-Warp takes each body's frame of reference for its centre of mass and free
        bodies accelerate in the air; the second sets how soft the object's contacts are. The arm's
        own weights stay the nominal ones.
        """
        obj = self.object_body
        mass, inertia = fields["body_mass"][obj], fields["body_inertia"][obj]
        inverse = jnp.stack([1 / mass, jnp.mean(1 / inertia)])
        return {
            "body_subtreemass": jnp.asarray(self._in_subtree, jnp.float32) @ fields["body_mass"],
            "body_invweight0": jnp.asarray(model.body_invweight0).at[obj].set(inverse),
        }


def _subtrees(model: mujoco.MjModel) -> np.ndarray:
    """(bodies, bodies) 1 where the column's body is the row's or a descendant of it."""
    inside = np.eye(model.nbody)
    for body in range(model.nbody - 1, 0, -1):  # children come after their parents
        inside[model.body_parentid[body]] += inside[body]
    return inside


def _put_numpy(array, index, value):
    array = np.array(array)
    array[(..., *index)] = value
    return array


def _put_jax(array, index, value):
    return array.at[(..., *index)].set(value)
