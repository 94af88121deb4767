"""Steps per second of the grasping environment and of the PPO rollout, against Playground and bare MuJoCo."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from brax.training import acting
from brax.training.agents.ppo import networks as ppo_networks
from mujoco import rollout
from mujoco.batch import Batch

from benchmarks import playground_pick
from benchmarks.compare import Contender, Row, compare, measure
from ddgrasp import contract, machine
from ddgrasp.config import Config
from ddgrasp.layout import QPOS
from mjx_envs import grasp_math
from mjx_envs.grasp_env import AutoReset, GraspEnv
from mjx_envs.physics.interface import ModelIndex, ModelParams, PhysicsState
from ppo import learner
from ppo.policy import load_state

PLAYGROUND_TARGET = 50.0
BARE_TARGET = 0.6
MENDED_TARGET = 5.0
EARLIER_TARGET = 300.0
EARLIER_SHARE = 27.9 / 73.9
"""Physics steps/s of this environment on MJX-JAX before contacts were capped and links kept apart, over those
of PandaPickCube as it is on the same machine (two AMD EPYC cores, 2026-11-21): machines differ by a factor of
two, so the earlier rate here is this share of the peer's."""
PLAYGROUND_BATCHES = (1, 32)
"""Of Playground as it is, which gets the better of the two: a large batch spares it overhead, a small one
synchronisation. All of a batch start from one reset."""
MENDED_BATCHES = (32, 256)
"""Of Playground with a barrier between its links, as our own backend has (`playground_pick.WithBarriers`)."""
JAX_BATCH = 256
TEACHER = "pretrained/teacher"
"""Policy of the rollout: its states are those that training sees, with grasps among them."""
_SETTLE_UNROLLS = 3
"""Unrolls after which every environment is in an episode of its own: they are spread over its phases."""


# --- against MuJoCo Playground ---------------------------------------------------------------------


def playground_rows(config: Config, rounds: int) -> list[Row]:
    """Environment steps with random actions: ours on two backends, PandaPickCube as it is and mended."""
    substeps = _substeps(config)
    jax_world = replace(config.world, backend="jax")
    cpu, mjx = "C engine (cpu)", "MJX (jax)"
    contenders = {}
    for name, world, batch, calls in (
        (cpu, config.world, config.teacher.num_envs, 3),
        (mjx, jax_world, JAX_BATCH, 3),
    ):
        env = GraspEnv(world)
        start = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), batch))
        contenders[name] = stepping(env, start, substeps, calls)
    pick = playground_pick.make_env()
    mended = playground_pick.WithBarriers(pick)
    first = jax.jit(mended.reset)(jax.random.key(0))
    peers: dict[str, list[str]] = {}
    for title, env, batches, calls in (
        ("PandaPickCube", pick, PLAYGROUND_BATCHES, 16),
        ("PandaPickCube with barriers", mended, MENDED_BATCHES, 512),
    ):
        for batch in batches:
            start = jax.tree.map(lambda x, n=batch: jnp.broadcast_to(x, (n, *x.shape)), first)
            name = f"{title}, batch {batch}"
            contenders[name] = stepping(env, start, pick.n_substeps, calls=max(1, calls // batch))
            peers.setdefault(title, []).append(name)
    rates = measure(contenders, rounds)
    as_it_is, best = (max(names, key=lambda n: float(np.median(rates[n]))) for names in peers.values())
    earlier = "MJX (jax) of 2026-11-21, scaled"
    rates = {**rates, earlier: EARLIER_SHARE * rates[as_it_is]}
    rows = [
        compare(rates, "environment", "physics steps/s", ours, peer, target=target)
        for ours, peer, target in (
            (cpu, as_it_is, PLAYGROUND_TARGET),
            (cpu, best, None),
            (mjx, as_it_is, None),
            (mjx, best, MENDED_TARGET),
            (mjx, earlier, EARLIER_TARGET),
        )
    ]
    units = {"ours_units": substeps, "peer_units": pick.n_substeps}
    rows += [compare(rates, "environment", "control steps/s", ours, best, **units) for ours in (cpu, mjx)]
    return rows


def stepping(env: Any, state: Any, substeps: int, calls: int) -> Contender:
    """Control steps of a batch of environments from `state` with one random action each, their work counted
    in physics steps."""
    batch = len(state.reward)
    action = jax.random.uniform(jax.random.key(1), (batch, env.action_size), minval=-1.0, maxval=1.0)
    step = jax.jit(jax.vmap(env.step))
    holder = [state]

    def run() -> None:
        holder[0] = jax.block_until_ready(step(holder[0], action))

    return Contender(run, batch * substeps, calls)


# --- against bare MuJoCo -----------------------------------------------------------------------------


def rollout_rows(config: Config, rounds: int) -> list[Row]:
    """Physics steps inside the jitted PPO rollout against the C engine alone, from the same states."""
    substeps, count = _substeps(config), config.teacher.num_envs
    env = AutoReset(GraspEnv(config.world))
    unroll, policy, state = make_unroll(config, env)
    for _ in range(_SETTLE_UNROLLS):
        state, _ = unroll(state)
    holder = [state]

    def run() -> None:
        holder[0], _ = jax.block_until_ready(unroll(holder[0]))

    steps = count * substeps
    ours = f"PPO rollout, {count} environments"
    contenders = {ours: Contender(run, steps * config.teacher.unroll_steps)}
    params = jax.tree.map(np.asarray, state.info["episode"].params)
    start = jax.tree.map(np.asarray, state.data)
    action, _ = jax.jit(policy)(state.obs, jax.random.key(1))
    ctrl = grasp_math.controls(start.qpos[:, QPOS.arm], np.asarray(action))
    bare = bare_contenders(env.env.mj_model, params, start, ctrl, substeps)
    rates = measure(contenders | bare, rounds)
    return [compare(rates, "PPO rollout", "physics steps/s", ours, peer, target=BARE_TARGET) for peer in bare]


def make_unroll(config: Config, env: AutoReset) -> tuple[Callable, Callable, Any]:
    """What collects experience: (jitted state -> (state, transitions), exploring policy, first state)."""
    networks = learner.make_networks(config.teacher)
    fresh = jax.jit(partial(learner.init, config.teacher, env))(jax.random.key(0))
    start = learner.warm_start(fresh, load_state(TEACHER))
    brax_env: Any = env  # behaves as one
    policy = ppo_networks.make_inference_fn(networks)((start.normalizer, start.params.policy))

    def step(carry, _):
        state, key = carry
        key, k_act = jax.random.split(key)
        state, transition = acting.actor_step(brax_env, state, policy, k_act, ("truncation",))
        return (state, key), transition

    @jax.jit
    def unroll(state: Any) -> tuple[Any, Any]:
        carry = (env.refresh(state), jax.random.key(0))
        (state, _), transitions = jax.lax.scan(step, carry, None, config.teacher.unroll_steps)
        return state, transitions

    return unroll, policy, start.env_state


def bare_contenders(
    model: mujoco.MjModel, params: ModelParams, start: PhysicsState, ctrl: np.ndarray, substeps: int
) -> dict[str, Contender]:
    """A control step of B simulations by `mujoco.batch` and by `mujoco.rollout`, on all cores.

    Args:
      model: the scene.
      params: of each simulation, NumPy.
      start: its state, NumPy.
      ctrl: (B, 9).
      substeps: physics steps in a call.
    """
    count, threads = len(ctrl), machine.cores()
    batch = Batch(model, nsim=count, nthread=threads)
    for name, value in ModelIndex(model).fields(model, params).items():
        batch.expand(name)[:] = value
    batch.set_const()
    values = {"qpos": start.qpos, "qvel": start.qvel, "qacc_warmstart": start.warmstart, "ctrl": ctrl}
    for name, value in values.items():
        batch.bind(name)[:] = value
    rows = batch.state.copy()

    def run_batch() -> None:
        batch.state[:] = rows
        batch.step(nstep=substeps)

    models = [batch.get_model(i) for i in range(count)]
    states = np.stack([_full_state(model, batch.get_data(i)) for i in range(count)])
    pool, data = rollout.Rollout(nthread=threads), [mujoco.MjData(model) for _ in range(threads)]
    controls, warmstart = ctrl[:, None].astype(float), np.asarray(start.warmstart, float)
    out = (
        np.zeros((count, substeps, states.shape[1])),
        np.zeros((count, substeps, model.nsensordata)),
    )

    def run_rollout() -> None:
        pool.rollout(
            models, data, states, controls, nstep=substeps, initial_warmstart=warmstart,
            state=out[0], sensordata=out[1],
        )  # fmt: skip

    return {
        f"mujoco.{name}, {threads} threads": Contender(run, count * substeps, calls=5)
        for name, run in (("batch", run_batch), ("rollout", run_rollout))
    }


def _full_state(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.zeros(mujoco.mj_stateSize(model, full))
    mujoco.mj_getState(model, data, state, full)
    return state


def _substeps(config: Config) -> int:
    return round(contract.CONTROL_DT_S / config.world.sim_dt_s)
