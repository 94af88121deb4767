"""MuJoCo's C engine on all cores, called from jitted JAX code."""

from threading import Lock
from typing import Any

import jax
import mujoco
import numpy as np
from jaxtyping import Float
from mujoco.batch import Batch

from ddgrasp import machine
from mjx_envs import devices, scene
from mjx_envs.grasp_math import touch_from_sensors
from mjx_envs.object_spec import SlotLayout
from mjx_envs.physics.interface import ModelIndex, ModelParams, PhysicsState


class CpuPhysics:
    """`mujoco.batch` behind `jax.pure_callback`: a host call steps a device's share of the batch."""

    def __init__(self, sim_dt_s: float, substeps: int, layout: SlotLayout):
        self._model = scene.build_model(sim_dt_s, layout)
        # What blew up stays so and ends the episode, as with MJX; MuJoCo would go on from its first state.
        self._model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        self._substeps = substeps
        self._index = ModelIndex(self._model)
        self._batches: dict[tuple[int, int], _HostBatch] = {}

    def step(self, params: ModelParams, state: PhysicsState, ctrl: jax.Array) -> PhysicsState:
        """See `Physics.step`."""
        out = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), state)
        args = (devices.shard_index(), params, state, ctrl)
        return jax.pure_callback(self._host_step, out, *args, vmap_method="broadcast_all")

    def _host_step(self, shard, params: ModelParams, state: PhysicsState, ctrl) -> PhysicsState:
        lead = np.shape(ctrl)[:-1]
        params, state, ctrl = jax.tree.map(
            lambda x: np.asarray(x).reshape((-1,) + np.shape(x)[len(lead) :]), (params, state, ctrl)
        )
        # Devices call at the same time, and a batch remembers whose parameters it holds: one batch for each.
        key = (int(np.ravel(shard)[0]), ctrl.shape[0])
        if key not in self._batches:
            self._batches[key] = _HostBatch(self._model, self._index, ctrl.shape[0], _threads(key[0]))
        new = self._batches[key].step(params, state, ctrl, self._substeps)
        return jax.tree.map(lambda x: x.reshape(lead + x.shape[1:]), new)


def _threads(shard: int) -> int:
    """Threads of a share's batch: this host's devices divide its cores; the whole has all."""
    return machine.cores() if shard < 0 else max(1, machine.cores() // jax.local_device_count())


class _HostBatch:
    """A `mujoco.batch.Batch` of a fixed number of environments; one caller at a time has its buffers."""

    def __init__(self, model: mujoco.MjModel, index: ModelIndex, n: int, threads: int):
        self._model, self._index, self._lock = model, index, Lock()
        self._batch = Batch(model, nsim=n, nthread=threads)
        self._params: ModelParams | None = None
        self._expanded: dict[str, np.ndarray] = {}
        self._qpos = self._batch.bind("qpos")
        self._qvel = self._batch.bind("qvel")
        self._ctrl = self._batch.bind("ctrl")
        self._warmstart = self._batch.bind("qacc_warmstart")
        self._sensors = self._batch.bind("sensordata")

    def step(
        self, params: ModelParams, state: PhysicsState, ctrl: Float[np.ndarray, "n 9"], substeps: int
    ) -> PhysicsState:
        """One control step of all n environments: everything has n rows."""
        with self._lock:  # programs that several threads run call at the same time
            return self._stepped(params, state, ctrl, substeps)

    def _stepped(self, params: ModelParams, state: PhysicsState, ctrl, substeps: int) -> PhysicsState:
        self._write_params(params)
        self._qpos[:], self._qvel[:] = state.qpos, state.qvel
        self._warmstart[:], self._ctrl[:] = state.warmstart, ctrl
        self._batch.step(nstep=substeps)
        none: Any = np.zeros(len(ctrl), np.int32)
        return PhysicsState(
            qpos=self._qpos.astype(np.float32),
            qvel=self._qvel.astype(np.float32),
            warmstart=self._warmstart.astype(np.float32),
            touch=touch_from_sensors(self._sensors, np).astype(np.float32),
            dropped=none,
        )

    def _write_params(self, params: ModelParams) -> None:
        """Write per-environment model fields, of the environments whose parameters changed alone."""
        leaves = jax.tree.leaves(params)
        if self._params is None:
            changed = np.ones(len(leaves[0]), bool)
        else:
            changed = np.zeros(len(leaves[0]), bool)
            for old, new in zip(jax.tree.leaves(self._params), leaves, strict=True):
                changed |= (old != new).reshape(len(new), -1).any(axis=1)
            if not changed.any():
                return
        self._params = None  # until all of them are written: Ctrl-C leaves a mixture of old and new
        fields = self._index.fields(self._model, jax.tree.map(lambda x: x[changed], params))
        for name, value in fields.items():
            if name not in self._expanded:
                self._expanded[name] = self._batch.expand(name)
            self._expanded[name][changed] = value
        self._batch.set_const(ids=np.flatnonzero(changed))  # inertia that MuJoCo precomputes for free bodies
        self._params = jax.tree.map(np.array, params)
