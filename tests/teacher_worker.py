"""Trains a tiny teacher in a process of its own, on the devices that its environment gives it.

    python teacher_worker.py DIRECTORY

Leaves the whole learner by name in DIRECTORY/state.npz, and in DIRECTORY/report.json how it lay on the
devices and what was measured.
"""

import json
import sys
from pathlib import Path

import jax
import numpy as np

from ddgrasp.config import Config, TeacherConfig, WorldConfig
from mjx_envs.grasp_env import AutoReset, GraspEnv
from ppo import learner
from ppo import train as ppo_train
from ppo.evaluate import evaluate

TEACHER = TeacherConfig(
    total_steps=4 * 16 * 4, num_envs=16, unroll_steps=4, minibatches=2, epochs=2, hidden=(16,),
    eval_every=100, checkpoint_every=2, pregrasp_share=0.0, clone_rounds=0, critic_warmup=0, learning_rate=1e-3,
)  # fmt: skip
CONFIG = Config("test", world=WorldConfig(episode_steps=6), teacher=TEACHER)
TRIALS = 12
"""No multiple of eight."""


def leaves(state) -> dict[str, np.ndarray]:
    """Every array of a learner by name."""
    return {
        jax.tree_util.keystr(path): np.asarray(leaf)
        for path, leaf in jax.tree_util.tree_leaves_with_path(state)
    }


def main(directory: Path) -> None:
    """Trains, evaluates, saves, prints."""
    env = AutoReset(GraspEnv(ppo_train.training_world(CONFIG)))
    iterate = ppo_train.compile_iteration(CONFIG, env)
    state = ppo_train.initial(CONFIG, env)()
    for _ in range(learner.iterations(TEACHER)):
        state, metrics, _ = iterate(state)
    result = evaluate(GraspEnv(CONFIG.world), ppo_train.policy_of(state), TRIALS, seed=5)
    np.savez(directory / "state.npz", **leaves(state))
    shares = {leaf.sharding.shard_shape(leaf.shape)[0] for leaf in jax.tree.leaves(state.env_state)}
    report = {
        "devices": jax.device_count(), "shares": sorted(shares), "batches": sorted(env.env.physics._batches),
        "metrics": {name: float(value) for name, value in metrics.items()}, "evaluation": result,
    }  # fmt: skip
    (directory / "report.json").write_text(json.dumps(report))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
