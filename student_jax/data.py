"""The student's training frames: noisy depth on disk; joints, labels and privileged targets in memory."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32, UInt16

from ddgrasp import contract
from ddgrasp.arrays import AnyArray
from ddgrasp.config import StudentConfig
from ddgrasp.errors import UserError
from ddgrasp.layout import ACTION, OBSERVATION, STATE, closes
from student_jax.policy import Aux, position_from_world

CACHE = "frames.zarr"
"""The training frames in the student's folder, while it trains."""
LEAD_IN = contract.DEPTH_FRAMES - 1
"""Steps before a sample that its stack of pictures shows."""
YAW_MULTIPLE = 2
"""The gripper looks the same after half a turn: the auxiliary target is the angle's double."""


def kept_of_a_demo(student: StudentConfig, length: int) -> int:
    """Steps that are kept at most of a demo of `length` steps."""
    steps = student.training.demo_stretch_steps
    return min(length, steps + LEAD_IN + student.head.chunk - 1) if steps else length


def learns_from_pictures(student: StudentConfig) -> bool:
    """Whether anything is trained on frames: else none are drawn."""
    return bool(student.training.steps or student.dagger.rounds or student.head.train_steps)


@runtime_checkable
class DepthRows(Protocol):
    """N depth pictures, wherever they lie."""

    def read(self, index: Int[np.ndarray, " n"]) -> UInt16[AnyArray, "n H W"]:
        """Pictures `index`, in that order."""
        ...


@dataclass(frozen=True)
class DepthInMemory:
    """Pictures of whole episodes, for small numbers of them."""

    depth_mm: UInt16[np.ndarray, "N H W"]

    def read(self, index: Int[np.ndarray, " n"]) -> UInt16[np.ndarray, "n H W"]:
        """See `DepthRows`."""
        return self.depth_mm[index]


@dataclass(frozen=True)
class Window:
    """The part of a camera's picture that a student can see, wherever its crop window is shifted to."""

    rows: slice
    columns: slice
    height_px: int
    """The whole picture's."""
    width_px: int
    """The whole picture's."""

    @classmethod
    def seen(cls, profile: contract.CameraProfile, shift_px: int) -> "Window":
        """The crop window of `profile`, and `shift_px` pixels around it."""
        top, left = profile.crop_origin_px
        rows = slice(top - shift_px, top + profile.crop_height_px + shift_px)
        columns = slice(left - shift_px, left + profile.crop_width_px + shift_px)
        return cls(rows, columns, profile.height_px, profile.width_px)

    @property
    def shape(self) -> tuple[int, int]:
        """Its rows and columns."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    @property
    def margins(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Pixels of the whole picture above and below it, left and right of it."""
        rows, columns = self.rows, self.columns
        return (
            (rows.start, self.height_px - rows.stop),
            (columns.start, self.width_px - columns.stop),
        )

    def cut(self, depth_mm: UInt16[np.ndarray, "*n H W"]) -> UInt16[np.ndarray, "*n h w"]:
        """The window of whole pictures."""
        return depth_mm[..., self.rows, self.columns]


@dataclass(frozen=True)
class DepthInWindow:
    """Pictures of which a window is kept; around it they are invalid."""

    kept: DepthRows
    window: Window

    def read(self, index: Int[np.ndarray, " n"]) -> UInt16[np.ndarray, "n H W"]:
        """See `DepthRows`."""
        depth = np.zeros((len(index), self.window.height_px, self.window.width_px), np.uint16)
        self.window.cut(depth)[:] = self.kept.read(index)
        return depth


@dataclass
class Frames:
    """N control steps of many episodes, one after another."""

    depth_mm: DepthRows | None
    """Depth of every step as the student sees it, holes 0; None without pictures."""
    state: Float32[np.ndarray, "N 9"]
    """`layout.POLICY_STATE`."""
    action: Float32[np.ndarray, "N 8"]
    """The teacher's labels."""
    observation: Float32[np.ndarray, "N 40"]
    """The teacher's."""
    held: Float32[np.ndarray, " N"]
    """1 where the object is in the hand."""
    episode: Int[np.ndarray, " N"]
    """Which episode a step is of."""
    step: Int[np.ndarray, " N"]
    """Index within the episode."""
    drawn: Bool[np.ndarray, " N"]
    """Whether a step is a sample; others lie there for the picture stacks of the next ones."""
    _cumulative: tuple[float, np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self.state)

    def draw(self, rng: np.random.Generator, count: int, held_weight: float) -> Int[np.ndarray, " {count}"]:
        """(count,) indices at random of `drawn`; a step with the object in the hand counts `held_weight`.

        Most of an episode holds the lifted object, and there is little to learn from that.
        """
        if self._cumulative is None or self._cumulative[0] != held_weight:
            weight = np.where(self.held > 0, held_weight, 1.0) * self.drawn
            self._cumulative = held_weight, np.cumsum(weight)
        total = self._cumulative[1]
        return np.searchsorted(total, rng.random(count) * total[-1], side="right")

    def depth_stack(self, index: Int[np.ndarray, " B"]) -> UInt16[AnyArray, "B 3 H W"]:
        """(B, 3, H, W) uint16: the last three frames at each index, the first repeated at the start.

        Where the frames lie: NumPy's, or on the device.
        """
        assert self.depth_mm is not None
        back = np.arange(contract.DEPTH_FRAMES)[::-1]
        rows = index[:, None] - np.minimum(self.step[index][:, None], back)
        depth = self.depth_mm.read(rows.reshape(-1))
        return depth.reshape(*rows.shape, *depth.shape[1:])

    def action_chunks(self, index: Int[np.ndarray, " B"], chunk: int) -> Float32[np.ndarray, "B {chunk} 8"]:
        """(B, chunk, 8) labels from each index on, the episode's last one repeated at its end."""
        ahead = index[:, None] + np.arange(chunk)[None]
        ahead = np.minimum(ahead, len(self) - 1)
        inside = self.episode[ahead] == self.episode[index][:, None]
        last = np.where(inside, ahead, 0).max(axis=1, keepdims=True)
        return self.action[np.where(inside, ahead, last)]


def aux_targets(
    observation: Float[np.ndarray, "N 40"], held: Float[np.ndarray, " N"] | Bool[np.ndarray, " N"]
) -> Aux:
    """What perception is to report of the teacher's observations (N, 40); `held_logit` is 0 or 1."""
    quat = observation[:, OBSERVATION.grasp_quat]
    yaw = 2.0 * np.arctan2(quat[:, 2], quat[:, 1]) * YAW_MULTIPLE
    position = position_from_world(observation[:, OBSERVATION.grasp_pos])
    return Aux(
        position.astype(np.float32),
        np.stack([np.cos(yaw), np.sin(yaw)], axis=1).astype(np.float32),
        held.astype(np.float32),
    )


def make_frames(
    depth_mm: Sequence[UInt16[np.ndarray, "_ H W"]],
    states: Sequence[Float[np.ndarray, "_ 8"]],
    actions: Sequence[Float[np.ndarray, "_ 8"]],
    observations: Sequence[Float[np.ndarray, "_ 40"]],
    held: Sequence[Float[np.ndarray, " _"] | Bool[np.ndarray, " _"]],
) -> Frames:
    """Frames of whole episodes; each argument has one array (T, ...) per episode.

    `depth_mm` is empty for episodes without pictures. Raises UserError for depth that is no uint16, or arrays
    of one episode that differ in length.
    """
    lengths = [len(s) for s in states]
    for given in (*([depth_mm] if len(depth_mm) else []), actions, observations, held):
        if len(given) != len(lengths):
            raise UserError(
                f"{len(lengths)} episodes have states, {len(given)} other rows; expected as many."
            )
        for number, (length, episode) in enumerate(zip(lengths, given, strict=True)):
            if len(episode) != length:
                raise UserError(f"Episode {number} has {length} states and {len(episode)} other rows.")
    if other := {str(depth.dtype) for depth in depth_mm} - {"uint16"}:
        raise UserError(f"Depth is {min(other)}; expected millimetres (uint16).")
    return Frames(
        depth_mm=DepthInMemory(np.concatenate(depth_mm)) if len(depth_mm) else None,
        state=np.concatenate([with_change(episode) for episode in states]).astype(np.float32),
        action=np.clip(np.concatenate(actions), -1, 1).astype(np.float32),
        observation=np.concatenate(observations).astype(np.float32),
        held=np.concatenate(held).astype(np.float32),
        episode=np.repeat(np.arange(len(lengths)), lengths),
        step=np.concatenate([np.arange(n) for n in lengths]),
        drawn=np.ones(sum(lengths), bool),
    )


def with_change(states: Float[np.ndarray, "T 8"]) -> Float[np.ndarray, "T 9"]:
    """An episode's states as a student is told them, see `layout.POLICY_STATE`."""
    width = states[:, STATE.width]
    return np.concatenate([states, np.diff(width, axis=0, prepend=width[:1])], axis=1)


def sharpen_gripper(action: Float[np.ndarray, "*b 8"]) -> Float[np.ndarray, "*b 8"]:
    """Labels with the gripper command at -1 or 1: the robot only looks at its sign."""
    sharp = np.array(action)
    sharp[..., ACTION.gripper] = np.where(closes(sharp), 1.0, -1.0)[..., None]
    return sharp


def random_crops(
    rng: np.random.Generator, count: int, profile: contract.CameraProfile, shift_px: int
) -> Int32[np.ndarray, "{count} 2"]:
    """(count, 2) int32 crop origins, the centred one shifted by up to `shift_px` pixels each way."""
    shift = rng.integers(-shift_px, shift_px + 1, (count, 2))
    return (np.array(profile.crop_origin_px) + shift).astype(np.int32)
