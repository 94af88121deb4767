"""Recordings as training arrays: noisy depth in diffusion space and its prior, at the generator's size."""

import math
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import jax
import numpy as np
from jaxtyping import Bool, Float16, Float32, Int

from ddg_jax.geometry import UsableFrames, understand
from ddg_jax.prior import Prior
from ddg_jax.representation import encode
from ddgrasp import artifacts
from ddgrasp.config import DDGConfig
from ddgrasp.depth import crop_nearest, window
from ddgrasp.errors import UserError
from ddgrasp.progress import Progress
from learning import memory
from sensors.recordings.recording import (
    META_FILE,
    Recording,
    depth_picture_count,
    find_recordings,
    recording_folders,
    unfinished,
)

LEAST_KEPT = 0.98
"""Share of a frame below which it is said that the generator sees a window of it."""


@dataclass(frozen=True)
class Frames:
    """Frames of several recordings, one after the other.

    What could not be used: frames without a valid pixel or damaged; whole recordings.
    """

    depth_m: Float32[np.ndarray, "N H W"]
    """0 = hole."""
    surface_m: Float32[np.ndarray, "N H W"]
    """What it would be without the sensor's artefacts, as far as it shows itself (`surfaces`)."""
    prior: Float16[np.ndarray, "N H W"]
    recording: Int[np.ndarray, " N"]
    """Which one a frame is from."""
    skipped_frames: int = 0
    refused_recordings: int = 0
    apart: frozenset[int] = frozenset()
    """Recordings, as `recording` counts them, whose frames do not follow each other."""

    def __len__(self) -> int:
        return len(self.depth_m)

    def part(self, chosen: slice | Int[np.ndarray, " n"] | Bool[np.ndarray, " N"]) -> "Frames":
        """The chosen frames."""
        return replace(
            self,
            depth_m=self.depth_m[chosen],
            surface_m=self.surface_m[chosen],
            prior=self.prior[chosen],
            recording=self.recording[chosen],
        )

    @property
    def number(self) -> Int[np.ndarray, " N"]:
        """(N,) number of each frame within its recording, as far as it is here."""
        first = np.searchsorted(self.recording, self.recording)
        return np.arange(len(self)) - first

    @property
    def stretch(self) -> Int[np.ndarray, " N"]:
        """(N,) the same number for frames that follow each other: a recording's, or the frame's own."""
        alone = np.isin(self.recording, list(self.apart))
        return np.where(alone, -1 - np.arange(len(self)), self.recording)

    def split(self, holdout_fraction: float) -> tuple["Frames", "Frames"]:
        """(training, held-out) frames: the held-out ones are the last (`held_out_count`)."""
        held = held_out_count(np.unique(self.recording, return_counts=True)[1], holdout_fraction)
        return self.part(slice(0, len(self) - held)), self.part(slice(len(self) - held, len(self)))


def held_out_count(lengths: Int[np.ndarray, " R"], holdout_fraction: float) -> int:
    """How many frames, the last ones, are held out of recordings of so many frames: at least one.

    Whole recordings where that is half to one and a half times as many as asked for, since the frames of one
    resemble each other; otherwise the last part of one. UserError if none is left to fit on.
    """
    total = int(lengths.sum())
    asked = max(1, round(total * holdout_fraction))
    if asked >= total:
        raise UserError(
            f"ddg.training.holdout_fraction {holdout_fraction:g} of {total} frame(s) leaves none to fit on: "
            "record more, or hold out less."
        )
    whole = np.cumsum(lengths[:0:-1])
    near = whole[np.abs(whole - asked) <= asked / 2]
    return int(near[np.argmin(np.abs(near - asked))]) if len(near) else asked


def frames_bytes(config: DDGConfig, count: int) -> int:
    """Bytes of the arrays of `Frames` with `count` frames, and of the priors a second time as they are put
    together. To read them takes no more, with a built-in prior, but for a recording or two in each process
    that helps."""
    return count * config.depth.height_px * config.depth.width_px * (4 + 4 + 2 + 2)


def load_frames(
    root: Path | str,
    config: DDGConfig,
    prior: Prior,
    seed: int,
    progress: Progress,
    max_frames: int | None = None,
) -> Frames:
    """The usable frames of the recordings at or below `root`, with their priors.

    Of their first `max_frames` alone; those that cannot be used count towards it, and none behind them is
    read instead. Names what it leaves out, and says at the end how much that was. Raises UserError if there
    is no recording, none can be used, they are of another contract version
    (sensors/recordings/recording.py), or memory is too small for them, before any is read.
    """
    root = Path(root)
    return _loaded(root, _folders(root), config, prior, seed, progress, max_frames)


def load_held_out(root: Path, config: DDGConfig, prior: Prior, seed: int, progress: Progress) -> Frames:
    """The held-out frames alone, for a generator that is not fitted. Where every picture can be used, those
    of the other recordings are looked at and let go; where not, which ones are held out shows in the reading.
    """
    folders, fraction = _folders(root), config.training.holdout_fraction
    lengths = _lengths_if_whole(folders, config, prior)
    if lengths is None:
        return load_frames(root, config, prior, seed, progress).split(fraction)[1]
    held = held_out_count(lengths, fraction)
    first = len(folders) - 1 - int(np.flatnonzero(np.cumsum(lengths[::-1]) >= held)[0])
    try:
        frames = _loaded(root, folders[first:], config, prior, seed, progress, first_number=first)
    except UserError:
        frames = None  # the last recordings are not for this prior
    if frames is None or frames.skipped_frames or frames.refused_recordings:
        return load_frames(root, config, prior, seed, progress).split(fraction)[1]
    return frames.part(slice(-held, None))


def _lengths_if_whole(folders: list[Path], config: DDGConfig, prior: Prior) -> Int[np.ndarray, " R"] | None:
    """Frames of each recording; None if one of them, or one of its frames, cannot be used (`_read`)."""
    size, lengths = (config.depth.height_px, config.depth.width_px), []
    for folder in folders:
        try:
            recording = find_recordings(folder)[0]
        except UserError:
            return None
        if recording.skipped or recording.meta.get("repeated_frames"):
            return None
        if prior.needs_rgb and not recording.color_aligned:
            return None
        if not all(crop_nearest(recording.depth_mm(i), size).any() for i in range(len(recording))):
            return None
        lengths.append(len(recording))
    return np.array(lengths)


def _loaded(
    root: Path, folders: list[Path], config: DDGConfig, prior: Prior, seed: int, progress: Progress,
    max_frames: int | None = None, first_number: int = 0,
) -> Frames:  # fmt: skip
    """See `load_frames`; the recordings in `folders` count from `first_number`."""
    pictures = depth_picture_count(folders)
    host = frames_bytes(config, pictures if max_frames is None else min(pictures, max_frames))
    memory.check(memory.Need("ddg", 0, host, remedy="the number of recordings"), root)
    most = sys.maxsize if max_frames is None else max_frames
    for folder in unfinished(root):
        progress.note(f"left out: {folder} has no {META_FILE}, so it is unfinished or no recording")
    read, refused = _read_all(folders, config, prior, progress, most, first_number)
    noisy = _side_by_side(read)
    surface, c, useless = understand(read, noisy, config.depth.surface, prior, seed, progress)
    if useless and len(folders) == 1:
        raise useless[0][1]
    refused += [error for _, error in useless]
    if not (read := [r for r in read if r.number not in {number for number, _ in useless}]):
        raise UserError(
            f"{root}: none of its {len(folders)} recording(s) can be used. The first: {refused[0]}"
        )
    if (skipped := sum(r.left_out for r in read)) or refused:
        progress.note(f"left out {skipped} frame(s), and {len(refused)} of {len(folders)} recording(s)")
    _tell_of_sensors(read, progress)
    if useless:
        kept = np.concatenate([np.arange(len(noisy))[r.rows] for r in read])
        noisy, surface, c = noisy[kept], surface[kept], c[kept]
    index = np.concatenate([np.full(len(r.depth_m), r.number) for r in read])
    apart = frozenset(r.number for r in read if not r.consecutive)
    return Frames(noisy, surface, c, index, skipped, len(refused), apart)


def _side_by_side(read: Sequence[UsableFrames]) -> Float32[np.ndarray, "N H W"]:
    """All frames in one array, of which those of each recording are a part from then on."""
    if not read:
        return np.zeros((0, 0, 0), np.float32)
    if len(read) == 1:
        return read[0].depth_m
    all_m = np.concatenate([r.depth_m for r in read])
    first = 0
    for r in read:
        r.first = first
        r.depth_m = all_m[r.rows]
        first = r.rows.stop
    return all_m


def _read_all(
    folders: list[Path], config: DDGConfig, prior: Prior, progress: Progress, left: int, first_number: int
) -> tuple[list[UsableFrames], list[UserError]]:
    """Each recording that can be used, among the first `left` frames; why the others cannot."""
    read, refused, sizes = [], [], set()
    for number, folder in enumerate(progress.track(folders, "reading recordings"), first_number):
        if not left:
            break
        try:
            recording = find_recordings(folder)[0]
            count = min(left, len(recording))
            left -= count
            if (size := (recording.height_px, recording.width_px)) not in sizes:  # each crop is told once
                sizes.add(size)
                _tell_of_crop(recording, config, progress)
            read.append(_read(number, recording, count, config, prior, progress))
        except UserError as error:
            if len(folders) == 1:
                raise
            refused.append(error)
            progress.note(f"left out: {error}")
    return read, refused


def _tell_of_sensors(read: Sequence[UsableFrames], progress: Progress) -> None:
    sensors = Counter(r.sensor for r in read)
    if len(sensors) > 1:
        progress.note(
            "recordings of several sensors, which one generator will mix: "
            + ", ".join(f"{name} ({count})" for name, count in sorted(sensors.items()))
        )


def _folders(root: Path) -> list[Path]:
    """Recordings at or directly below `root`, by name; `root` itself, for its error, if there are none."""
    if (root / artifacts.MANIFEST).exists():
        artifacts.read_manifest(root)
    return (recording_folders(root) if root.is_dir() else []) or [root]


def _read(
    number: int, recording: Recording, count: int, config: DDGConfig, prior: Prior, progress: Progress
) -> UsableFrames:
    """The usable ones of the first `count` frames, at the generator's size."""
    if recording.skipped:
        progress.note(recording.skipped_summary())
    if prior.needs_rgb and not recording.color_aligned:
        raise UserError(
            f"{recording.path}: colour is not aligned to depth, which ddg.prior.source {prior.name} needs: "
            "align it when recording, or --ddg.prior.source inverse_depth."
        )
    size = (config.depth.height_px, config.depth.width_px)
    frames = np.stack([crop_nearest(recording.depth_m(i), size) for i in range(count)])
    seen = np.asarray((frames > 0).any(axis=(1, 2)))
    again = seen & [recording.repeats(i) for i in range(count)]
    if again.any():
        progress.note(f"{recording.path}: left out {again.sum()} frame(s) that came again")
    usable = np.flatnonzero(seen & ~again)
    blind = int((~seen).sum())
    if len(usable) == 0:
        raise UserError(
            f"{recording.path}: no frame has a valid pixel in the window that the generator sees."
        )
    if blind:
        progress.note(f"{recording.path}: left out {blind} frame(s) without a valid pixel in the window")
    rgb = _Colour(recording, usable) if prior.needs_rgb else None
    no_gap = bool(seen[usable[0] : usable[-1] + 1].all())  # a frame that came again is none
    left_out = len(recording.skipped) + len(frames) - len(usable)
    sensor = str(recording.meta.get("sensor", "unnamed"))
    return UsableFrames(number, frames[usable], rgb, recording.consecutive and no_gap, sensor, left_out)


class _Colour(Sequence[np.ndarray]):
    """Colour of some frames of a recording, each read when it is looked at: a long recording's would take
    more than all the rest."""

    def __init__(self, recording: Recording, frames: Int[np.ndarray, " T"]):
        self._recording, self._frames = recording, frames

    def __len__(self) -> int:
        return len(self._frames)

    @overload
    def __getitem__(self, index: int) -> np.ndarray: ...

    @overload
    def __getitem__(self, index: slice) -> Sequence[np.ndarray]: ...

    def __getitem__(self, index: int | slice) -> np.ndarray | Sequence[np.ndarray]:
        if isinstance(index, slice):
            return [self._recording.rgb(int(i)) for i in self._frames[index]]
        return self._recording.rgb(int(self._frames[index]))


def _tell_of_crop(recording: Recording, config: DDGConfig, progress: Progress) -> None:
    height, width = recording.height_px, recording.width_px
    rows, columns = config.depth.height_px, config.depth.width_px
    kept = math.prod(window((height, width), (rows, columns))) / (height * width)
    if kept < LEAST_KEPT:
        progress.note(
            f"{recording.path}: the generator sees {kept:.0%} of each {width}x{height} frame, a centred "
            f"window of {columns}:{rows}, the simulated camera's shape; --ddg.depth.height-px "
            f"{round(columns * height / width)} takes all of it"
        )


@dataclass(frozen=True)
class Batch:
    """What a training step learns from."""

    x_0: Float32[np.ndarray, "B H W C"]
    """See ddg_jax/representation.py."""
    c: Float32[np.ndarray, "B H W"]


def make_batch(frames: Frames, config: DDGConfig, seed: int, step: int) -> Batch:
    """The training batch of `step`: random frames, half of them upside down, their prior jittered.

    A network that knows where it is (`ddg.unet.position`) sees all of them upright.

    A function of (seed, step) alone, so that a resumed run sees the batches an uninterrupted one would.
    Frames are never mirrored left to right: stereo shadows lie on one side.
    """
    rng = np.random.default_rng((seed, step))
    chosen = rng.integers(len(frames), size=config.training.batch_size)
    flip = rng.random(config.training.batch_size) < (0.0 if config.unet.position else 0.5)
    depth_m, surface_m, c = (
        np.where(flip[:, None, None], values[chosen, ::-1], values[chosen])
        for values in (frames.depth_m, frames.surface_m, frames.prior)
    )
    scale, shift = rng.uniform(
        -config.prior.jitter, config.prior.jitter, (2, config.training.batch_size, 1, 1)
    )
    c = ((1 + scale) * c + shift).astype(np.float32)
    return Batch(np.asarray(encode_batch(config, depth_m, surface_m)), c)


encode_batch = jax.jit(encode, static_argnums=0)
"""`representation.encode` as one program."""
