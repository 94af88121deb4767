"""A tiny teacher trained in a process of its own, and how tests read what processes left behind.

`python teacher_worker.py DIRECTORY` trains TINY on the devices that its environment gives it. It leaves the
whole learner by name in DIRECTORY/state.npz, and in DIRECTORY/report.json how it lay on the devices.
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np

from app import commands
from ddgrasp.config import Config
from learning.checkpoints import Checkpoints
from mjx_envs.grasp_env import AutoReset, GraspEnv
from ppo import learner
from ppo import train as ppo_train
from ppo.evaluate import evaluate

ITERATIONS = 12
TINY = (
    "--preset", "debug", "--teacher.start", "nothing",
    "--teacher.total-steps", str(16 * 4 * ITERATIONS), "--teacher.num-envs", "16",
    "--teacher.minibatches", "2", "--teacher.unroll-steps", "4",
    "--teacher.hidden", "16", "--teacher.learning-rate", "1e-3",
    "--teacher.pregrasp-share", "0", "--teacher.eval-every", "100", "--world.episode-steps", "6",
    "--evaluation.teacher-trials", "12",
)  # fmt: skip
"""Options of `ddgrasp teacher train`: 16 environments in 2 minibatches; 12 trials are no multiple of 8."""


def config() -> Config:
    """What TINY says."""
    return getattr(commands.parse("teacher train", TINY), "config")  # noqa: B009


def leaves(state: learner.LearnerState) -> dict[str, np.ndarray]:
    """Every array of a learner by name."""
    return {
        jax.tree_util.keystr(path): np.asarray(leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(state)
    }


def saved(run_dir: Path) -> dict[str, np.ndarray]:
    """The newest checkpoint of a run of TINY, whatever devices made it."""
    env = AutoReset(GraspEnv(ppo_train.training_world(config())))
    with Checkpoints(run_dir / "teacher" / ppo_train.CHECKPOINTS) as checkpoints:
        return leaves(ppo_train.restore(config(), env, checkpoints))


def main(directory: Path) -> None:
    """Trains, evaluates, saves."""
    env = AutoReset(GraspEnv(ppo_train.training_world(config())))
    iterate = ppo_train.compile_iteration(config(), env)
    state = ppo_train.initial(config(), env)()
    for _ in range(ITERATIONS):
        state, _, _ = iterate(state)
    np.savez(directory / "state.npz", **leaves(state))  # pyright: ignore[reportArgumentType]
    shares = {leaf.sharding.shard_shape(leaf.shape)[0] for leaf in jax.tree.leaves(state.env_state)}
    report = {
        "devices": jax.device_count(),
        "shares": sorted(shares),
        "batches": sorted(env.env.physics._batches),  # pyright: ignore[reportAttributeAccessIssue]
        "evaluation": evaluate(GraspEnv(config().world), ppo_train.policy_of(state), 12, seed=20_000),
    }
    (directory / "report.json").write_text(json.dumps(report))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
