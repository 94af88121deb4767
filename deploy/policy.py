"""An exported policy: three raw depth frames and the robot's state in, one action out."""

from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32

from ddgrasp import artifacts, contract
from ddgrasp import policy_metadata as metadata
from ddgrasp.config.deploy import START_NOISES
from ddgrasp.depth import to_metres
from ddgrasp.errors import UserError
from ddgrasp.gripper import ClosingLatch, WidthChange
from ddgrasp.onnx_runtime import ort
from ddgrasp.shipped import shipped
from deploy.interfaces import Depth

LEAST_VALID = 0.02
"""Share of a frame's pixels: with fewer something is over the lens, or nearer than the camera sees."""
PLAUSIBLE_MEDIAN_M = (0.05, 20.0)
"""A scene's median depth outside this is another unit, not another scene."""

FARTHEST_JOINT_RAD, WIDEST_M = 7.0, 0.5
"""No arm's joint turns farther, no gripper opens wider: more are degrees, or millimetres."""


class DepthInput(NamedTuple):
    """What one `depth_dtype` of the metadata means for a frame."""

    dtype: np.dtype
    onnx_type: str
    unit: str
    unit_m: float


DEPTH_INPUTS = {
    "uint16_mm": DepthInput(np.dtype(np.uint16), "tensor(uint16)", "mm", contract.DEPTH_UNIT_M),
    "float32_m": DepthInput(np.dtype(np.float32), "tensor(float)", "m", 1.0),
}
"""For every one of `metadata.DEPTH_DTYPES`."""
_UNITS = {kind.dtype.kind: kind for kind in DEPTH_INPUTS.values()}


class OnnxPolicy:
    """Runs the file on one thread; keeps the last three frames and what is left of the last chunk."""

    def __init__(
        self, path: Path | str, *, noise: str = "zero", seed: int = 0, execute_steps: int | None = None
    ):
        """Load and check `path`.

        Args:
            noise: start of the reverse diffusion: zero (deterministic) or normal (drawn from `seed`).
            execute_steps: actions played from a chunk before the network runs again; None takes the
                file's own.

        Raises:
            UserError: no such file, a folder, not ONNX, not ours, of another contract, or it does not run.
        """
        if noise not in START_NOISES:
            raise UserError(f"noise is {noise!r}; expected one of {', '.join(START_NOISES)}.")
        self.path = shipped(path)
        self._session = _open(self.path)
        self.info = _metadata(self._session, self.path)
        self.depth_input = DEPTH_INPUTS[self.info.depth_dtype]
        self.depth_shape = (self.info.depth_height, self.info.depth_width)
        steps = self.info.execute_steps if execute_steps is None else execute_steps
        if not 1 <= steps <= self.info.chunk:
            raise UserError(
                f"execute_steps is {steps}; {self.path} predicts {self.info.chunk} actions at once: "
                f"choose 1 to {self.info.chunk}."
            )
        self.execute_steps = steps
        self._latch = ClosingLatch(self.info.closing_steps)
        self._width_change = WidthChange()
        self._noise_kind = noise
        self.watch: Callable[[Depth, np.ndarray], None] | None = None
        """Is told the frames (3, H, W) and the state (9,) that the network gets in every call of `act`."""
        self.reset(seed)
        self._try()

    def _try(self) -> None:
        """Raises UserError for a file that does not run: shapes may fit where a type or a batch does not."""
        try:
            self.warm_up()
        except Exception as error:  # onnxruntime raises classes of its own, without a common base
            reason = (str(error) or repr(error)).splitlines()[0]
            raise UserError(f"{self.path}: it does not run ({reason}); {_remedy(self.path)}.") from error

    def reset(self, seed: int) -> None:
        """Start of an episode: forget all frames, draw noise from `seed`."""
        self._rng = np.random.default_rng(seed)
        self.restart()

    def restart(self) -> None:
        """Something else acts for a while: what is seen and begun now does not count, draws go on."""
        self._latch.reset()
        self.forget()

    def forget(self) -> None:
        """Drop buffered frames and the rest of the chunk: the next frame fills the buffer alone."""
        self._width_change.reset()
        self._frames: deque[np.ndarray] = deque(maxlen=contract.DEPTH_FRAMES)
        self._actions: deque[np.ndarray] = deque()

    def replan(self) -> None:
        """Drop the rest of the chunk: it was for a way that ended."""
        self._actions.clear()

    @property
    def will_infer(self) -> bool:
        """Whether the next `act` runs the network (otherwise it plays the last chunk on)."""
        return not self._actions

    def check_fit(self, depth: np.ndarray) -> str:
        """Why a camera that gives `depth` cannot be used with this file, empty if it can."""
        wanted = self.depth_input.dtype
        if depth.dtype not in (wanted, np.uint16):  # millimetres, of which metres are made
            return f"wrong depth: type {depth.dtype}, the policy takes {wanted} ({self.info.depth_dtype})"
        if depth.shape != self.depth_shape:
            return f"wrong depth: size {depth.shape}, the policy takes {self.depth_shape}"
        return ""

    def check_unit(self, depth: np.ndarray) -> str:
        """Why the numbers in `depth` cannot be in this file's unit, empty if they can."""
        valid = depth[depth > 0]
        if not valid.size:
            return ""
        median, given = float(np.median(valid)), _UNITS[valid.dtype.kind]
        if PLAUSIBLE_MEDIAN_M[0] <= median * given.unit_m <= PLAUSIBLE_MEDIAN_M[1]:
            return ""
        return f"wrong depth: median {median:g} cannot be {given.unit}"

    def check_frame(self, depth: np.ndarray) -> str:
        """Why this one frame cannot be used, empty if it can: type, size, finiteness, valid pixels."""
        problem = self.check_fit(depth)
        if problem:
            return problem
        if depth.dtype.kind == "f" and not np.isfinite(depth).all():
            return f"non-finite depth: {int((~np.isfinite(depth)).sum())} pixels"
        if not (depth > 0).any():
            return "all-invalid depth: no pixel above 0"
        if (share := float(np.mean(depth > 0))) < LEAST_VALID:
            return f"almost all-invalid depth: {100 * share:.2g} % of the pixels are above 0"
        return ""

    def act(self, depth: Depth, state: Float[np.ndarray, " _"], periods: int = 1) -> Float32[np.ndarray, "8"]:
        """(8,) action for the newest frame (H, W) and the state (8,).

        Call this or `wait` in every control step, with the `periods` since the call before: a late loop
        leaves some out.

        UserError for a frame of another size or type, and for a state that is not eight finite numbers, in
        radians and metres; the frames of before stay.
        """
        if problem := self.check_fit(depth) or _wrong_state(state):
            raise UserError(f"{problem}.")
        if depth.dtype == self.depth_input.dtype:
            depth = depth.copy()  # cameras fill their buffers again
        else:
            depth = to_metres(depth)
        self._frames.append(depth)
        while len(self._frames) < contract.DEPTH_FRAMES:
            self._frames.append(depth)
        known = self._width_change(state, periods)
        if self.watch is not None:
            self.watch(np.stack(self._frames), known)
        if not self._actions:
            self._actions.extend(self._infer(known)[: self.execute_steps])
        return self._latch(self._actions.popleft())

    def wait(self, state: Float[np.ndarray, " _"], periods: int = 1) -> None:
        """A control step in which the policy is not asked: the fingers move all the same."""
        self._width_change(state, periods)

    def warm_up(self) -> None:
        """Run the network once, so that the first period does not pay for memory."""
        self._frames.extend([self._blank()] * contract.DEPTH_FRAMES)
        self._run(np.zeros(contract.POLICY_STATE_SIZE, np.float32), np.zeros(self._noise_shape, np.float32))
        self.forget()

    @property
    def _noise_shape(self) -> tuple[int, int, int]:
        return (1, self.info.chunk, contract.ACTION_SIZE)

    def _blank(self) -> np.ndarray:
        return np.ones(self.depth_shape, self.depth_input.dtype)

    def _infer(self, state: np.ndarray) -> np.ndarray:
        """(chunk, 8) actions."""
        if self._noise_kind == "normal":
            noise = self._rng.standard_normal(self._noise_shape, dtype=np.float32)
        else:
            noise = np.zeros(self._noise_shape, np.float32)
        return self._run(state, noise)

    def _run(self, state: np.ndarray, noise: np.ndarray) -> np.ndarray:
        inputs = {
            contract.ONNX_INPUT_DEPTH: np.stack(self._frames)[None],
            contract.ONNX_INPUT_STATE: state[None].astype(np.float32),
            contract.ONNX_INPUT_NOISE: noise,
        }
        (action,) = self._session.run([contract.ONNX_OUTPUT_ACTION], inputs)
        return np.asarray(action)[0]


def _wrong_state(state: Float[np.ndarray, "..."]) -> str:
    """Why a robot's state cannot be used, empty if it can."""
    if np.shape(state) != (contract.STATE_SIZE,):
        return (
            f"wrong state: size {np.shape(state)}, expected ({contract.STATE_SIZE},): joints, gripper's width"
        )
    values = np.asarray(state).tolist()
    if not np.isfinite(state).all():
        return f"wrong state: {values} is not finite"
    if max(map(abs, values[:-1])) > FARTHEST_JOINT_RAD:
        return f"wrong state: joints {values[:-1]} cannot be radians"
    return "" if abs(values[-1]) < WIDEST_M else f"wrong state: an opening of {values[-1]:g} cannot be metres"


def _open(path: Path) -> ort.InferenceSession:
    if path.is_dir():
        raise UserError(f"{path} is a folder: name the file, {_file_in(path)}.")
    if not path.is_file():
        raise UserError(f"{path}: no such file; {_remedy(path)}.")
    options = ort.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    try:
        return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises classes of its own, without a common base
        reason = str(error).splitlines()[0]
        raise UserError(f"{path}: onnxruntime cannot load it ({reason}); {_remedy(path)}.") from error


def _file_in(folder: Path) -> Path:
    """The policy in a run's folder or in its stage's."""
    export = folder / "export"
    return (export if export.is_dir() else folder) / metadata.POLICY_FILE


def _remedy(path: Path) -> str:
    """A finished export stage is not made again while its folder is there."""
    if artifacts.is_finished(path.parent):
        return f"delete {path.parent}, then make it again with `ddgrasp export`"
    return metadata.REMEDY


def _metadata(session: ort.InferenceSession, path: Path) -> metadata.PolicyMetadata:
    info = metadata.validate(session.get_modelmeta().custom_metadata_map, str(path))
    shapes = {node.name: node.shape for node in (*session.get_inputs(), *session.get_outputs())}
    metadata.validate_shapes(info, shapes, str(path))
    depth_type = next(node.type for node in session.get_inputs() if node.name == contract.ONNX_INPUT_DEPTH)
    expected = DEPTH_INPUTS[info.depth_dtype].onnx_type
    if depth_type != expected:
        raise UserError(
            f"{path}: depth input is {depth_type}, its metadata says {info.depth_dtype} ({expected}): "
            f"{metadata.REMEDY}."
        )
    return info
