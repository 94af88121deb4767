"""Stage `teacher`: world -> PPO policy on the privileged state."""

import shutil

import jax

from ddgrasp import artifacts
from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.files import atomic_path
from ddgrasp.install import pip_install
from ddgrasp.job import Job
from learning.memory import Need
from mjx_envs import devices
from mjx_envs.grasp_env import AutoReset, GraspEnv
from ppo import hosts, learner, memory
from ppo import policy as teacher_policy
from ppo.evaluate import evaluate
from ppo.train import train, training_world

_TEST_SEED = 20_000


def check(config: Config) -> Need | None:
    """What training the teacher takes, None where one is only loaded; takes a second and changes nothing.

    UserError if it cannot be trained so, or not on these devices.
    """
    if _loads(config):
        return None
    episode = config.world.episode_steps
    if config.teacher.unroll_steps > episode:  # an environment has one episode ready (`AutoReset`)
        raise config.teacher.error("unroll_steps", f"1 to {episode} (world.episode_steps)")
    if config.teacher.starts_from_file:
        learner.check_start(config.teacher, teacher_policy.load_state(config.teacher.start))
    mesh = devices.make_mesh()
    learner.check_divisible(config.teacher, mesh.size)
    return memory.check(config, AutoReset(GraspEnv(training_world(config)), mesh))


def run(job: Job) -> Artifact:
    """Trains a teacher (or loads one, `config.teacher.start`) and evaluates it, in every process."""
    config, directory = job.config, job.directory
    path = directory / teacher_policy.PARAMS_FILE
    hosts.wait_for_all("teacher begins")
    if not _loads(config):
        if slow := slow_engine(config, jax.default_backend()):
            job.progress.note(slow)
        train(config, directory, job.progress)
    elif hosts.leads():
        with atomic_path(path) as temporary:
            shutil.copyfile(teacher_policy.find(config.teacher.start), temporary)
    hosts.wait_for_all("teacher is written")
    policy = teacher_policy.load(directory)
    metrics = evaluate(GraspEnv(config.world), policy, config.evaluation.teacher_trials, _TEST_SEED)
    if hosts.leads():
        job.finish(metrics, origin="loaded" if _loads(config) else "trained")
    hosts.wait_for_all("teacher is finished")
    return artifacts.read_artifact(directory)


def slow_engine(config: Config, platform: str) -> str:
    """What to say of MJX-JAX where JAX's `platform` is a CPU, as it is where a GPU's JAX is not installed."""
    if config.world.backend != "jax" or platform != "cpu":
        return ""
    return (
        f"JAX has no accelerator here: MJX steps {config.teacher.num_envs} environments on this machine's "
        f"cores. {pip_install('cuda')} is for an NVIDIA GPU with a driver for CUDA 13; --world.backend cpu "
        "is many times faster here."
    )


def _loads(config: Config) -> bool:
    return config.teacher.starts_from_file and config.teacher.total_steps == 0
