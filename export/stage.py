"""Export: <run>/student -> <run>/export/policy.onnx, checked against JAX and timed."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from ddgrasp import contract
from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.errors import UserError
from ddgrasp.files import atomic_write_bytes
from ddgrasp.job import Job
from ddgrasp.policy_metadata import POLICY_FILE, describe_run
from ddgrasp.progress import Progress
from ddgrasp.versions import project_version
from export import graph, parity

BATCH = 4
BATCH_ONE_CHECKS = 4


def run(job: Job) -> Artifact:
    """Writes the run's student as one ONNX file (seconds).

    Raises:
        UserError: no finished student, or ONNX and JAX disagree by more than config.export.max_abs_diff
            (the file is then not written).
    """
    from learning.params import load_params
    from student_jax.policy import PARAMS_FILE

    config, student = job.config, job.parents["student"]
    params = load_params(student.directory / PARAMS_FILE)
    model = export_policy(config, params, student.hash)
    job.progress.note(f"{POLICY_FILE}: {len(model) / 1e6:.1f} MB")
    frames = demo_frames(student.directory.parent / "demos", config)
    metrics = measure(config, params, model, frames, job.progress)
    atomic_write_bytes(job.directory / POLICY_FILE, model)
    return job.finish(metrics)


def export_policy(config: Config, params: dict, student_manifest_hash: str = "") -> bytes:
    """The ONNX file's bytes."""
    metadata = describe_run(
        config, project_version=project_version(), student_manifest_hash=student_manifest_hash
    )
    model = graph.build_model(params, config.student, config.export, config.world.profile, metadata)
    return model.SerializeToString()


def measure(
    config: Config,
    params: dict,
    model: bytes,
    frames_m: Float32[np.ndarray, "N 3 H W"] | None,
    progress: Progress,
) -> dict:
    """Parity with JAX and latency on one thread. UserError if parity misses the configured bound.

    Args:
        frames_m: (N, 3, H, W) depth of demonstrations, metres, used in every second batch; the others, or
            all if it is None, are random frames full of holes.
    """
    student, profile, dtype = config.student, config.world.profile, config.export.depth_dtype
    session = parity.open_session(model)
    reference = parity.jax_policy(params, student, profile, config.export.ddim_steps)
    rng = np.random.default_rng(config.seed)
    sizes = [BATCH] * config.export.parity_batches + [1] * BATCH_ONE_CHECKS

    def batches():
        for index, size in enumerate(progress.track(sizes, "parity")):
            frames = _pick(frames_m, size, rng) if index % 2 == 0 else None
            yield parity.random_inputs(rng, size, student, profile, dtype, frames)

    difference = parity.max_abs_diff(session, reference, batches())
    bound = config.export.max_abs_diff
    if not math.isfinite(difference):
        raise UserError(
            "The policy's actions are no finite numbers on some inputs; nothing was written. Its parameters "
            "have diverged: train the student again."
        )
    if not difference <= bound:
        raise UserError(_too_different(difference, bound))
    inputs = parity.random_inputs(rng, 1, student, profile, dtype, _pick(frames_m, 1, rng))
    return {
        "max_abs_diff": difference,
        "parity_samples": sum(sizes),
        "parity_frames": "demonstrations and random" if frames_m is not None else "random",
        "latency_ms": parity.latency_ms(session, inputs, config.export.latency_runs),
        "file_mb": len(model) / 1e6,
    }


def _too_different(difference: float, bound: float) -> str:
    said = (
        f"The ONNX policy differs from JAX by {difference:.2e}, more than export.max_abs_diff = {bound:g}; "
        "nothing was written, the student is kept. "
    )
    if difference >= 0.5:  # twice as much is more than the setting takes
        return said + "Train longer."
    return said + (
        "If so much is acceptable, go on with --resume --export.max-abs-diff "
        f"{2 * difference:.0e}; otherwise train longer."
    )


def _pick(frames_m: np.ndarray | None, size: int, rng: np.random.Generator) -> np.ndarray | None:
    return None if frames_m is None else frames_m[rng.integers(len(frames_m), size=size)]


def demo_frames(demos: Path, config: Config, count: int = 64) -> Float32[np.ndarray, "N 3 H W"] | None:
    """(N, 3, H, W) metres: frame triples of the first demonstrations in the stage directory `demos`; None if
    there are none."""
    from demos.store import STORE, EpisodeStore

    path = demos / STORE
    if not path.exists():
        return None
    depth_mm = EpisodeStore(path).steps("depth_mm", 0, count + contract.DEPTH_FRAMES - 1)
    profile = config.world.profile
    usable = depth_mm.shape[1:] == (profile.height_px, profile.width_px)
    if len(depth_mm) < contract.DEPTH_FRAMES or not usable:
        return None
    depth_m = parity.depth_in_metres(depth_mm)
    triples = np.lib.stride_tricks.sliding_window_view(depth_m, contract.DEPTH_FRAMES, axis=0)
    return np.moveaxis(triples, -1, 1)
