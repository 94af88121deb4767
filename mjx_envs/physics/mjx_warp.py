"""MJX-Warp: MuJoCo Warp's kernels on an NVIDIA GPU, called from jitted JAX code."""

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

from ddgrasp.errors import UserError
from ddgrasp.install import pip_install
from mjx_envs import scene
from mjx_envs.grasp_math import touch_from_sensors
from mjx_envs.object_spec import SlotLayout
from mjx_envs.physics.interface import ModelIndex, ModelParams, PhysicsState

CONTACTS_PER_ENV = 40
"""Room per environment in the batch's common buffer: nine slots against table, hand and two pads, all near
at once, are 36 candidates; the most contacts seen is 24 (a ring in the guide's grasp). Warp computes those
that there are, so that a closer cap would save memory alone."""
CONSTRAINTS_PER_ENV = 128
"""Rows; the most seen is 104, the ring's."""


def require_gpu(what: str = "backend") -> None:
    """UserError unless warp-lang is installed and JAX sees an NVIDIA GPU. `what`: the setting that asks."""
    from mujoco.mjx import warp as mjx_warp

    if not mjx_warp.WARP_INSTALLED:
        raise UserError(f"{what} 'warp' needs warp-lang, which is not installed: {pip_install('cuda,warp')}.")
    if not any(device.platform == "gpu" for device in jax.devices()):
        raise UserError(
            f"{what} 'warp' needs an NVIDIA GPU and JAX sees only {jax.devices()[0].platform}: choose "
            f"{'cpu or jax' if what == 'backend' else 'jax'}, or on a machine with a GPU "
            f"{pip_install('cuda,warp')}."
        )


def warp_model(model: mujoco.MjModel) -> mjx.Model:
    """`model`, whose flags change, for MJX-Warp.

    Warp refuses the midphase flag, having no midphase, and would collide boxes by its general convex
    routine, which needs gigabytes of scratch for 16 k environments and is not the C engine's.
    """
    disable = mujoco.mjtDisableBit
    model.opt.disableflags &= ~int(disable.mjDSBL_MIDPHASE)
    model.opt.disableflags |= int(disable.mjDSBL_NATIVECCD)
    return mjx.put_model(model, impl="warp")


def too_many() -> int:
    """Bits of MuJoCo Warp's `Data.overflow` that say that rows, candidate pairs or contacts had no room.

    Once set they stay, and how many were lost is not kept: an environment counts 1 for a control step.
    """
    from mujoco.mjx.warp import mujoco_warp

    kinds = mujoco_warp.OverflowType
    return int(kinds.NEFC | kinds.BROADPHASE | kinds.NARROWPHASE)


class WarpPhysics:
    """MJX-Warp. Runs on Warp's CPU device as well, slowly, which the tests use; `require_gpu` is separate."""

    def __init__(self, sim_dt_s: float, substeps: int, layout: SlotLayout):
        self._model = scene.build_model(sim_dt_s, layout)
        self._index = ModelIndex(self._model)
        self._mx = warp_model(self._model)
        self._substeps = substeps
        self._step_batch = jax.custom_batching.custom_vmap(self._advance)
        self._step_batch.def_vmap(self._advance_nested)

    def step(self, params: ModelParams, state: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        """See `Physics.step`."""
        first = jax.tree.map(lambda x: x[None], (params, state, ctrl))
        return jax.tree.map(lambda x: x[0], self._step_batch(*first))

    def _advance(self, params: ModelParams, state: PhysicsState, ctrl) -> PhysicsState:
        """One control step of a batch, everything with leading dimension B.

        The batch must be known here: its environments share one buffer of contacts.
        """
        empty = mjx.make_data(
            self._model, impl="warp", naconmax=CONTACTS_PER_ENV * len(ctrl), njmax=CONSTRAINTS_PER_ENV
        )

        def one(params, state, ctrl):
            fields = self._index.fields(self._mx, params, jnp)
            mx = self._mx.replace(**fields, **self._index.derived(self._mx, fields))
            data = empty.replace(qpos=state.qpos, qvel=state.qvel, qacc_warmstart=state.warmstart, ctrl=ctrl)
            data, _ = jax.lax.scan(lambda d, _: (mjx.step(mx, d), None), data, None, self._substeps)
            return data.qpos, data.qvel, data.qacc_warmstart, data.sensordata, data._impl.overflow

        qpos, qvel, warmstart, sensors, overflow = jax.vmap(one)(params, state, ctrl)
        touch = touch_from_sensors(sensors, jnp)
        dropped = ((overflow & too_many()) != 0).astype(jnp.int32)
        return PhysicsState(qpos=qpos, qvel=qvel, warmstart=warmstart, touch=touch, dropped=dropped)

    def _advance_nested(self, axis_size, batched, *arguments):
        """`vmap` of `_advance`: one larger batch."""
        leaves, tree = jax.tree.flatten(arguments)
        full = [
            x if is_batched else jnp.broadcast_to(x, (axis_size, *x.shape))
            for x, is_batched in zip(leaves, jax.tree.leaves(batched), strict=True)
        ]
        merged = [x.reshape(-1, *x.shape[2:]) for x in full]
        new = self._step_batch(*jax.tree.unflatten(tree, merged))
        new = jax.tree.map(lambda x: x.reshape(axis_size, -1, *x.shape[1:]), new)
        return new, jax.tree.map(lambda _: True, new)
