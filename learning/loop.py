"""The optimiser's loop that fitting and distillation share: whole-state checkpoints, exact resume, curves."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import optax
import orbax.checkpoint as ocp
from jax import Array

from ddgrasp.progress import Progress, Task

Params = Any
"""Nested dict of arrays."""
LOG_EVERY = 10
_CHECKPOINTS_KEPT = 2


@flax.struct.dataclass
class TrainState:
    """Everything training needs to go on: this is what a checkpoint holds."""

    step: Array
    params: Params
    ema: Params
    """Exponential moving average of `params`: the weights that are used."""
    opt_state: optax.OptState
    key: Array
    """Raw key data (uint32); the step's key is fold_in(key, step)."""


Metrics = dict[str, Array]
StepFunction = Callable[[TrainState, int], tuple[TrainState, Metrics]]
"""(state, step number) -> (next state, scalars for the curves)."""


def first_state(params: Params, optimizer: optax.GradientTransformation, key: Array) -> TrainState:
    """State before the first step. `key` is raw key data."""
    # Copies: a donated state must not take the caller's parameters, or its own average, with it.
    own, average = (jax.tree.map(jnp.array, params) for _ in range(2))
    return TrainState(jnp.zeros((), jnp.int32), own, average, optimizer.init(params), key)


def updated(
    state: TrainState, optimizer: optax.GradientTransformation, grads: Params, ema_decay: float
) -> TrainState:
    """`state` after one optimiser step along `grads`."""
    updates, opt_state = optimizer.update(grads, state.opt_state, state.params)
    params = optax.apply_updates(state.params, updates)
    ema = averaged(state.ema, params, state.step, ema_decay)
    return TrainState(state.step + 1, params, ema, opt_state, state.key)


def averaged(ema: Params, params: Params, step: Array, decay: float) -> Params:
    """EMA update; the decay starts small so that the first, random weights are forgotten."""
    now = jnp.minimum(decay, (1 + step) / (10 + step))
    return jax.tree.map(lambda old, new: now * old + (1 - now) * new, ema, params)


def run_steps(
    state: TrainState,
    steps: int,
    step_function: StepFunction,
    checkpoints: Path,
    *,
    every: int,
    label: str,
    progress: Progress,
    curve: str = "",
) -> TrainState:
    """Takes `state` to `steps` steps.

    If `checkpoints` holds any, continues after the latest and ends with the state an uninterrupted run would
    have; writes one every `every` steps, at the end, and on Ctrl-C. Curves are named `curve` + scalar.
    """
    options = ocp.CheckpointManagerOptions(max_to_keep=_CHECKPOINTS_KEPT, enable_async_checkpointing=False)
    with ocp.CheckpointManager(checkpoints.absolute(), options=options) as manager:
        state = _latest(manager, state)
        done = int(state.step)
        with progress.task(label, steps) as task:
            task.start_at(done)
            try:
                for step in range(done, steps):
                    state, metrics = step_function(state, step)
                    _report(step + 1, steps, metrics, task, progress, curve)
                    if (step + 1) % every == 0:
                        _save(manager, state)
            finally:
                # Donated buffers of an interrupted step are gone: then the last checkpoint stands.
                if not any(leaf.is_deleted() for leaf in jax.tree.leaves(state)):
                    _save(manager, state)
    return state


def _report(step: int, steps: int, metrics: Metrics, task: Task, progress: Progress, curve: str) -> None:
    if step % LOG_EVERY and step != steps:
        task.advance()
        return
    values = {name: float(value) for name, value in metrics.items()}
    progress.scalars(step, **{curve + name: value for name, value in values.items()})
    task.advance(loss=values["loss"])


def _latest(manager: ocp.CheckpointManager, state: TrainState) -> TrainState:
    step = manager.latest_step()
    if step is None:
        return state
    restored: Any = manager.restore(step, args=ocp.args.StandardRestore(state))
    return restored


def _save(manager: ocp.CheckpointManager, state: TrainState) -> None:
    if manager.latest_step() != int(state.step):
        manager.save(int(state.step), args=ocp.args.StandardSave(state), force=True)
        manager.wait_until_finished()
