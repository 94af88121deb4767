"""What perception reports of all frames, which the action head learns from last."""

from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from ddgrasp.config import (
    Config,
    EncoderConfig,
    HandViewConfig,
    HeadConfig,
    PictureConfig,
    StudentConfig,
    StudentTrainingConfig,
    WorldConfig,
)
from ddgrasp.progress import Progress
from learning.params import save_params
from student_jax import head, train
from student_jax.data import Frames, make_frames, random_crops, sharpen_gripper
from student_jax.policy import HEAD_PARAMS, Aux, Seen, feature_count, init_params

CONFIG = Config(
    preset="test",
    seed=3,
    world=WorldConfig(camera_scale=0.125),
    student=StudentConfig(
        picture=PictureConfig(height_px=32, width_px=40),
        encoder=EncoderConfig(width=8, keypoints=4, stage_blocks=(1, 1), features=16),
        head=HeadConfig(width=16, blocks=1, state_features=8),
        hand_view=HandViewConfig(size_px=8, width=8, blocks=1, channels=2, features=8),
        training=StudentTrainingConfig(crop_shift_px=2, disparity_noise_px=0.0),
    ),
)
PROFILE = CONFIG.world.profile


def frames_of(lengths: tuple[int, ...]) -> Frames:
    """Episodes of random numbers."""
    rng = np.random.default_rng(0)
    return make_frames(
        [
            rng.integers(400, 1500, (n, PROFILE.height_px, PROFILE.width_px)).astype(np.uint16)
            for n in lengths
        ],
        *([rng.normal(size=(n, width)) for n in lengths] for width in (8, 8, 40)),
        [rng.random(n) > 0.5 for n in lengths],
    )


def test_features_in_batches_are_those_of_all_frames_at_once():
    """70 frames in batches of 64: the second one is filled up, and none of that is kept."""
    frames, params = frames_of((40, 30)), init_params(jax.random.key(0), CONFIG.student, PROFILE)
    seen = head._encode_all(CONFIG, params, frames, np.random.default_rng(7), Progress(quiet=True))
    rng, index = np.random.default_rng(7), np.arange(70)
    crops = np.concatenate([random_crops(rng, 64, PROFILE, 2) for _ in range(2)])[:70]
    assert len(np.unique(crops, axis=0)) > 10
    given = frames.depth_stack(index), frames.state, crops
    once = train.encode(CONFIG.student, PROFILE, params, *given)
    for ours, theirs in zip(jax.tree.leaves(seen), jax.tree.leaves(once), strict=True):
        assert len(ours) == 70
        np.testing.assert_allclose(ours, theirs, atol=1e-5)
    assert len(np.unique(np.asarray(seen.features), axis=0)) == 70


def test_every_batch_of_features_is_seen_under_noise_of_its_own(monkeypatch):
    keys = []

    def encode(student, profile, params, depth_mm, state, crops, key=None):
        keys.append(key)
        count = len(state)
        aux = Aux(np.zeros((count, 3)), np.zeros((count, 2)), np.zeros(count))
        return Seen(np.zeros((count, feature_count(student))), aux)

    monkeypatch.setattr(train, "encode", encode)
    head._encode_all(CONFIG, {}, frames_of((40, 30)), np.random.default_rng(7), Progress(quiet=True))
    assert len({tuple(np.ravel(jax.random.key_data(key))) for key in keys}) == 2


def test_samples_of_both_kinds_are_joined_column_by_column():
    a, b = (_samples(frames, number) for number, frames in enumerate((frames_of((4,)), frames_of((2, 3)))))
    joined = head._join(a, b)
    for both, first, second in zip(*map(jax.tree.leaves, (joined, a, b)), strict=True):
        assert both.shape == (9, *first.shape[1:])
        np.testing.assert_array_equal(both[:4], first)
        np.testing.assert_array_equal(both[4:], second)


@pytest.mark.parametrize("with_poses", [False, True])
def test_what_the_head_learns_from_belongs_together_and_is_not_yet_held(tmp_path, monkeypatch, with_poses):
    """Not compiled: a frame's features are its number, and steps keep what they are given."""
    frames, samples = frames_of((40, 30)), []
    count = len(frames)
    aux = Aux(*(np.zeros((count, *size), np.float32) for size in ((3,), (2,), ())))
    features = np.arange(count, dtype=np.float32)[:, None].repeat(feature_count(CONFIG.student), 1)

    def step(config, steps, state, drawn):
        samples.append(drawn)
        return state.replace(ema=jax.tree.map(lambda x: 0 * x + 7, state.ema)), {"loss": jnp.zeros(())}

    monkeypatch.setattr(head, "_encode_all", lambda *_: Seen(features, aux))
    monkeypatch.setattr(head, "_step", step)
    training = replace(CONFIG.student.training, held_weight=1e-9)
    settings = replace(CONFIG.student.head, train_steps=3, batch_size=200, chunk=3)
    config = replace(CONFIG, student=replace(CONFIG.student, training=training, head=settings))
    poses = _save_poses(tmp_path / head.POSES) if with_poses else None
    params = {name: {"w": np.ones(2, np.float32)} for name in HEAD_PARAMS}
    made, _ = head.fit_on_perception(config, params, frames, tmp_path, Progress(quiet=True))
    for name in HEAD_PARAMS:
        np.testing.assert_array_equal(made[name]["w"], 7)  # the averaged ones
    assert len(samples) == 3
    first = 100 if with_poses else 200
    for seen, joints, chunks in samples:
        assert len(seen.features) == len(joints) == len(chunks) == 200
        _check_rows(frames, seen.features[:first, 0].astype(int), joints[:first], chunks[:first])
        if poses is not None:
            nearest = np.abs(joints[first:, None] - poses.state).sum(axis=2).argmin(axis=1)
            _check_rows(poses, nearest, joints[first:], chunks[first:])
            assert np.mean(seen.aux.held_logit[first:] < 0) > 0.9


def _check_rows(frames: Frames, index: np.ndarray, joints: np.ndarray, chunks: np.ndarray) -> None:
    assert len(np.unique(index)) > 20 and not frames.held[index].any()
    np.testing.assert_array_equal(joints, frames.state[index])
    np.testing.assert_array_equal(chunks, sharpen_gripper(frames.action_chunks(index, 3)))


def _save_poses(path: Path) -> Frames:
    """Pictureless episodes as the rounds on poses leave them."""
    rng, lengths = np.random.default_rng(1), (50, 30)
    columns = {name: rng.normal(size=(80, width)) for name, width in (("state", 8), ("action", 8))}
    columns |= {"observation": rng.normal(size=(80, 40)), "held": rng.random(80) > 0.5}
    columns = {name: values.astype(np.float32) for name, values in columns.items()}
    save_params(path, columns | {"lengths": np.array(lengths)})
    return make_frames([], *([part[:50], part[50:]] for part in columns.values()))


def _samples(frames: Frames, seed: int) -> head.Samples:
    config = replace(CONFIG, student=replace(CONFIG.student, head=replace(CONFIG.student.head, chunk=3)))
    return head._from_poses(config, frames, np.random.default_rng(seed), len(frames))
