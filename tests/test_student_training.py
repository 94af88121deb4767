"""Frames, labels, losses and the training plan of the student, by value."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddgrasp import contract
from ddgrasp.config import StudentConfig
from ddgrasp.errors import UserError
from student_jax import train
from student_jax.data import check_chunk, make_frames, random_crops, sharpen_gripper
from student_jax.policy import Aux

PROFILE = contract.D455.scaled(0.25)
CONFIG = StudentConfig(
    width=8, keypoints=4, stage_blocks=(1, 1), feature_size=16, denoiser_width=16, denoiser_blocks=1,
    state_features=8, chunk=2, execute_steps=1, batch_size=2, noise_draws=2,
)  # fmt: skip


def frames_of(lengths=(3, 2)):
    count = iter(range(100))
    columns = []
    for n in lengths:
        numbers = np.array([next(count) for _ in range(n)], np.float32)
        observation = np.zeros((n, 40), np.float32)
        observation[:, 25] = numbers
        observation[:, 36] = np.cos(0.1)  # quaternion of a hand turned by 0.2 rad, fingers down
        observation[:, 37] = np.sin(0.1)
        columns.append(
            (
                np.full((n, PROFILE.height_px, PROFILE.width_px), 700, np.uint16)
                + numbers[:, None, None].astype(np.uint16),
                np.repeat(numbers[:, None], 8, axis=1),
                np.repeat(numbers[:, None], 8, axis=1) / 10,
                observation,
                numbers > 1,
            )
        )
    return make_frames(*zip(*columns, strict=True))


def test_the_first_frame_is_repeated_and_episodes_do_not_mix():
    stack = frames_of().depth_stack(np.array([0, 2, 3, 4]))
    np.testing.assert_array_equal(
        stack[:, :, 0, 0], [[700, 700, 700], [700, 701, 702], [703, 703, 703], [703, 703, 704]]
    )


def test_chunks_repeat_an_episodes_last_label():
    chunks = frames_of().action_chunks(np.array([0, 2, 4]), 3)
    np.testing.assert_allclose(
        chunks[:, :, 0], [[0.0, 0.1, 0.2], [0.2, 0.2, 0.2], [0.4, 0.4, 0.4]], atol=1e-6
    )


def test_privileged_targets_come_from_the_observation():
    frames = frames_of()
    np.testing.assert_allclose(frames.position_m[:, 0], np.arange(5.0))
    np.testing.assert_allclose(frames.yaw[0], [np.cos(0.4), np.sin(0.4)], atol=1e-6)
    np.testing.assert_array_equal(frames.held, [0, 0, 1, 1, 1])


def test_frames_extend_with_shifted_episodes():
    both = frames_of().extend(frames_of((1,)))
    assert len(both) == 6 and both.episode.tolist() == [0, 0, 0, 1, 1, 2]
    np.testing.assert_array_equal(both.depth_stack(np.array([5]))[0, :, 0, 0], [700, 700, 700])


def test_gripper_labels_are_sharp():
    np.testing.assert_array_equal(sharpen_gripper(np.full((2, 8), 0.2))[:, 6:], [[0.2, 1.0], [0.2, 1.0]])
    assert sharpen_gripper(np.full((1, 8), -0.01))[0, 7] == -1.0


def test_crops_stay_within_the_shift():
    crops = random_crops(np.random.default_rng(0), 500, PROFILE, 3)
    away = crops - np.array(PROFILE.crop_origin_px)
    assert away.min() == -3 and away.max() == 3


def test_auxiliary_losses_by_hand():
    seen = Aux(jnp.array([[0.3, 0.0, 0.0]]), jnp.array([[1.0, 0.0]]), jnp.array([0.0]))
    target = Aux(jnp.array([[0.0, 0.0, 0.0]]), jnp.array([[0.0, 1.0]]), jnp.array([1.0]))
    losses = train.aux_losses(seen, target)
    assert float(losses["position"]) == pytest.approx(
        10 * 0.1 * (0.3 - 0.05) / 3, rel=1e-5
    )  # Huber, delta 0.1
    assert float(losses["yaw"]) == pytest.approx(1.0)
    assert float(losses["held"]) == pytest.approx(np.log(2), rel=1e-5)


def test_a_training_step_is_pure_and_learns():
    frames = frames_of((6, 6))
    rng = np.random.default_rng(0)
    batch = train.make_batch(frames, np.arange(8), rng, CONFIG, PROFILE)
    steps = 60
    fresh = lambda: train.init_state(CONFIG, PROFILE, steps, 0)  # noqa: E731
    one, first = train.train_step(CONFIG, PROFILE, steps, fresh(), batch)
    two, _ = train.train_step(CONFIG, PROFILE, steps, fresh(), batch)
    for a, b in zip(jax.tree.leaves(one.params), jax.tree.leaves(two.params), strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))
    state = fresh()
    for _ in range(steps):
        state, last = train.train_step(CONFIG, PROFILE, steps, state, batch)
    assert float(last["held"]) < 0.7 * float(first["held"])
    assert float(last["total"]) < 0.8 * float(first["total"])


def test_executing_more_than_a_chunk_is_refused():
    with pytest.raises(UserError, match=r"execute_steps is 3: expected 1 to student.chunk = 2"):
        check_chunk(dataclasses.replace(CONFIG, execute_steps=3))
