"""Where the student's depth comes from in training: clean depth in, depth as a camera would report it out.

`student.depth_source` names one: `learned` is the run's fitted generator, `learned_ungrafted` its own map,
`monocular` a network on colour (`ddg_jax/monocular.py`), `rig` the development rig's camera before the scene
(`student_jax/rig_source.py`), the others are the camera models of `ddg_jax/sensor.py`.
`student.ellipse_dropout` cuts holes into what any of them gives.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Float32, Int, Key, UInt8, UInt16

from ddg_jax.generate import Clip, FrameByFrame, made_mm, noisy_episodes
from ddg_jax.monocular import MonocularDepth
from ddg_jax.sample import Generator, filled_up, generate
from ddg_jax.sensor import make_sensor
from ddgrasp.arrays import AnyArray
from ddgrasp.config import BY_COLOUR, SENSORS, Config, DextrahConfig, SensorConfig
from ddgrasp.depth import to_metres, to_millimetres
from ddgrasp.errors import UserError
from demos.store import EpisodeStore
from mjx_envs.views import Views
from sensors.models.procedural import ellipse_dropout
from sensors.models.sense import Sense
from student_jax.rig_source import RigSource
from student_jax.source_check import LEARNED

VIEWED = ("variant", "size", "T_world_cam")
"""What demos say of each episode that its pictures are of (`mjx_envs.views.Views`)."""
BATCH = 16
"""Frames that a camera model gets at once: one size, compiled once."""


@runtime_checkable
class DepthSource(Protocol):
    """Gives clean depth a camera's artefacts.

    Noise follows from a frame's episode and its own number within it alone, however frames are batched. A
    generator whose prior is normalised (`inverse_depth`) normalises it over what it is given at once: whole
    episodes by `episodes`, frame by frame by `frames`.
    """

    @property
    def needs_rgb(self) -> bool:
        """Whether it must be given colour."""
        ...

    @property
    def needs_views(self) -> bool:
        """Whether it must be given what the pictures are of."""
        ...

    def episodes(
        self, lengths: Sequence[int], read: Callable[[int], Clip], first: int = 0
    ) -> Iterator[UInt16[np.ndarray, "_ H W"]]:
        """(T, H, W) uint16 millimetres of episodes `first`, `first` + 1, ... in order.

        Args:
          lengths: frames of every episode, those before `first` included.
          read: position in `lengths` -> clean frames.
        """
        ...

    def frames(
        self,
        depth_mm: UInt16[np.ndarray, "B H W"],
        rgb: UInt8[np.ndarray, "B H W 3"] | None,
        episode: Int[np.ndarray, " B"],
        frame: Int[np.ndarray, " B"],
        views: Views | None = None,
    ) -> UInt16[np.ndarray, "B H W"]:
        """(B, H, W) uint16 millimetres of B frames that have nothing to do with each other.

        Args:
          depth_mm: (B, H, W) uint16, clean.
          rgb: (B, H, W, 3) uint8, where `needs_rgb`.
          episode: (B,) number of each frame's episode.
          frame: (B,) its number within that.
          views: of B pictures, where `needs_views`.
        """
        ...


@dataclass(frozen=True)
class GeneratorSource:
    """A fitted generator; frames of one episode share noise over time."""

    generator: Generator
    key: Key[jax.Array, ""]
    grafting: bool = True
    """Off: the generator's own map, as in the paper's ablation (IV-D)."""
    needs_views: bool = False

    @property
    def needs_rgb(self) -> bool:
        """See `DepthSource`."""
        return self.generator.prior.needs_sim_rgb

    def episodes(
        self, lengths: Sequence[int], read: Callable[[int], Clip], first: int = 0
    ) -> Iterator[UInt16[np.ndarray, "_ H W"]]:
        """See `DepthSource`."""
        return noisy_episodes(self.key, self.generator, lengths, read, first, grafting=self.grafting)

    def frames(
        self,
        depth_mm: UInt16[np.ndarray, "B H W"],
        rgb: UInt8[np.ndarray, "B H W 3"] | None,
        episode: Int[np.ndarray, " B"],
        frame: Int[np.ndarray, " B"],
        views: Views | None = None,
    ) -> UInt16[np.ndarray, "B H W"]:
        """See `DepthSource`."""
        rgb = rgb if self.needs_rgb else None
        noisy = generate(self.key, self.generator, to_metres(depth_mm), rgb, episode=episode, frame=frame)
        return made_mm(noisy, self.grafting)


@dataclass(frozen=True)
class MonocularSource(FrameByFrame):
    """Depth that a network estimates from simulated colour, made metric by clean depth; without noise."""

    network: MonocularDepth
    needs_rgb: bool = True
    needs_views: bool = False

    def frames(
        self,
        depth_mm: UInt16[np.ndarray, "B H W"],
        rgb: UInt8[np.ndarray, "B H W 3"] | None,
        episode: Int[np.ndarray, " B"],
        frame: Int[np.ndarray, " B"],
        views: Views | None = None,
    ) -> UInt16[np.ndarray, "B H W"]:
        """See `DepthSource`."""
        assert rgb is not None  # `check_demos` sees to it
        return self.network(depth_mm, rgb)


@dataclass(frozen=True)
class SenseSource(FrameByFrame):
    """A camera model; every frame has noise of its own."""

    sense: Sense
    key: Key[jax.Array, ""]
    needs_rgb: bool = False
    needs_views: bool = False

    def frames(
        self,
        depth_mm: UInt16[np.ndarray, "B H W"],
        rgb: UInt8[np.ndarray, "B H W 3"] | None,
        episode: Int[np.ndarray, " B"],
        frame: Int[np.ndarray, " B"],
        views: Views | None = None,
    ) -> UInt16[np.ndarray, "B H W"]:
        """See `DepthSource`."""
        colour = rgb if self.needs_rgb else None
        parts = []
        for start in range(0, len(depth_mm), BATCH):
            now = slice(start, start + BATCH)
            batch = (
                to_metres(depth_mm[now]),
                None if colour is None else colour[now],
                episode[now],
                frame[now],
            )
            count = len(batch[0])
            sensed = sense_batch(self.sense, self.key, *jax.tree.map(partial(filled_up, size=BATCH), batch))
            parts.append(np.asarray(sensed)[:count])
        return to_millimetres(np.concatenate(parts))


@dataclass(frozen=True)
class EllipseDropoutSource:
    """Another source's depth with elliptic holes (`student.ellipse_dropout`)."""

    source: DepthSource
    dropout: SenseSource

    @property
    def needs_rgb(self) -> bool:
        """See `DepthSource`."""
        return self.source.needs_rgb

    @property
    def needs_views(self) -> bool:
        """See `DepthSource`."""
        return self.source.needs_views

    def episodes(
        self, lengths: Sequence[int], read: Callable[[int], Clip], first: int = 0
    ) -> Iterator[UInt16[np.ndarray, "_ H W"]]:
        """See `DepthSource`."""
        numbers: dict[int, int] = {}

        def noted(i: int) -> Clip:
            clip = read(i)
            numbers[i] = clip.number
            return clip

        for i, depth_mm in enumerate(self.source.episodes(lengths, noted, first), first):
            steps = np.arange(len(depth_mm))
            yield self.dropout.frames(depth_mm, None, np.full(len(steps), numbers.pop(i)), steps)

    def frames(
        self,
        depth_mm: UInt16[np.ndarray, "B H W"],
        rgb: UInt8[np.ndarray, "B H W 3"] | None,
        episode: Int[np.ndarray, " B"],
        frame: Int[np.ndarray, " B"],
        views: Views | None = None,
    ) -> UInt16[np.ndarray, "B H W"]:
        """See `DepthSource`."""
        seen_mm = self.source.frames(depth_mm, rgb, episode, frame, views)
        return self.dropout.frames(seen_mm, None, episode, frame)


def make_source(config: Config, ddg: Path) -> DepthSource:
    """The source that `config.student.depth_source` names, with the holes that `ellipse_dropout` adds; `ddg`
    is the stage directory of the generator.

    Raises UserError for an unknown name, or where `learned` finds no generator or `monocular` no weights.
    """
    source, student = _named_source(config, ddg), config.student
    if not student.ellipse_dropout:
        return source
    sense = ellipse_dropout(student.ellipse_dropout, student.ellipse_half_axis_px)
    return EllipseDropoutSource(source, SenseSource(sense, jax.random.key(config.seed)))


def _named_source(config: Config, ddg: Path) -> DepthSource:
    name, key = config.student.depth_source, jax.random.key(config.seed)
    if name in LEARNED:
        return GeneratorSource(Generator.load(ddg), key, grafting=name == "learned")
    if name == "monocular":
        return MonocularSource(MonocularDepth(config.ddg))
    if name == "rig":
        return RigSource(config)
    if name not in SENSORS:
        raise ValueError(f"depth source {name!r} has no line here")
    student = config.student
    formulas = DextrahConfig(normal_m=student.dextrah_normal_m).scaled(student.dextrah_scale)
    sensor = SensorConfig(name=name, stereo=config.record.stereo, dextrah=formulas)
    return SenseSource(make_sensor(sensor, config.world.profile), key, name in BY_COLOUR)


def check_demos(source: DepthSource, demos: EpisodeStore) -> None:
    """UserError if `source` needs colour, or what pictures are of, and the demos lack it."""
    if source.needs_rgb and "rgb" not in demos.fields:
        raise UserError(
            f"{demos.path} holds no colour, which the student's depth source needs: collect demos "
            "with --demos.rgb, or take another student.depth_source."
        )
    if source.needs_views:
        check_views(demos)


def check_views(demos: EpisodeStore) -> None:
    """UserError if `demos` do not say what their pictures are of."""
    try:
        sizes = demos.episodes(VIEWED[1])
    except UserError:
        sizes = np.zeros(1)
    if not np.all(sizes > 0):  # 0 where a collection went on that was begun without
        raise UserError(
            f"{demos.path} does not say which object of which size its pictures show, as demos do since "
            "2026-11-25: collect new ones for student.depth_source 'rig', in another --out."
        )


@partial(jax.jit, static_argnums=0)
def sense_batch(
    sense: Sense,
    key: Key[jax.Array, ""],
    depth_m: Float[AnyArray, "B H W"],
    rgb: UInt8[AnyArray, "B H W 3"] | None,
    episode: Int[AnyArray, " B"],
    frame: Int[AnyArray, " B"],
) -> Float32[jax.Array, "B H W"]:
    """Depth in metres as a camera model reports it, 0 = hole; a frame's draws depend on (key, episode, frame)
    alone."""

    def one(depth, picture, e, t):
        return sense(jax.random.fold_in(jax.random.fold_in(key, e), t), depth, picture)

    return jax.vmap(one)(depth_m, rgb, jnp.asarray(episode), jnp.asarray(frame))
