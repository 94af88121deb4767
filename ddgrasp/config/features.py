"""The depth feature extractor that scores use."""

from dataclasses import dataclass
from typing import Annotated

from ddgrasp.config.checks import Batch, Count, LearningRate, Pixels, Range, Section, Seed, Steps


@dataclass(frozen=True)
class DepthFeatureConfig(Section, name="features"):
    """Training of the depth feature extractor (foundation/depth_feature_training.py)."""

    seed: Seed = 0
    """Seed of rooms, cameras, corruptions and initial weights."""
    devices: Annotated[int, Range(2, 100000)] = 96
    """Random cameras; the last eighth of them is kept for testing."""
    pictures: Count = 24
    """Random rooms seen by each camera."""
    width_px: Pixels = 320
    """Width of the pictures; the frozen extractor's is 320."""
    steps: Steps = 800
    """Optimiser steps."""
    batch_size: Batch = 24
    """Maps per step."""
    learning_rate: LearningRate = 1e-3
    """Adam's step size after the warm-up; falls to nothing along a cosine."""
    checkpoint_every: Count = 100
    """Steps between checkpoints."""
