"""Does the ONNX file compute what JAX computes? And how long does it take?"""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32, UInt16

from ddgrasp import contract
from ddgrasp.config import StudentConfig
from ddgrasp.contract import CameraProfile
from ddgrasp.depth import to_metres, to_millimetres
from ddgrasp.onnx_runtime import ort
from student_jax import denoiser, preprocess

RawDepth = UInt16[np.ndarray, "*batch H W"] | Float32[np.ndarray, "*batch H W"]
Actions = Float32[np.ndarray, "B chunk 8"]

HOLE_SHARE = 0.1
"""Share of invalid pixels in random frames."""
HOLE_SIZE_PX = 6
WARM_UP_RUNS = 5
NOT_FINITE = (np.nan, np.inf, -np.inf, -1.0, 100.0)
"""What a float depth map may hold besides depth: all of it means invalid."""


@dataclass(frozen=True)
class Inputs:
    """One batch as the file takes it."""

    depth: UInt16[np.ndarray, "B 3 H W"] | Float32[np.ndarray, "B 3 H W"]
    """(B, 3, H, W) uint16 millimetres or float32 metres."""
    state: Float32[np.ndarray, "B 9"]
    """(B, 9) float32."""
    noise: Float32[np.ndarray, "B chunk 8"]
    """(B, chunk, 8) float32."""

    def feed(self) -> dict[str, np.ndarray]:
        """Keyed by the graph's input names."""
        names = (contract.ONNX_INPUT_DEPTH, contract.ONNX_INPUT_STATE, contract.ONNX_INPUT_NOISE)
        return dict(zip(names, (self.depth, self.state, self.noise), strict=True))


def open_session(model: bytes | Path | str, threads: int = 1) -> ort.InferenceSession:
    """onnxruntime on `threads` CPU threads that do not spin while they wait."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    source = model if isinstance(model, bytes) else str(model)
    return ort.InferenceSession(source, options, providers=["CPUExecutionProvider"])


def run_onnx(session: ort.InferenceSession, inputs: Inputs) -> Actions:
    """(B, chunk, 8) actions."""
    return np.asarray(session.run([contract.ONNX_OUTPUT_ACTION], inputs.feed())[0])


def depth_in_metres(depth: RawDepth) -> Float32[np.ndarray, "*batch H W"]:
    """Raw depth of either type as float32 metres."""
    return to_metres(depth) if depth.dtype == np.uint16 else depth.astype(np.float32)


def raw_depth(depth_m: Float[np.ndarray, "*batch H W"], depth_dtype: str) -> RawDepth:
    """Metres, 0 = invalid, as a camera of that type would give them."""
    return depth_m.astype(np.float32) if depth_dtype == "float32_m" else to_millimetres(depth_m)


def random_frames(
    rng: np.random.Generator, batch: int, profile: CameraProfile
) -> Float32[np.ndarray, "B 3 H W"]:
    """(B, 3, H, W) metres: the table with blobs, sensor noise and square holes, rarely an empty frame."""
    table = preprocess.table_depth(profile, 10.0)
    depth = np.broadcast_to(table, (batch, contract.DEPTH_FRAMES, *table.shape)).copy()
    rows, columns = np.mgrid[: profile.height_px, : profile.width_px]
    for sample in depth:
        for _ in range(4):
            centre = rng.uniform(0, (profile.height_px, profile.width_px))
            inside = (rows - centre[0]) ** 2 + (columns - centre[1]) ** 2 < rng.uniform(3, 30) ** 2
            sample -= inside * np.float32(rng.uniform(0.0, 0.5))
    depth += rng.normal(0.0, 0.005, depth.shape)
    coarse = (-(-profile.height_px // HOLE_SIZE_PX), -(-profile.width_px // HOLE_SIZE_PX))
    holes = rng.random((batch, contract.DEPTH_FRAMES, *coarse)) < HOLE_SHARE
    holes = holes.repeat(HOLE_SIZE_PX, axis=2).repeat(HOLE_SIZE_PX, axis=3)
    depth[holes[:, :, : profile.height_px, : profile.width_px]] = 0.0
    depth[rng.random((batch, contract.DEPTH_FRAMES)) < 0.05] = 0.0
    return depth.astype(np.float32)


def random_inputs(
    rng: np.random.Generator,
    batch: int,
    student: StudentConfig,
    profile: CameraProfile,
    depth_dtype: str,
    frames_m: Float[np.ndarray, "B 3 H W"] | None = None,
) -> Inputs:
    """Random states and noise with the given frames (B, 3, H, W) in metres, or with random ones.

    Random float frames also hold NaN, infinities, negative and absurd readings.
    """
    if frames_m is None:
        frames_m = random_frames(rng, batch, profile)
        if depth_dtype == "float32_m":
            spoilt = rng.random(frames_m.shape) < 0.01
            frames_m[spoilt] = rng.choice(np.array(NOT_FINITE, np.float32), int(spoilt.sum()))
    state = rng.uniform(denoiser.STATE_LOWER, denoiser.STATE_UPPER, (batch, contract.POLICY_STATE_SIZE))
    noise = rng.standard_normal((batch, student.head.chunk, contract.ACTION_SIZE))
    return Inputs(raw_depth(frames_m, depth_dtype), state.astype(np.float32), noise.astype(np.float32))


def jax_policy(
    params: dict, student: StudentConfig, profile: CameraProfile, steps: int = 0
) -> Callable[[Inputs], Actions]:
    """The reference: `sample_actions`, compiled."""
    import jax

    from mjx_envs.precision import exact
    from student_jax.policy import sample_actions

    @jax.jit
    @exact  # the file is computed in float32
    def act(depth_m, state, noise):
        return sample_actions(params, depth_m, state, noise, student, profile, steps)

    return lambda inputs: np.asarray(act(depth_in_metres(inputs.depth), inputs.state, inputs.noise))


def max_abs_diff(
    session: ort.InferenceSession, reference: Callable[[Inputs], Actions], batches: Iterator[Inputs]
) -> float:
    """Largest absolute difference between any two actions; infinite if either is not finite."""
    worst = 0.0
    for inputs in batches:
        difference = float(np.abs(run_onnx(session, inputs) - reference(inputs)).max())
        worst = max(worst, difference if np.isfinite(difference) else np.inf)
    return worst


def latency_ms(session: ort.InferenceSession, inputs: Inputs, runs: int) -> dict[str, float]:
    """p50 and p99 of one inference, milliseconds, after a warm-up."""
    feed = inputs.feed()
    for _ in range(WARM_UP_RUNS):
        session.run(None, feed)
    times = np.empty(runs)
    for index in range(runs):
        start = time.perf_counter()
        session.run(None, feed)
        times[index] = time.perf_counter() - start
    p50, p99 = np.percentile(times, (50, 99)) * 1e3
    return {"p50": float(p50), "p99": float(p99)}
