"""What perception reports of all frames, which the action head learns from last."""

from dataclasses import replace

import jax
import numpy as np

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
from student_jax import head, train
from student_jax.data import Frames, make_frames, random_crops
from student_jax.policy import init_params

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


def test_samples_of_both_kinds_are_joined_column_by_column():
    a, b = (_samples(frames, number) for number, frames in enumerate((frames_of((4,)), frames_of((2, 3)))))
    joined = head._join(a, b)
    for both, first, second in zip(*map(jax.tree.leaves, (joined, a, b)), strict=True):
        assert both.shape == (9, *first.shape[1:])
        np.testing.assert_array_equal(both[:4], first)
        np.testing.assert_array_equal(both[4:], second)


def _samples(frames: Frames, seed: int) -> head.Samples:
    config = replace(CONFIG, student=replace(CONFIG.student, head=replace(CONFIG.student.head, chunk=3)))
    return head._from_poses(config, frames, np.random.default_rng(seed), len(frames))
