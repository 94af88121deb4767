"""A whole set of demos through the generator: a stream in constant memory, resumable, over all devices.

    ddgrasp ddg generate --model runs/a/ddg --demos runs/a/demos --out runs/a

Frames of all episodes form one stream, cut into batches at fixed places, whatever the episodes' lengths: no
batch but the last is padded, and a job that resumes computes the very batches of an uninterrupted one, so its
result is the same bit for bit (on the same number of devices; on another one up to rounding).
"""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import jax
import numpy as np
from jaxtyping import Key, UInt8, UInt16

from ddg_jax.sample import Generated, Generator, batch_size, condition, grafted, predict
from ddg_jax.window import mixed
from ddgrasp import depth
from ddgrasp.artifacts import Artifact
from ddgrasp.errors import UserError
from ddgrasp.job import Job
from demos.store import STORE as DEMOS
from demos.store import EpisodeStore
from mjx_envs.views import Views

STORE = "depth.zarr"
"""`data/depth_mm` with artefacts; episodes and steps of the demo store."""


@dataclass(frozen=True)
class Clip:
    """An episode of clean depth."""

    number: int
    """Decides its noise."""
    depth_mm: UInt16[np.ndarray, "T H W"]
    rgb: UInt8[np.ndarray, "T h w 3"] | None = None
    """For priors that need it in simulation."""
    views: Views | None = None
    """What the frames are of, where it is known."""


class FrameByFrame:
    """A depth source whose frames share nothing (`student_jax.depth_source.DepthSource`)."""

    frames: Callable[..., UInt16[np.ndarray, "T H W"]]
    """(clean depth, colour, episode's number and frame's number of each, views) -> depth."""

    def episodes(
        self, lengths: Sequence[int], read: Callable[[int], Clip], first: int = 0
    ) -> Iterator[UInt16[np.ndarray, "_ H W"]]:
        """As `noisy_episodes`, an episode at a time."""
        for i in range(first, len(lengths)):
            clip = read(i)
            number = np.full(len(clip.depth_mm), clip.number)
            yield self.frames(clip.depth_mm, clip.rgb, number, np.arange(len(number)), clip.views)


def noisy_episodes(
    key: Key[jax.Array, ""],
    generator: Generator,
    lengths: Sequence[int],
    read: Callable[[int], Clip],
    first: int = 0,
    *,
    grafting: bool = True,
) -> Iterator[UInt16[np.ndarray, "T H W"]]:
    """Yields the grafted depth, (T, H, W) uint16 millimetres, of episodes `first`, `first` + 1, ... in order.

    Holds a batch and the episodes that it touches.

    Args:
      lengths: frames of every episode, those before `first` included: they say where batches are cut.
      read: episode's position in `lengths` -> its frames.
      grafting: off gives the generator's own map instead of grafted depth.
    """
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(int)
    size = batch_size(generator.config)
    used = begin = starts[first] // size * size
    waiting: deque[tuple[int, np.ndarray]] = deque()
    made: deque[np.ndarray] = deque()

    def stream() -> Iterator[tuple[np.ndarray, int, int]]:
        for i in range(int(np.searchsorted(starts, begin, side="right")) - 1, len(lengths)):
            clip = read(i)
            clean_m = mixed(depth.to_metres(clip.depth_mm), generator.config.graft)
            waiting.append((i, clean_m))
            c = condition(generator, clean_m, clip.rgb, one_episode=True)
            yield from ((c[t], clip.number, t) for t in range(max(0, begin - starts[i]), lengths[i]))

    frames = stream()
    while batch := list(islice(frames, size)):
        c, number, frame = (np.stack(values) for values in zip(*batch, strict=True))
        made.extend(predict(key, generator, c, episode=number, frame=frame))
        while waiting and len(made) >= starts[waiting[0][0] + 1] - used:
            i, clean_m = waiting.popleft()
            x = np.stack([made.popleft() for _ in range(starts[i + 1] - used)])
            used = starts[i + 1]
            if i >= first:
                yield made_mm(grafted(generator.config, clean_m, x), grafting)


def made_mm(made: Generated, grafting: bool) -> UInt16[np.ndarray, "B H W"]:
    """(B, H, W) uint16 millimetres: grafted depth, or without `grafting` the generator's own map."""
    return depth.to_millimetres(made.depth_m if grafting else made.predicted_m)


def run(job: Job) -> Artifact:
    """Stage `noisy`: writes depth.zarr, the demos as the camera would see them.

    Goes on after the episodes that are there. `config.seed` is the noise's.
    """
    config, directory, progress = job.config, job.directory, job.progress
    generator = Generator.load(job.parents["ddg"].directory)
    clean = EpisodeStore(job.parents["demos"].directory / DEMOS)
    if generator.prior.needs_sim_rgb and "rgb" not in clean.fields:
        raise UserError(
            f"{clean.path} holds no colour, which the prior needs: ddg.prior.in_sim depth does not."
        )
    noisy = EpisodeStore(directory / STORE, create=True)
    ends = np.concatenate([[0], clean.ends])

    def read(i: int) -> Clip:
        steps = {name: clean.steps(name, ends[i], ends[i + 1]) for name in _fields(generator)}
        return Clip(i, steps["depth_mm"], steps.get("rgb"))

    key = jax.random.key(config.seed)
    with progress.task("artefacts on the demos", len(clean)) as task:
        task.start_at(len(noisy))
        for depth_mm in noisy_episodes(key, generator, np.diff(ends).tolist(), read, len(noisy)):
            noisy.append({"depth_mm": depth_mm}, {"invalid_fraction": np.mean(depth_mm == 0)})
            task.advance()
    invalid = np.average(noisy.episodes("invalid_fraction"), weights=np.diff(ends))
    metrics = {"episodes": len(noisy), "frames": int(ends[-1]), "invalid_fraction": float(invalid)}
    return job.finish(metrics)


def _fields(generator: Generator) -> tuple[str, ...]:
    return ("depth_mm", "rgb") if generator.prior.needs_sim_rgb else ("depth_mm",)
