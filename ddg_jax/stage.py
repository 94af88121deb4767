"""Stage `ddg`: recordings -> a fitted generator, its statistics and its pictures."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from ddg_jax import data, start
from ddg_jax.distil import check as check_halving
from ddg_jax.distil import distil
from ddg_jax.prior import Prior, make_prior
from ddg_jax.sample import Generator, grafted, predict
from ddg_jax.train import fit
from ddgrasp.artifacts import Artifact
from ddgrasp.config import PROGRESSIVE, DDGConfig
from ddgrasp.depth import inverse_depth
from ddgrasp.files import atomic_write_bytes
from ddgrasp.job import Job
from ddgrasp.progress import Progress
from learning.params import Params
from sensors.statistics import stats

STAGE = "ddg"
SCORED_FRAMES = 180
"""Held-out frames, the last ones, on which the statistics are taken, at most."""
SHOWN_FRAMES = 4
_SAMPLE_SEED = 1


def run(job: Job) -> Artifact:
    """Fits (or loads, `config.ddg.init_from`) a generator: on the run's recordings, or on those at or below
    the folder that `ddgrasp ddg fit --data` names (input `data`).

    Leaves params.msgpack, pictures, and a manifest whose metrics compare held-out recorded frames with
    generated ones.
    """
    config, directory, progress = job.config, job.directory, job.progress
    root = job.inputs["data"] if "data" in job.inputs else job.parents["record"].directory
    prior = make_prior(config.ddg)
    read = root, config.ddg, prior, config.seed, progress
    if _fits(config.ddg):
        frames = data.load_frames(*read)
        training, held_out = frames.split(config.ddg.training.holdout_fraction)
    else:
        frames = held_out = data.load_held_out(*read)
        training = held_out.part(slice(0))
    generator = fitted_generator(config.ddg, prior, training, directory, config.seed, progress)
    scored = held_out.part(slice(-SCORED_FRAMES, None))
    metrics = {
        "prior": prior.name,
        "prior_source": prior.source,
        "frames": {
            "training": len(training),
            "held_out": len(held_out),
            "skipped": frames.skipped_frames,
            "refused_recordings": frames.refused_recordings,
        },
        **_score(generator, scored, progress),
    }
    return job.finish(metrics, origin="trained" if _fits(config.ddg) else "loaded")


def _fits(config: DDGConfig) -> bool:
    """Whether the stage trains anything: a network, or fewer evaluations for one that is loaded."""
    return not config.init_from or config.sampling.sampler == PROGRESSIVE


def sample_folder(
    directory: Path, root: Path, out: Path, *, seed: int, progress: Progress, count: int = SHOWN_FRAMES
) -> Path:
    """Writes one PNG: recorded frames of `root` beside what the generator in `directory` makes of their
    priors.

    Behind `ddgrasp ddg sample`. Returns the picture's path, `out`/samples.png.
    """
    generator = Generator.load(directory)
    frames = data.load_frames(root, generator.config, generator.prior, seed, progress)
    chosen = frames.part(np.linspace(0, len(frames) - 1, min(count, len(frames))).astype(int))
    panels = _panels(generator, chosen, seed)
    path = out / "samples.png"
    _write_png(path, panels)
    return path


def fitted_generator(
    config: DDGConfig, prior: Prior, frames: data.Frames, directory: Path, seed: int, progress: Progress,
    curve: str = "",
) -> Generator:  # fmt: skip
    """A generator fitted on all of `frames`, or the one that `config.init_from` names; distilled if its
    sampler is. Parameters and checkpoints go to `directory`, whence it continues; curves of the fit are named
    `curve` + scalar.
    """
    if config.sampling.sampler == PROGRESSIVE:
        check_halving(config)
    fitted = _loaded(config) if config.init_from else fit(config, frames, directory, seed, progress, curve)
    if config.init_from and (other := start.drawn_otherwise(config)):
        progress.note(other)
    generator = Generator(config, fitted, prior)
    generator.save(directory)
    if config.sampling.sampler != PROGRESSIVE:
        return generator
    return replace(generator, params=distil(config, fitted, frames, directory, seed, progress))


def _loaded(config: DDGConfig) -> Params:
    """Parameters of `config.init_from`'s fitted network, refused if network or depth space are others."""
    start.check(config)
    return Generator.load(start.folder(config), sampler="ddim").params


def _score(generator: Generator, frames: data.Frames, progress: Progress) -> dict[str, Any]:
    """Hole statistics of recorded and generated frames, on the priors of the recorded ones."""
    panels = _panels(generator, frames, _SAMPLE_SEED)
    shown = np.linspace(0, len(frames) - 1, min(SHOWN_FRAMES, len(frames))).astype(int)
    few = {title: panel[shown] for title, panel in panels.items()}
    progress.picture("ddg", **few)
    if progress.directory is not None:
        _write_png(progress.directory / "samples.png", few)
    return {
        name: {
            **hole_statistics(panels[name], frames.stretch),
            **deviation_statistics(panels[name], frames.surface_m),
        }
        for name in ("recorded", "generated")
    }


def _panels(generator: Generator, frames: data.Frames, seed: int) -> dict[str, np.ndarray]:
    """clean (holes filled), recorded, generated and grafted depth in metres, (N, H, W) each."""
    x = predict(jax.random.key(seed), generator, frames.prior, episode=frames.recording, frame=frames.number)
    made = grafted(generator.config, frames.surface_m, x)
    return {
        "clean": frames.surface_m,
        "recorded": frames.depth_m,
        "generated": made.predicted_m,
        "grafted": made.depth_m,
    }


def hole_statistics(depth_m: Float[np.ndarray, "N H W"], stretch: Int[np.ndarray, " N"]) -> dict[str, float]:
    """Share of invalid pixels, regions per frame, median region, left band and validity flicker of (N, H, W)
    metres; frames of one `stretch` (N,) follow each other.
    """
    holes = stats.hole_statistics(depth_m)
    return {**holes, "flicker_fraction": flicker_fraction(depth_m > 0, stretch)}


def flicker_fraction(valid: Bool[np.ndarray, "N H W"], stretch: Int[np.ndarray, " N"]) -> float:
    """Share of pixels that change validity between neighbouring frames of one stretch; valid (N, H, W),
    stretch (N,). nan if every frame is from another one.
    """
    same = stretch[1:] == stretch[:-1]
    return float(np.mean(stats.validity_changes(valid)[same])) if same.any() else float("nan")


def deviation_statistics(
    depth_m: Float[np.ndarray, "N H W"], surface_m: Float[np.ndarray, "N H W"]
) -> dict[str, float]:
    """Median and 99th percentile of |1/d - 1/d_surface| in 1/m, over valid pixels of (N, H, W) metres."""
    known = (depth_m > 0) & (surface_m > 0)
    if not known.any():
        return {"deviation_median_per_m": float("nan"), "deviation_p99_per_m": float("nan")}
    median, high = np.quantile(np.abs(inverse_depth(depth_m) - inverse_depth(surface_m))[known], [0.5, 0.99])
    return {"deviation_median_per_m": float(median), "deviation_p99_per_m": float(high)}


def _write_png(path: Path, panels: dict[str, np.ndarray]) -> None:
    """Panels as rows, frames as columns, coloured by inverse depth, holes black."""
    positive = np.concatenate([p[p > 0].ravel() for p in panels.values()])
    low, high = np.quantile(1 / positive, [0.01, 0.99])
    rows = []
    for title, panel in panels.items():
        row = np.hstack([_coloured(frame, low, high) for frame in panel])
        cv2.putText(row, title, (6, 16), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
        rows.append(row)
    ok, png = cv2.imencode(".png", np.vstack(rows))
    assert ok
    atomic_write_bytes(path, png.tobytes())


def _coloured(depth_m: np.ndarray, low: float, high: float) -> np.ndarray:
    inverse = 1 / np.maximum(depth_m, 1e-6)
    level = np.clip((inverse - low) / (high - low + 1e-9), 0, 1)
    picture = cv2.applyColorMap((255 * level).astype(np.uint8), cv2.COLORMAP_TURBO)
    picture[depth_m <= 0] = 0
    return picture
