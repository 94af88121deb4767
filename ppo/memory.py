"""More environments than memory: said before training starts, with the size, not by a killed process."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace

import jax
import mujoco

from ddgrasp import contract
from ddgrasp.config import GUIDE, Config, TeacherConfig
from ddgrasp.errors import UserError
from learning.memory import Need, compiled_bytes, device_limit, host_bytes, nbytes
from mjx_envs.grasp_env import AutoReset
from ppo import learner, warmup

EXPERIENCE_COPIES = 5
"""Copies of an iteration's experience at its peak: 41 kB an environment, where 20 steps are 8 kB (XLA's own
analysis on a CPU, 512 and 4096 environments)."""
CLONE_COPIES = 2
"""Copies of a round's batches: as they are drawn, and as the program's arguments."""
_SIGNS = ("RESOURCE_EXHAUSTED", "Out of memory", "MemoryError", "out of memory")


def check(config: Config, env: AutoReset) -> Need:
    """What the environments and their experience take; UserError if they, or what the guide is cloned on,
    cannot fit. Allocates and compiles nothing."""
    teacher = config.teacher
    clone = _check_clone(teacher)
    state = jax.eval_shape(lambda key: learner.init(teacher, env, key), jax.random.PRNGKey(0)).env_state
    step = 2 * state.obs.size + teacher.num_envs * (2 * env.env.action_size + 4)  # floats in a transition
    per_batch = 3 * nbytes(state) + EXPERIENCE_COPIES * teacher.unroll_steps * step * 4
    needed = _compare(config, env, per_batch // env.mesh.size)
    return replace(needed, host=max(needed.host, clone))  # one after the other


def _check_clone(teacher: TeacherConfig) -> int:
    """Bytes of the batches of a round, all drawn before its first step (`ppo.warmup`), 0 where nothing is
    cloned; UserError if they cannot fit."""
    if teacher.start != GUIDE:
        return 0
    numbers = contract.OBSERVATION_SIZE + contract.ACTION_SIZE
    needed = CLONE_COPIES * teacher.clone_steps * warmup.BATCH * numbers * 4
    if needed > (free := host_bytes()):
        raise UserError(
            f"teacher.clone_steps {teacher.clone_steps} needs about {needed / 1e9:.1f} GB of memory on the "
            f"host, which has {free / 1e9:.1f} GB for it: lower it, or take more teacher.clone_rounds."
        )
    return needed


def check_compiled(config: Config, env: AutoReset, compiled: jax.stages.Compiled) -> None:
    """UserError if the compiled iteration needs more than there is, by XLA's own analysis."""
    if (needed := compiled_bytes(compiled)) is not None:
        _compare(config, env, needed)


@contextlib.contextmanager
def explained(config: Config) -> Iterator[None]:
    """Turns what JAX, the engine or the host say when memory runs out into a UserError."""
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        text = f"{type(error).__name__}: {error}"
        if not any(sign in text for sign in _SIGNS):
            raise
        reason = next(line for line in text.splitlines() if any(sign in line for sign in _SIGNS))
        raise UserError(
            f"teacher.num_envs {config.teacher.num_envs} does not fit in memory ({reason[:200]}): {_REMEDY}."
        ) from error


_REMEDY = "lower teacher.num_envs or teacher.unroll_steps, or use more devices"


def _compare(config: Config, env: AutoReset, device_bytes: int) -> Need:
    """What is needed, `device_bytes` on each device of the mesh; UserError if there is less."""
    local = env.mesh.local_devices
    share = config.teacher.num_envs // env.mesh.size * len(local)
    engine = share * mujoco.mj_sizeModel(env.env.mj_model) if config.world.backend == "cpu" else 0
    demands = [("host", engine, host_bytes())]
    if (limit := device_limit(local[0])) is not None:
        demands.append((f"device {local[0].device_kind}", device_bytes, limit))
    else:
        demands = [("host", engine + device_bytes * len(local), host_bytes())]
    for place, needed, free in demands:
        if needed > free:
            raise UserError(
                f"teacher.num_envs {config.teacher.num_envs} needs about {needed / 1e9:.1f} GB of memory on "
                f"the {place}, which has {free / 1e9:.1f} GB for it: {_REMEDY}."
            )
    return Need("teacher", device_bytes, engine)
