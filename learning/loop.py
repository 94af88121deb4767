"""The loop of optimiser steps: whole-state checkpoints, exact resume, curves."""

import contextlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import jax
import numpy as np
from jax import Array
from jaxtyping import Float

from ddgrasp.errors import UserError
from ddgrasp.progress import Progress, Task
from learning.checkpoints import Checkpoints, intact
from learning.train_state import TrainState

LOG_EVERY = 10
SAVE_EVERY = 200

Metrics = dict[str, Float[Array, ""]]
StepFunction = Callable[[TrainState, int], tuple[TrainState, Metrics]]
"""(state, step number) -> (next state, scalars for the curves)."""


def run_steps(
    state: TrainState,
    steps: int,
    step_function: StepFunction,
    checkpoints: Path | None,
    *,
    label: str,
    progress: Progress,
    every: int = SAVE_EVERY,
    curve: str = "",
    first_point: int = 0,
    log_every: int = LOG_EVERY,
    shown: Sequence[str] = ("loss",),
) -> tuple[TrainState, dict[str, float]]:
    """Takes `state` to `steps` steps.

    If the folder `checkpoints` holds any, continues after the latest and ends with the state an uninterrupted
    run would have; writes one every `every` steps, at the end, and on Ctrl-C. None: none are written, for
    steps that are quicker to repeat or whose draws depend on those before.

    Args:
      curve: curves are named `curve` + scalar.
      first_point: their points are `first_point` + steps done.
      log_every: steps between two points; the last step has one.
      shown: scalars beside the bar.

    Returns:
      The state, and the scalars of the last step; none if there was nothing left to do.

    Raises:
      UserError: a scalar of `shown` is not finite at a point, or it or a parameter where a checkpoint is due
        or at the end; none is written of that step.
    """
    metrics: Metrics = {}
    with contextlib.ExitStack() as stack:
        saved = None if checkpoints is None else stack.enter_context(Checkpoints(checkpoints))
        newest = None if saved is None else saved.latest
        state = state if saved is None else saved.restore_or(state)
        done = int(state.step)
        if newest not in (None, done):
            progress.note(f"{label}: the checkpoint of step {newest} is damaged, going on from {done}")
        task = stack.enter_context(progress.task(label, steps))
        task.start_at(done)
        try:
            for step in range(done, steps):
                state, metrics = step_function(state, step)
                logged = (step + 1) % log_every == 0 or step + 1 == steps
                due = saved is not None and (step + 1) % every == 0
                what = _diverged(metrics, shown) if logged or due else ""
                if not what and (due or step + 1 == steps) and not _finite(state):
                    what = "a parameter"
                if what:
                    raise UserError(
                        f"{label}: {what} is not finite after {step + 1} steps: the training has diverged; "
                        "begin anew with a smaller learning rate."
                    )
                if logged:
                    _report(first_point + step + 1, metrics, task, progress, curve, shown)
                else:
                    task.advance()
                if saved is not None and due:
                    saved.save(step + 1, state)
        finally:
            if saved is not None and intact(state) and not _diverged(metrics, shown) and _finite(state):
                saved.save(int(state.step), state)
    return state, _floats(metrics)


def _diverged(metrics: Metrics, shown: Sequence[str]) -> str:
    """The first of the scalars `shown` that is not finite; empty if all are."""
    return next((name for name in shown if not math.isfinite(metrics.get(name, 0.0))), "")


def _finite(state: TrainState) -> bool:
    """Whether all parameters are; looked at on the host, where they are to be kept: nothing to compile."""
    return all(bool(np.isfinite(np.asarray(leaf)).all()) for leaf in jax.tree.leaves(state.params))


def _report(
    point: int, metrics: Metrics, task: Task, progress: Progress, curve: str, shown: Sequence[str]
) -> None:
    values = _floats(metrics)
    progress.scalars(point, **{curve + name: value for name, value in values.items()})
    task.advance(1, **{name: values[name] for name in shown})


def _floats(metrics: Metrics) -> dict[str, float]:
    return {name: float(value) for name, value in metrics.items()}
