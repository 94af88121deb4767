"""Recordings as training arrays: noisy depth in diffusion space and its prior, at the generator's size."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddg_jax import normalise
from ddg_jax.prior import Prior
from ddgrasp.config import DDGConfig
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from sensors.recordings import Recording, find_recordings


@dataclass(frozen=True)
class Frames:
    """Frames of several recordings, one after the other.

    depth_m (N, H, W) float32, 0 = hole; prior (N, H, W) float16; recording (N,) int: which one a frame is
    from.
    """

    depth_m: np.ndarray
    prior: np.ndarray
    recording: np.ndarray
    skipped: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.depth_m)

    def part(self, chosen: slice | np.ndarray) -> "Frames":
        """The chosen frames."""
        return Frames(self.depth_m[chosen], self.prior[chosen], self.recording[chosen], self.skipped)

    def split(self, holdout_fraction: float) -> tuple["Frames", "Frames"]:
        """(training, held-out) frames: the held-out ones are the last, at least one."""
        held = max(1, round(len(self) * holdout_fraction))
        if held >= len(self):
            raise UserError(
                f"{len(self)} frame(s) cannot be split: the generator needs 2 or more; record more."
            )
        return self.part(slice(0, len(self) - held)), self.part(slice(len(self) - held, len(self)))


def load_frames(
    root: Path, config: DDGConfig, prior: Prior, seed: int, progress: Progress, max_frames: int | None = None
) -> Frames:
    """Every readable frame of the recordings at or below `root` (at most `max_frames`), with its prior.

    Raises UserError if there is no recording or one is refused (see sensors/recordings.py).
    """
    depth, priors, index, skipped, left = [], [], [], [], max_frames
    recordings = find_recordings(root)
    for number, recording in enumerate(progress.track(recordings, "reading recordings")):
        if recording.skipped:
            skipped.append(recording.skipped_summary())
            progress.note(recording.skipped_summary())
        count = len(recording) if left is None else min(left, len(recording))
        if count == 0:
            break
        frames = read_depth(recording, count, config)
        rgb = np.stack([recording.rgb(i) for i in range(count)]) if prior.needs_rgb else None
        priors.append(
            prior.from_recording(frames, rgb, np.random.default_rng((seed, number))).astype(np.float16)
        )
        depth.append(frames)
        index.append(np.full(count, number))
        left = None if left is None else left - count
    return Frames(np.concatenate(depth), np.concatenate(priors), np.concatenate(index), tuple(skipped))


def read_depth(recording: Recording, count: int, config: DDGConfig) -> np.ndarray:
    """The first `count` frames in metres at the generator's size, (count, H, W) float32, 0 = hole."""
    size = (config.height_px, config.width_px)
    return np.stack([resize_nearest(recording.depth_m(i), size) for i in range(count)])


def resize_nearest(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(H, W) -> `size` by nearest neighbours after a centred crop to the target's aspect ratio.

    Nothing is interpolated: a hole stays a hole, a depth stays a measured depth.
    """
    height, width = image.shape[:2]
    scale = min(height / size[0], width / size[1])
    rows = (np.arange(size[0]) + 0.5) * scale + (height - size[0] * scale) / 2
    columns = (np.arange(size[1]) + 0.5) * scale + (width - size[1] * scale) / 2
    return image[np.ix_(rows.astype(int), columns.astype(int))]


@dataclass(frozen=True)
class Batch:
    """x_0 (B, H, W) in diffusion space, c (B, H, W), float32."""

    x_0: np.ndarray
    c: np.ndarray


def make_batch(frames: Frames, config: DDGConfig, seed: int, step: int) -> Batch:
    """The training batch of `step`: random frames, half of them upside down, their prior jittered.

    A function of (seed, step) alone, so that a resumed run sees the batches an uninterrupted one would.
    Frames are never mirrored left to right: stereo shadows lie on one side.
    """
    rng = np.random.default_rng((seed, step))
    chosen = rng.integers(len(frames), size=config.batch_size)
    depth_m, c = frames.depth_m[chosen], frames.prior[chosen].astype(np.float32)
    flip = rng.random(config.batch_size) < 0.5
    depth_m[flip], c[flip] = depth_m[flip, ::-1], c[flip, ::-1]
    scale, shift = rng.uniform(-config.prior_jitter, config.prior_jitter, (2, config.batch_size, 1, 1))
    c = ((1 + scale) * c + shift).astype(np.float32)
    return Batch(_to_diffusion(depth_m, config), c)


def _to_diffusion(depth_m: np.ndarray, config: DDGConfig) -> np.ndarray:
    return np.asarray(normalise.to_diffusion(depth_m, config.near_m, config.far_m))
