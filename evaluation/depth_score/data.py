"""Frames on which generated depth is scored: rig trajectories that no stage trains on, or a camera's frames.

Two sides of different episodes. The real side gives depth as recorded. The simulated side gives clean
geometry, on which every method draws its depth; what the camera itself would have recorded there is kept too:
it is the real-vs-real floor, and the reference of paired measures. No method sees it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Int, UInt8, UInt16

from ddg_jax.network_prior import FEWEST_VALID
from ddgrasp import depth
from ddgrasp.config import PIECEWISE, Config
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_path, read_npz
from ddgrasp.progress import Progress
from ddgrasp.workers import spread, worth
from sensors.recordings.recording import Recording, find_recordings

REAL, SIM = SIDES = ("real", "sim")
MADE_ANEW = "delete it and run again with --resume"
"""What is to be done about a damaged file of the score."""
SEED_OFFSET = 1_000_000
"""Added to a trajectory's number in its seed: far from the numbers of recorded trajectories."""
BLOCK_FRAMES = 4
"""Frames of one side that a real camera's stream is cut into: neighbours say the same, so blocks are
resampled together."""
_RUN_FRAMES = len(SIDES) * BLOCK_FRAMES
"""Consecutive frames of a recording that a block of either side comes from."""


@dataclass(frozen=True)
class Episode:
    """Consecutive frames of one trajectory. Depth in millimetres, 0 = invalid / nothing there."""

    side: str
    number: int
    """Unique among both sides."""
    group: int
    """Episodes that show the same scene share it: they are never told apart from each other."""
    sensed_mm: UInt16[np.ndarray, "T H W"]
    clean_mm: UInt16[np.ndarray, "T H W"]
    repeats_mm: UInt16[np.ndarray, "K H W"]
    """The first frame sensed again and again, or K = 0."""
    rgb: UInt8[np.ndarray, "T h w 3"] | None
    """If some method needs colour."""
    focal_px: float
    baseline_m: float
    consecutive: bool = True
    """Whether the frames follow each other; otherwise each is a photo of its own."""

    def repeated(self) -> "Episode":
        """The episode of a world that stands still: the first frame, as often as it was sensed again."""
        count = len(self.repeats_mm)
        rgb = None if self.rgb is None else np.repeat(self.rgb[:1], count, 0)
        clean = np.repeat(self.clean_mm[:1], count, 0)
        return replace(self, sensed_mm=self.repeats_mm, clean_mm=clean, rgb=rgb)


# --- the rig -------------------------------------------------------------------------------------


def record_rig(
    config: Config, teacher: Path, directory: Path, with_rgb: bool, progress: Progress
) -> list[Path]:
    """Files of `config.score.trajectories` episodes per side, real first; those there already are kept.

    teacher: directory of the finished teacher stage.

    Raises UserError, before anything is recorded, if the generator has another aspect ratio than the camera.
    """
    from ddg_jax.sample import check_aspect

    check_aspect((config.world.profile.height_px, config.world.profile.width_px), config.ddg)
    names = [
        (side, directory / f"{side}_{i:04d}.npz") for side in SIDES for i in range(config.score.trajectories)
    ]
    missing = [(number, side, file) for number, (side, file) in enumerate(names) if not file.exists()]
    _check_colour([file for _, file in names if file.exists()], with_rgb)
    with progress.task("rig trajectories", len(names)) as task:
        task.start_at(len(names) - len(missing))
        for _ in _recorded(config, teacher, with_rgb, missing):
            task.advance()
    return [file for _, file in names]


def _check_colour(files: Sequence[Path], with_rgb: bool) -> None:
    """UserError if a trajectory was recorded while nothing needed colour, and something does now."""
    for file in files if with_rgb else ():
        if load_episode(file).rgb is None:
            raise UserError(
                f"{file} was recorded without colour, which the monocular network needs: delete "
                f"{file.parent.parent} to score with it, or take its weights away."
            )


def _recorded(
    config: Config, teacher: Path, with_rgb: bool, missing: Sequence[tuple[int, str, Path]]
) -> Iterator[None]:
    from rig.stage import FRAMES_A_PROCESS

    started = partial(_RigRecorder, config, teacher, with_rgb)
    count = len(missing)
    return spread(started, missing, worth(count * config.score.frames // FRAMES_A_PROCESS, count))


class _RigRecorder:
    """World and camera, made once, and the teacher that moves one episode after the other before them."""

    def __init__(self, config: Config, teacher: Path, with_rgb: bool):
        from ppo import policy as teacher_policy
        from rig.camera import make_camera
        from rig.world import make_world

        self._config, self._policy, self._with_rgb = config, teacher_policy.load(teacher), with_rgb
        self._world = make_world(config.world)
        self._camera = make_camera(config, self._world)

    def run(self, missing: tuple[int, str, Path]) -> None:
        """Records one of a number and side, into a file."""
        number, side, file = missing
        _save(file, self._episode(side, number))

    def close(self) -> None:
        """See `ddgrasp.workers.Worker`."""
        self._camera.close()

    def _episode(self, side: str, number: int) -> Episode:
        from rig.camera import jittered_pose
        from rig.stage import act

        config, world, camera, policy = self._config, self._world, self._camera, self._policy
        score, profile = config.score, config.world.profile
        rng = np.random.default_rng([config.seed, SEED_OFFSET + number])
        of_side = number % score.trajectories  # both sides show the same objects
        name = config.world.objects[of_side % len(config.world.objects)]
        world.reset(int(rng.integers(2**31)), name)
        T_world_cam = jittered_pose(config.record, rng)
        for _ in range(rng.integers(max(1, config.record.frames - score.frames + 1))):
            act(world, policy(world.observation()))
        repeated = side == SIM and number - score.trajectories < score.repeat_scenes
        repeats = [
            camera.depth_mm(world.data, T_world_cam, rng, name) for _ in range(repeated * score.repeats)
        ]
        sensed, clean, rgb = [], [], []
        for _ in range(score.frames):
            sensed.append(camera.depth_mm(world.data, T_world_cam, rng, name))
            clean.append(camera.clean_mm(world.data, T_world_cam))
            if self._with_rgb:
                rgb.append(camera.rgb(world.data, T_world_cam))
            act(world, policy(world.observation()))
        return Episode(
            side, number, number, np.stack(sensed), np.stack(clean),
            np.stack(repeats) if repeats else np.zeros((0, *sensed[0].shape), np.uint16),
            np.stack(rgb) if rgb else None, profile.fx_px, profile.baseline_m,
        )  # fmt: skip


def _save(file: Path, episode: Episode) -> None:
    arrays: dict[str, Any] = {name: value for name, value in vars(episode).items() if value is not None}
    with atomic_path(file) as path:
        np.savez_compressed(path, **arrays)


def load_episode(file: Path) -> Episode:
    """What `record_rig` wrote; UserError if the file is damaged."""
    arrays = read_npz(file, MADE_ANEW)
    return Episode(**{"rgb": None, **{name: a.item() if a.ndim == 0 else a for name, a in arrays.items()}})


# --- a real camera -------------------------------------------------------------------------------


@dataclass(frozen=True)
class RealFrames:
    """The last frames of a camera, in time order."""

    total: int
    """How many frames it has."""
    depth_mm: UInt16[np.ndarray, "N H W"]
    rgb: UInt8[np.ndarray, "N h w 3"]
    recording: Int[np.ndarray, " N"]
    """Which one a frame is from."""
    focal_px: float
    baseline_m: float
    unaligned: tuple[Path, ...] = ()
    """Recordings among them whose colour is not aligned to depth."""
    apart: Mapping[int, Path] = field(default_factory=dict)
    """Recordings among them whose frames may be of different moments (`Recording.consecutive`), or of which
    some between them are left out as blind, by number."""
    blind: int = 0
    """How many are left out, since hardly a pixel is valid at this size."""

    @property
    def blocks(self) -> list[int]:
        """First frame of every block: both sides' frames are of one recording, what is left over of it counts
        for nothing."""
        firsts: list[int] = []
        for number in np.unique(self.recording):
            frames = np.flatnonzero(self.recording == number)
            firsts += frames[: len(frames) // _RUN_FRAMES * _RUN_FRAMES : _RUN_FRAMES].tolist()
        return firsts


def real_size(root: Path, width_px: int) -> tuple[int, int]:
    """(rows, columns) of the recordings at or below `root` brought to `width_px`.

    Raises UserError for recordings of different sizes, or none.
    """
    return _size(_of_one_size(root)[0], width_px)


def load_real(root: Path, width_px: int, last: int) -> RealFrames:
    """The `last` frames of the recordings at or below `root`, at `width_px` (nearest neighbours), without
    those that only came again, which would stand on both sides, and those that are blind at that size.

    Raises UserError for recordings of different sizes, or none, or if those that the frames are of have
    different optics, or unknown ones.
    """
    recordings = _of_one_size(root)
    frames = [(number, i) for number, r in enumerate(recordings) for i in range(len(r))]
    taken = [(number, i) for number, i in frames[-last:] if not recordings[number].repeats(i)]
    if not taken:
        raise UserError(f"{root}: its last {last} frames are one picture, come again: record a moving view.")
    size = _size(recordings[0], width_px)
    pictures = {at: depth.crop_nearest(recordings[at[0]].depth_mm(at[1]), size) for at in taken}
    blind = {at for at, picture in pictures.items() if np.count_nonzero(picture) < FEWEST_VALID}
    if not (taken := [at for at in taken if at not in blind]):
        raise UserError(f"{root}: its last {last} frames have no depth at {size[1]}x{size[0]}.")
    numbers = np.array([number for number, _ in taken])
    scored = [recordings[number] for number in np.unique(numbers)]
    focal_px, baseline_m = _optics(scored)
    unaligned = tuple(r.path for r in scored if not r.color_aligned)
    kept = {n: [i for number, i in taken if number == n] for n, _ in blind}
    gaps = {n for n, i in blind if kept[n] and min(kept[n]) < i < max(kept[n])}
    apart = {
        int(n): recordings[n].path for n in np.unique(numbers) if n in gaps or not recordings[n].consecutive
    }
    depth_mm = np.stack([pictures[at] for at in taken])
    chosen = [recordings[number].rgb(i) for number, i in taken]
    rgb = np.stack([cv2.resize(picture, size[::-1], interpolation=cv2.INTER_AREA) for picture in chosen])
    focal_px *= width_px / recordings[0].width_px
    return RealFrames(len(frames), depth_mm, rgb, numbers, focal_px, baseline_m, unaligned, apart, len(blind))


def _optics(recordings: Sequence[Recording]) -> tuple[float, float]:
    """`Recording.optics` of all of them; UserError if two differ."""
    first, *others = recordings
    for other in others:
        if other.optics() != first.optics():
            raise UserError(
                f"{other.path} has focal length and baseline {other.optics()}, {first.path} {first.optics()} "
                "(px, m): score recordings of one camera."
            )
    return first.optics()


def _of_one_size(root: Path) -> list[Recording]:
    recordings = find_recordings(root)
    sizes = {(r.height_px, r.width_px) for r in recordings}
    if len(sizes) > 1:
        raise UserError(f"{root} holds recordings of different sizes {sorted(sizes)}: give one of them.")
    return recordings


def _size(recording: Recording, width_px: int) -> tuple[int, int]:
    return round(recording.height_px * width_px / recording.width_px), width_px


def check_colour(frames: RealFrames, with_rgb: bool) -> None:
    """UserError if colour is wanted that is not aligned to depth."""
    if with_rgb and frames.unaligned:
        raise UserError(
            f"{frames.unaligned[0]}: colour is not aligned to depth, as column monocular and a prior of "
            "simulated colour need it: align it when recording, or do without them (--columns without "
            "monocular, --ddg.prior.in-sim depth)."
        )


def real_episodes(frames: RealFrames, with_rgb: bool) -> list[Episode]:
    """The frames as episodes: even ones are the real side, odd ones give the geometry.

    Both sides see the same room, a frame apart: the distance between them is the sensor's alone.

    Raises UserError if colour is wanted that is not aligned to depth.
    """
    from ddg_jax.geometry import surfaces

    check_colour(frames, with_rgb)
    depth_mm, rgb = frames.depth_mm, frames.rgb
    clean = depth.to_millimetres(surfaces(depth.to_metres(depth_mm), PIECEWISE))
    episodes = []
    for parity, side in enumerate(SIDES):
        for block, first in enumerate(frames.blocks):
            rows = np.arange(first + parity, first + _RUN_FRAMES, len(SIDES))
            episodes.append(
                Episode(
                    side, len(episodes), block, depth_mm[rows], clean[rows],
                    np.zeros((0, *depth_mm.shape[1:]), np.uint16), rgb[rows] if with_rgb else None,
                    frames.focal_px, frames.baseline_m, int(frames.recording[first]) not in frames.apart,
                )
            )  # fmt: skip
    return episodes
