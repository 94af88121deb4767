"""Stage `teacher`: world -> PPO policy on the privileged state."""

import shutil
from pathlib import Path

from ddgrasp import artifacts
from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.progress import Progress
from mjx_envs.grasp_env import GraspEnv
from ppo import policy as teacher_policy
from ppo.evaluate import evaluate
from ppo.train import train

STAGE = "teacher"
_TEST_SEED = 20_000


def run(config: Config, run_dir: Path, *, resume: bool, progress: Progress) -> Artifact:
    """Trains a teacher (or loads one, `config.teacher.init_from`) and evaluates it."""
    directory = run_dir / STAGE
    path = directory / teacher_policy.PARAMS_FILE
    loads = bool(config.teacher.init_from) and config.teacher.total_steps == 0
    if loads:
        policy = teacher_policy.load(config.teacher.init_from)
        with artifacts.atomic_path(path) as temporary:
            shutil.copyfile(teacher_policy.find(config.teacher.init_from), temporary)
    else:
        train(config, directory, progress)
        policy = teacher_policy.load(directory)
    metrics = evaluate(GraspEnv(config.world), policy, config.evaluation.teacher_trials, _TEST_SEED)
    return artifacts.finish(
        directory, STAGE, config, seconds=progress.seconds, metrics=metrics,
        origin="loaded" if loads else "trained",
    )  # fmt: skip
