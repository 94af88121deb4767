"""What the mask's threshold decides: holes and the error of what is left, over thresholds (paper III-B2).

    ddgrasp ddg thresholds --model runs/a/ddg --data runs/a/record --out runs/a

One set of generated maps is masked with every threshold and compared with the recorded frames whose priors it
was made from.
"""

import io
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import jax
import numpy as np
from matplotlib.figure import Figure

from ddg_jax import data, normalise
from ddg_jax.graft import artefact_mask, graft_mask
from ddg_jax.prior import invert
from ddg_jax.sample import Generator, predict
from ddg_jax.stage import hole_statistics
from ddgrasp import artifacts
from ddgrasp.progress import Progress
from sensors.holes import fill_from_background

THRESHOLDS = tuple(round(-0.9 + 0.1 * i, 1) for i in range(9))
FILE = "thresholds"


@dataclass(frozen=True)
class Masked:
    """Frames masked with one threshold, beside the recorded ones."""

    threshold: float
    invalid_fraction: float
    hole_components: float
    """Regions per frame."""
    flicker_fraction: float
    """Pixels that change validity from frame to frame."""
    hole_iou: float
    """Generated and recorded holes: intersection over union."""
    valid_error_mm: float
    """Mean |d_pred - d_clean| where M = 0: what is kept without grafting."""
    valid_error_p99_mm: float
    grafted_error_mm: float
    """Largest |d_final - d_clean| where M = 0: 0 by the paper's equation."""


def masked(
    x: np.ndarray, frames: data.Frames, clean_m: np.ndarray, threshold: float, near_m: float, far_m: float
) -> Masked:
    """Statistics of maps x (N, H, W) in diffusion space on clean_m (N, H, W), the scenes of `frames`."""
    mask = np.asarray(artefact_mask(x, threshold))
    predicted = np.asarray(normalise.to_depth(x, near_m, far_m, threshold))
    final = np.asarray(graft_mask(clean_m, predicted, mask))
    holes = hole_statistics(np.where(mask, 0.0, 1.0), frames.recording)
    recorded = frames.depth_m == 0
    known = ~mask & (clean_m > 0)
    error_mm = 1000 * np.abs(predicted - clean_m)[known]
    return Masked(
        threshold,
        holes["invalid_fraction"],
        holes["hole_components"],
        holes["flicker_fraction"],
        float(np.sum(mask & recorded) / max(1, np.sum(mask | recorded))),
        float(np.mean(error_mm)),
        float(np.quantile(error_mm, 0.99)),
        float(1000 * np.max(np.abs(final - clean_m)[~mask], initial=0.0)),
    )


def analyse(
    model: Path, root: Path, out: Path, progress: Progress, *, count: int = 180, seed: int = 1
) -> list[Masked]:
    """Writes `out`/thresholds.json and .png for the last `count` frames of the recordings at or below `root`.

    Those the model was fitted on are at the front (`DDGConfig.holdout_fraction`).
    """
    generator = Generator.load(model)
    config = generator.config
    frames = data.load_frames(root, config, generator.prior, seed, progress).part(slice(-count, None))
    x = predict(jax.random.key(seed), generator, frames.prior, episode=frames.recording, frame=frames.number)
    clean_m = np.stack([invert(fill_from_background(frame)) for frame in invert(frames.depth_m)])
    rows = [masked(x, frames, clean_m, t, config.near_m, config.far_m) for t in THRESHOLDS]
    recorded = hole_statistics(frames.depth_m, frames.recording)
    value = {"recorded": recorded, "used": config.noise_threshold, "thresholds": [asdict(r) for r in rows]}
    artifacts.atomic_write_json(out / f"{FILE}.json", value)
    artifacts.atomic_write_bytes(out / f"{FILE}.png", _drawn(rows, recorded, config.noise_threshold))
    return rows


def table(rows: Sequence[Masked]) -> str:
    """The rows as text."""
    titles = {
        "threshold": "{:.1f}", "invalid_fraction": "{:.3f}", "hole_components": "{:.0f}",
        "flicker_fraction": "{:.4f}", "hole_iou": "{:.3f}", "valid_error_mm": "{:.1f}",
        "valid_error_p99_mm": "{:.1f}", "grafted_error_mm": "{:.1f}",
    }  # fmt: skip
    lines = ["  ".join(titles)]
    for row in rows:
        cells = (f"{form.format(getattr(row, name)):>{len(name)}}" for name, form in titles.items())
        lines.append("  ".join(cells))
    return "\n".join(lines)


def _drawn(rows: Sequence[Masked], recorded: dict[str, float], used: float) -> bytes:
    """PNG: holes, regions, flicker and error over the threshold; dashed: recorded; dotted: the one in use."""
    shown = {
        "invalid_fraction": "invalid pixels", "hole_components": "holes per frame",
        "flicker_fraction": "validity flicker", "valid_error_mm": "error of valid pixels, mm (not grafted)",
    }  # fmt: skip
    figure = Figure(figsize=(11, 2.8), layout="constrained")
    for axis, (name, title) in zip(figure.subplots(1, len(shown)), shown.items(), strict=True):
        axis.plot([row.threshold for row in rows], [getattr(row, name) for row in rows], marker="o")
        if name in recorded:
            axis.axhline(recorded[name], linestyle="--", color="black")
        axis.axvline(used, linestyle=":", color="grey")
        axis.set_ylim(bottom=0)
        axis.set_title(title, fontsize=9)
        axis.set_xlabel("threshold")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
