"""What stops a teacher: numbers that are not finite, named by term, and batches larger than the memory."""

import dataclasses
import re
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from app.commands.checks import check_devices
from config_support import unchecked
from ddgrasp.config import Config, EvalConfig, RewardConfig, TeacherConfig, WorldConfig
from ddgrasp.errors import UserError
from ddgrasp.learnable import check_learnable
from ddgrasp.presets import PRESETS
from ddgrasp.progress import Progress
from learning.checkpoints import Checkpoints
from mjx_envs.grasp_env import AutoReset, GraspEnv
from ppo import health, memory, stage
from ppo import train as ppo_train
from ppo.warmup import guide_share

TEACHER = TeacherConfig(
    total_steps=6 * 8 * 2, num_envs=8, unroll_steps=2, minibatches=2, epochs=1, hidden=(16,), eval_every=100,
    checkpoint_every=1, pregrasp_share=0.0, start="nothing", critic_warmup=0,
)  # fmt: skip
CONFIG = Config(
    "test", world=WorldConfig(episode_steps=3), teacher=TEACHER, evaluation=EvalConfig(teacher_trials=2)
)


def _checkpoints(directory) -> Checkpoints:
    return Checkpoints(directory / ppo_train.CHECKPOINTS)


def test_the_guide_acts_first_and_not_at_last_unless_there_is_one_round():
    assert [[guide_share(i, rounds) for i in range(rounds)] for rounds in (1, 2, 4)] == [
        [1.0], [1.0, 0.0], [1.0, 0.5, 0.25, 0.0],
    ]  # fmt: skip


def test_mjx_on_cores_says_how_it_gets_a_gpu():
    paper, laptop = PRESETS["paper"], PRESETS["laptop"]
    assert paper.world.backend == "jax"
    told = stage.slow_engine(paper, "cpu")
    assert "MJX steps 8192 environments" in told and "[cuda]" in told and "--world.backend cpu" in told
    assert stage.slow_engine(paper, "gpu") == stage.slow_engine(laptop, "cpu") == ""


def test_an_absurd_learning_rate_stops_before_the_broken_state_is_saved(tmp_path):
    # the policy learns from the third iteration on
    teacher = unchecked(TEACHER, learning_rate=1e30, critic_warmup=2)
    config = dataclasses.replace(CONFIG, teacher=teacher)
    with pytest.raises(UserError, match="iteration 3: (loss|gradient|action)") as error:
        ppo_train.train(config, tmp_path, Progress(quiet=True))
    message = str(error.value)
    assert "\n" not in message
    assert "The checkpoint of iteration 2 is sound: --resume" in message
    assert "lower teacher.learning_rate" in message
    env = AutoReset(GraspEnv(ppo_train.training_world(config)))
    with _checkpoints(tmp_path) as manager:
        assert manager.latest == 2
        kept = ppo_train.restore(config, env, manager)
    for leaf in jax.tree.leaves(kept):
        assert np.all(np.isfinite(np.asarray(leaf)))


def test_a_reward_beyond_all_numbers_is_named_and_nothing_is_saved(tmp_path):
    world = dataclasses.replace(CONFIG.world, reward=unchecked(RewardConfig(), accel=3e38))
    with pytest.raises(
        UserError, match=r"iteration 1: reward/accel is -inf\. Nothing was saved yet"
    ) as error:
        ppo_train.train(dataclasses.replace(CONFIG, world=world), tmp_path, Progress(quiet=True))
    assert "lower the weight of that term under world.reward" in str(error.value)
    with _checkpoints(tmp_path) as manager:
        assert manager.latest is None


def test_the_cause_is_named_before_what_it_spoils():
    spoilt = {name: jnp.float32(np.nan) for name in ("state/params", "gradient/policy", "loss/v_loss")}
    with pytest.raises(UserError, match="iteration 7: loss/v_loss is nan"):
        health.check(7, spoilt | {"reward/lift": jnp.float32(1.0)}, 5, "runs/x")
    with pytest.raises(UserError, match="reward/lift is inf"):
        health.check(7, spoilt | {"reward/lift": jnp.float32(np.inf)}, 5, "runs/x")


def test_every_part_of_the_observation_is_watched():
    for index, part in ((0, "joint_position"), (17, "joint_velocity"), (24, "hand_pose"), (39, "category")):
        observation = jnp.zeros((3, 40)).at[1, index].set(jnp.nan)
        watched = health.watch(observation, jnp.zeros((3, 8)), {}, SimpleNamespace())
        assert [name for name, x in watched.items() if not np.isfinite(x)] == [f"observation/{part}"]


def test_more_environments_than_memory_are_refused_with_the_size():
    teacher = dataclasses.replace(TEACHER, num_envs=2**30)
    with pytest.raises(
        UserError, match=r"num_envs 1073741824 needs about \d+\.\d GB .* lower teacher.num_envs"
    ):
        stage.check(dataclasses.replace(CONFIG, teacher=teacher))


def test_what_training_takes_is_told_before_and_of_a_loaded_teacher_nothing(tmp_path, capsys):
    check_devices(CONFIG, tmp_path)
    told = capsys.readouterr().err
    assert re.fullmatch(r"teacher: about \d+ MB for its programs, \d+ MB of arrays\n", told), told
    loaded = dataclasses.replace(TEACHER, start="pretrained/teacher", total_steps=0)
    check_devices(dataclasses.replace(CONFIG, teacher=loaded), tmp_path)
    assert capsys.readouterr().err == ""


def test_more_gradient_steps_than_can_be_counted_are_refused():
    """Or --teacher.total-steps 1000000000000, to stop it by hand, ends in JAX's OverflowError."""
    with pytest.raises(
        UserError, match=r"000 makes 97656250 iterations, .* 3125000000 gradient steps; expected at most 2147"
    ):
        TeacherConfig(total_steps=10**12)
    assert TeacherConfig(total_steps=10**12, num_envs=4096).iterations == 12_207_031


def test_more_batches_of_cloning_than_memory_are_refused_by_their_own_name():
    """They are drawn at once; what MemoryError was told of them was to lower teacher.num_envs."""
    many = dataclasses.replace(TEACHER, start="guide", clone_steps=10**7)
    with pytest.raises(
        UserError, match=r"clone_steps 10000000 needs about 3932\.2 GB .* teacher.clone_rounds"
    ):
        stage.check(dataclasses.replace(CONFIG, teacher=many))
    for teacher in (dataclasses.replace(many, start="nothing"), dataclasses.replace(many, clone_steps=500)):
        memory._check_clone(teacher)


def test_minibatches_of_one_step_are_refused():
    """PPO divides advantages by their deviation, less their mean: of one nothing is left."""
    teacher = dataclasses.replace(TEACHER, num_envs=2, unroll_steps=1)
    config = dataclasses.replace(CONFIG, world=WorldConfig())
    with pytest.raises(UserError, match="2 of 2 environments' unroll_steps 1 are one control step each"):
        check_learnable(dataclasses.replace(config, teacher=teacher))
    for values in ({"unroll_steps": 2}, {"minibatches": 1}, {"start": "pretrained", "total_steps": 0}):
        check_learnable(dataclasses.replace(config, teacher=dataclasses.replace(teacher, **values)))


def test_a_program_larger_than_memory_is_refused_before_it_runs():
    env = AutoReset(GraspEnv(CONFIG.world))
    small, large = (jax.jit(lambda n=n: jnp.zeros((n, 2**20))).lower().compile() for n in (1, 2**25))
    memory.check_compiled(CONFIG, env, small)
    with pytest.raises(UserError, match=r"needs about 1407\d\d\.\d GB"):  # 2^45 floats
        memory.check_compiled(CONFIG, env, large)


@pytest.mark.parametrize("library", [np, jnp])
def test_memory_that_ran_out_is_told_in_one_line(library):
    with pytest.raises(UserError, match="num_envs 8 does not fit in memory") as error:
        with memory.explained(CONFIG):
            np.asarray(library.ones(2**47))
    assert "\n" not in str(error.value)


def test_other_errors_pass():
    with pytest.raises(RuntimeError, match="something else"), memory.explained(CONFIG):
        raise RuntimeError("something else")
