"""PPO as pure functions over one state: Brax's networks, losses and normaliser under our own loop.

An iteration draws episodes, collects one batch of experience and takes the gradient steps on it: `refresh`,
`collect`, `improve`, three programs, since XLA keeps no program that calls the host (the C engine) on disk,
and compiling the two others took most of the time. The whole learner, environments included, is one pytree,
so that a checkpoint of it resumes exactly (to the bit on the C engine and on MJX-JAX on a CPU; not promised
on accelerators). It lies on a mesh of devices: environments and batches are shared out, parameters are
everywhere, and the numbers drawn are the same on any number of devices.
"""

import math
from collections.abc import Hashable
from dataclasses import replace
from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.training import acting, distribution, types
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses as ppo_losses
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.agents.ppo.optimizer import adaptive_kl_learning_rate
from flax import linen, struct
from jax.sharding import Mesh

from ddgrasp import contract
from ddgrasp.config import NOTHING, TeacherConfig
from ddgrasp.errors import UserError
from mjx_envs import devices, scene
from mjx_envs.grasp_env import AutoReset
from ppo import diagnostics, health

# The pyright ignores below are for annotations of Brax and optax: Brax's dataclasses get their decorator
# through `import flax`, which types do not follow; optax has no type for "any pytree".

OBSERVATION_STD_MIN = 0.01
"""Bounds the normalised size of components that hardly ever move, such as an upright object's tilt."""

SETTLED = 0.1
"""Factor on the KL divergence and the least step size at the end (`TeacherConfig.settle_from`)."""

STEERED_RATE_MIN = 1e-4
"""Least step size that `target_kl` steers to: at 3e-5, which Brax's own 1e-5 allows, PPO from nothing stayed
with the object in the hand and did not learn to lift it."""

COUNTED = ("contacts_dropped", "blown_up")
"""Metrics of the environment that an iteration's scalars hold the sum of."""

OF_EPISODES = ("success", "lost", "episode/return", "episode/length")
"""Scalars that are means over the episodes that an iteration ended, all 0 where it ended none."""


@struct.dataclass
class LearnerState:
    """Everything training needs to go on: this is what a checkpoint holds."""

    params: ppo_losses.PPONetworkParams
    normalizer: running_statistics.RunningStatisticsState
    opt_state: optax.OptState
    env_state: Any
    key: jax.Array
    iteration: jax.Array
    """() iterations done."""
    good_evaluations: jax.Array
    """() evaluations in a row, up to the last, that reached `stop_at`."""


def check_divisible(config: TeacherConfig, device_count: int) -> None:
    """UserError unless every minibatch can be shared out over so many devices."""
    unit = config.minibatches * device_count
    if config.num_envs % unit:
        raise UserError(
            f"teacher.num_envs {config.num_envs} in {config.minibatches} minibatches cannot be shared by "
            f"{device_count} devices: make it a multiple of {unit}, change teacher.minibatches, or show JAX "
            "fewer devices (CUDA_VISIBLE_DEVICES; on a CPU XLA_FLAGS or JAX_NUM_CPU_DEVICES)."
        )


def check_start(config: TeacherConfig, saved: dict) -> None:
    """UserError unless the policy `saved` (`ppo.policy.load_state`) has the layers of `config.hidden`."""
    layers = saved["layers"]
    widths = tuple(len(layers[f"hidden_{i}"]["bias"]) for i in range(len(layers) - 1))
    if widths != tuple(config.hidden):
        there, wanted = (" ".join(map(str, layers)) for layers in (widths, config.hidden))
        raise UserError(
            f"The teacher in teacher.start ({config.start}) has layers {there}, teacher.hidden is {wanted}: "
            f"add --teacher.hidden {there}."
        )


def shardings(mesh: Mesh) -> LearnerState:
    """Where each part of a learner lies on `mesh`: one sharding in the place of each field."""
    everywhere: Any = devices.replicated(mesh)
    return LearnerState(
        params=everywhere, normalizer=everywhere, opt_state=everywhere,
        env_state=devices.over_envs(mesh), key=everywhere, iteration=everywhere, good_evaluations=everywhere,
    )  # fmt: skip


def make_networks(config: TeacherConfig) -> ppo_networks.PPONetworks:
    """Brax's PPO networks: tanh-squashed normal policy and value MLPs on normalised observations.

    `config.action_std` and `config.gripper_std` scale the exploration noise: at Brax's own 0.7 the hand jumps
    centimetres a step and lets go of whatever it found.
    """
    networks = ppo_networks.make_ppo_networks(
        contract.OBSERVATION_SIZE,
        contract.ACTION_SIZE,
        preprocess_observations_fn=running_statistics.normalize,  # pyright: ignore[reportArgumentType]
        policy_hidden_layer_sizes=config.hidden,
        value_hidden_layer_sizes=config.hidden,
        activation=linen.elu,
    )
    std = np.array([config.action_std] * scene.N_ARM + [config.gripper_std])
    scale = jnp.asarray(std / math.log(2.0), jnp.float32)  # softplus(0) = log 2
    noise = distribution.NormalTanhDistribution(
        contract.ACTION_SIZE,
        min_std=config.min_std,
        var_scale=scale,  # pyright: ignore[reportArgumentType]  # declared int, used as a factor, of each component here
    )
    return networks.replace(parametric_action_distribution=noise)  # pyright: ignore[reportAttributeAccessIssue]


def network_params(policy: Any, value: Any) -> ppo_losses.PPONetworkParams:
    """Brax's pair of policy and value parameters."""
    return ppo_losses.PPONetworkParams(policy, value)  # pyright: ignore[reportCallIssue]


def make_optimizer(config: TeacherConfig) -> optax.GradientTransformation:
    """Adam with clipped gradients, for actor and critic apart; step sizes decay linearly, or the actor's is a
    part of the state that `steered` sets."""
    total, per_iteration = config.iterations, config.epochs * config.minibatches

    def clipped(adam: optax.GradientTransformation) -> optax.GradientTransformation:
        return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), adam)

    def decaying(rate: float, of_iterations: int) -> optax.GradientTransformation:
        return clipped(optax.adam(optax.linear_schedule(rate, 0.1 * rate, of_iterations * per_iteration)))

    steered = clipped(optax.inject_hyperparams(optax.adam)(learning_rate=config.learning_rate))
    parts: dict[Hashable, optax.GradientTransformation] = {
        "policy": steered
        if config.target_kl
        else decaying(config.learning_rate, max(1, total - config.critic_warmup)),
        "value": decaying(config.critic_learning_rate, total),
    }
    return optax.multi_transform(parts, network_params("policy", "value"))


def init(config: TeacherConfig, env: AutoReset, key: jax.Array) -> LearnerState:
    """A fresh learner and its environments."""
    k_policy, k_value, k_env, k_next = jax.random.split(key, 4)
    networks = make_networks(config)
    params = network_params(fresh_policy(config, k_policy), networks.value_network.init(k_value))
    normalizer = running_statistics.init_state(
        specs.Array((contract.OBSERVATION_SIZE,), jnp.dtype("float32"))
    )
    return LearnerState(
        params=params,
        normalizer=normalizer,
        opt_state=make_optimizer(config).init(params),  # pyright: ignore[reportArgumentType]
        env_state=env.reset(jax.random.split(k_env, config.num_envs)),
        key=k_next,
        iteration=jnp.zeros((), jnp.int32),
        good_evaluations=jnp.zeros((), jnp.int32),
    )


def fresh_policy(config: TeacherConfig, key: jax.Array) -> Any:
    """Policy parameters from which PPO or cloning begins: Brax's, the last layer's weights a hundredth.

    From nothing all of them: the arm stands still but for the noise, whatever it observes (Andrychowicz et
    al. 2021, section 3.2). Otherwise those that the noise's size is made of, which cloning leaves as drawn,
    so that it is `action_std` and `gripper_std`, whatever is observed.
    """
    layers = make_networks(config).policy_network.init(key)["params"]
    last = f"hidden_{len(layers) - 1}"
    is_noise = jnp.arange(2 * contract.ACTION_SIZE) >= contract.ACTION_SIZE  # Brax's order: means, noise
    factor = jnp.where(is_noise | (config.start == NOTHING), 0.01, 1.0)
    return {"params": layers | {last: layers[last] | {"kernel": factor * layers[last]["kernel"]}}}


def warm_start(state: LearnerState, saved: dict) -> LearnerState:
    """`state` with the policy and normaliser of `ppo.policy.load_state`, of the same layers (`check_start`);
    the value network stays fresh."""
    policy = {"params": saved["layers"]}
    normalizer = replace(state.normalizer, mean=saved["mean"], std=saved["std"])
    return with_policy(state, policy, normalizer)


def with_policy(
    state: LearnerState, policy: Any, normalizer: running_statistics.RunningStatisticsState
) -> LearnerState:
    """`state` with another policy and its normaliser; value network, optimiser and environments stay."""
    return replace(state, params=network_params(policy, state.params.value), normalizer=normalizer)


def with_evaluation(state: LearnerState, good: bool) -> LearnerState:
    """`state` after an evaluation that reached `stop_at`, or did not."""
    count = int(state.good_evaluations) + 1 if good else 0
    count = jax.device_put(np.int32(count), state.good_evaluations.sharding)
    return replace(state, good_evaluations=count)


# One iteration: three pure functions; jit them with config and env (or its mesh) static.


def refresh(config: TeacherConfig, env: AutoReset, state: LearnerState) -> LearnerState:
    """`state` with the episodes that its environments start next."""
    exploring = jnp.where(settling(config, state.iteration) > 0, 0.0, 1.0)
    return replace(state, env_state=env.refresh(state.env_state, exploring))


def collect(
    config: TeacherConfig, env: AutoReset, state: LearnerState
) -> tuple[LearnerState, types.Transition, dict[str, jax.Array]]:
    """`unroll_steps` of exploring: the state after them, transitions (B, T, ...), scalars for the curves."""
    policy = ppo_networks.make_inference_fn(make_networks(config))((state.normalizer, state.params.policy))
    k_unroll, _ = _keys(state)
    env_state, data, outcome = _unroll(env, state.env_state, policy, k_unroll, config.unroll_steps)
    data = jax.lax.with_sharding_constraint(data, devices.over_envs(env.mesh))
    return replace(state, env_state=env_state), data, outcome


def improve(
    config: TeacherConfig,
    mesh: Mesh,
    state: LearnerState,
    data: types.Transition,
    outcome: dict[str, jax.Array],
) -> tuple[LearnerState, dict[str, jax.Array], dict[str, jax.Array]]:
    """The gradient steps on what `collect` returned, which ends the iteration.

    Returns the new state, scalars for the curves, and scalars for the NaN guard (`ppo.health.watch`).
    """
    if not config.bootstrap_time_limit:
        data = ended(data)
    networks, normalizer = make_networks(config), state.normalizer
    _, k_sgd = _keys(state)
    (params, opt_state), losses = _improve(config, networks, normalizer, data, k_sgd, state, mesh)
    losses |= diagnostics.of_update(config, networks, normalizer, data, state.params.value, params.policy)
    if config.target_kl:
        losses["policy/learning_rate"] = optax.tree_utils.tree_get(opt_state, "learning_rate")
    if config.start == NOTHING:  # a policy that acts already would be put off by new scales
        # After the update: its probabilities are relative to those that the old scales gave.
        normalizer = running_statistics.update(
            normalizer, data.observation, std_min_value=OBSERVATION_STD_MIN
        )
    new = replace(
        state, params=params, normalizer=normalizer, opt_state=opt_state, iteration=state.iteration + 1
    )
    metrics = losses | outcome
    return new, metrics, health.watch(data.next_observation, data.action, metrics, new)


def _keys(state: LearnerState) -> jax.Array:
    """Keys of an iteration's exploration and of its gradient steps."""
    return jax.random.split(jax.random.fold_in(state.key, state.iteration))


def _unroll(env, env_state, policy, key, length):
    """`length` steps of all environments: final state, transitions (B, T, ...), outcome scalars."""

    def step(carry, _):
        env_state, key = carry
        key, k_act = jax.random.split(key)
        env_state, transition = acting.actor_step(env, env_state, policy, k_act, extra_fields=("truncation",))
        return (env_state, key), (transition, env_state.done, env_state.metrics)

    (env_state, _), (data, done, metrics) = jax.lax.scan(step, (env_state, key), None, length)
    episodes = jnp.maximum(done.sum(), 1.0)
    outcome = {"success": metrics["success"].sum() / episodes, "saturated": metrics["saturated"].mean()}
    outcome["lost"] = metrics["lost"].sum() / episodes
    outcome |= {f"episode/{k}": (metrics[k] * done).sum() / episodes for k in ("return", "length")}
    outcome |= {name: metrics[name].sum() for name in COUNTED}
    outcome |= {k: v.mean() for k, v in metrics.items() if k.startswith("reward/")}
    return env_state, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), data), outcome


def settling(config: TeacherConfig, iteration: jax.Array) -> jax.Array:
    """() how much of the time that `settle_from` leaves for settling is over: 0 before, 1 at the end."""
    total = config.iterations
    start = round(config.settle_from * total)
    return jnp.clip((iteration + 1 - start) / max(1, total - start), 0.0, 1.0)


def steered(
    opt_state: Any,
    kl: jax.Array,
    target_kl: jax.Array | float,
    least_rate: jax.Array | float = STEERED_RATE_MIN,
) -> Any:
    """`opt_state` with the actor's step size lowered where `kl` () is twice its target, raised where it is
    half of it, never below `least_rate`."""
    actor = opt_state.inner_states["policy"]
    limits: Any = (target_kl, least_rate)  # declared as numbers, used in arithmetic
    chain, _ = adaptive_kl_learning_rate(actor.inner_state, kl, *limits)
    return opt_state._replace(
        inner_states=opt_state.inner_states | {"policy": actor._replace(inner_state=chain)}
    )


def least_rate(config: TeacherConfig) -> float:
    """Least step size that steering goes down to before settling: one that begins below `STEERED_RATE_MIN`
    would be raised to it by its first large divergence."""
    return min(STEERED_RATE_MIN, config.learning_rate)


def _held_back(learns, waiting, opt_state):
    """`opt_state`, the actor's part as it was (`waiting`) unless it `learns`: an Adam that has counted steps
    without gradients takes the first ones with them several times too large."""
    actor = jax.tree.map(partial(jnp.where, learns), opt_state.inner_states["policy"], waiting)
    return opt_state._replace(inner_states=opt_state.inner_states | {"policy": actor})


def ended(data: types.Transition) -> types.Transition:
    """`data` whose episodes end where their time does: nothing comes after the last step."""
    extras: Any = data.extras
    limit = jnp.zeros_like(extras["state_extras"]["truncation"])
    return data._replace(extras=extras | {"state_extras": extras["state_extras"] | {"truncation": limit}})


def _improve(config, networks, normalizer, data, key, state, mesh):
    """`epochs` passes of minibatch gradient steps; new (params, opt_state), mean loss terms and gradients."""
    optimizer = make_optimizer(config)
    calm = 1.0 - (1.0 - SETTLED) * settling(config, state.iteration)
    loss_fn = partial(
        ppo_losses.compute_ppo_loss,
        ppo_network=networks,
        entropy_cost=config.entropy_cost,
        discounting=config.discount,
        reward_scaling=config.reward_scaling,
        gae_lambda=config.gae_lambda,
        clipping_epsilon=config.clip,
    )

    def minibatch(carry, batch_and_key):
        params, opt_state = carry
        batch, k_loss = batch_and_key
        (_, terms), grads = jax.value_and_grad(loss_fn, has_aux=True)(params, normalizer, batch, k_loss)
        terms |= {f"gradient/{name}": optax.global_norm(getattr(grads, name)) for name in ("policy", "value")}
        learns = state.iteration >= config.critic_warmup
        policy_grads = jax.tree.map(lambda g: jnp.where(learns, g, 0.0), grads.policy)
        grads = network_params(policy_grads, grads.value)
        waiting = opt_state.inner_states["policy"]
        updates, opt_state = optimizer.update(grads, opt_state, params)
        if config.target_kl:
            limits = (calm * config.target_kl, calm * least_rate(config))
            opt_state = steered(opt_state, terms["kl_mean"], *limits)
        opt_state = _held_back(learns, waiting, opt_state)
        params = cast(ppo_losses.PPONetworkParams, optax.apply_updates(params, updates))
        return (params, opt_state), terms

    def epoch(carry, k_epoch):
        k_permute, k_loss = jax.random.split(k_epoch)
        order = jax.random.permutation(k_permute, config.num_envs).reshape(config.minibatches, -1)
        batches = jax.tree.map(lambda x: x[order], data)
        batches = jax.lax.with_sharding_constraint(batches, devices.over_envs(mesh, axis=1))
        return jax.lax.scan(minibatch, carry, (batches, jax.random.split(k_loss, config.minibatches)))

    carry = (state.params, state.opt_state)
    carry, terms = jax.lax.scan(epoch, carry, jax.random.split(key, config.epochs))
    names = {name: f"loss/{name}" for name in ("policy_loss", "v_loss", "entropy_loss", "total_loss")}
    names |= {name: name for name in ("gradient/policy", "gradient/value")}
    return carry, {shown: jnp.mean(terms[name]) for name, shown in names.items()}
