"""What the mask's threshold decides: holes and the error of what is left, over thresholds (paper III-B2).

    ddgrasp ddg thresholds --model runs/a/ddg --data runs/a/record --out runs/a

One set of generated maps is masked with every threshold and compared with the recorded frames whose priors it
was made from.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ddg_jax import data
from ddg_jax.sample import Generator, grafted, predict
from ddg_jax.stage import SCORED_FRAMES, hole_statistics
from ddgrasp import artifacts
from ddgrasp.config import DEPTH, DDGConfig
from ddgrasp.files import atomic_write_bytes, atomic_write_json, to_png
from ddgrasp.progress import Progress
from ddgrasp.shipped import shipped

THRESHOLDS = tuple(round(-0.9 + 0.1 * i, 1) for i in range(9))
"""Between holes (-1) and surfaces (0 to 1, representation depth)."""
WIDE_THRESHOLDS = tuple(round(-0.8 + 0.2 * i, 1) for i in range(9))
"""Between holes (-1) and surfaces (1, representation deviation)."""
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
    """Mean |d_pred - d_clean| of pixels that are no holes: the error without grafting."""
    valid_error_p99_mm: float
    grafted_error_mm: float
    """Largest |d_final - d_clean| where M = 0: 0 by the paper's equation."""


def masked(
    config: DDGConfig, x: Float[np.ndarray, "N H W C"], frames: data.Frames, threshold: float
) -> Masked:
    """Statistics of maps x (N, H, W, C) on the surfaces of `frames`."""
    clean_m = frames.surface_m
    made = grafted(replace(config, graft=replace(config.graft, noise_threshold=threshold)), clean_m, x)
    mask = made.predicted_m == 0
    holes = hole_statistics(np.where(mask, 0.0, 1.0), frames.stretch)
    recorded = frames.depth_m == 0
    known = ~mask & (clean_m > 0)
    error_mm = 1000 * np.abs(made.predicted_m - clean_m)[known] if known.any() else np.array([np.nan])
    return Masked(
        threshold,
        holes["invalid_fraction"],
        holes["hole_components"],
        holes["flicker_fraction"],
        float(np.sum(mask & recorded) / max(1, np.sum(mask | recorded))),
        float(np.mean(error_mm)),
        float(np.quantile(error_mm, 0.99)),
        float(1000 * np.max(np.abs(made.depth_m - clean_m)[~made.mask], initial=0.0)),
    )


def analyse(
    model: Path, root: Path, out: Path, progress: Progress, *, count: int | None = None, seed: int = 1
) -> list[Masked]:
    """Writes `out`/thresholds.json and .png for the last `count` frames of the recordings at or below `root`.

    None takes those that the model, fitted on these recordings, was not fitted on: the last ones
    (`DDGConfig.training.holdout_fraction`), at most SCORED_FRAMES. Says so if there are others among them.
    """
    generator = Generator.load(model)
    config = generator.config
    frames = data.load_frames(root, config, generator.prior, seed, progress)
    frames = frames.part(slice(-_count(count, _held_out(model, len(frames)), progress), None))
    x = predict(jax.random.key(seed), generator, frames.prior, episode=frames.recording, frame=frames.number)
    thresholds = THRESHOLDS if config.depth.representation == DEPTH else WIDE_THRESHOLDS
    rows = [masked(config, x, frames, threshold) for threshold in thresholds]
    recorded = hole_statistics(frames.depth_m, frames.stretch)
    value = {
        "recorded": recorded,
        "used": config.graft.noise_threshold,
        "thresholds": [asdict(r) for r in rows],
    }
    atomic_write_json(out / f"{FILE}.json", value)
    atomic_write_bytes(out / f"{FILE}.png", _drawn(rows, recorded, config.graft.noise_threshold))
    return rows


def _held_out(model: Path, total: int) -> int | None:
    """How many of `total` frames the model was not fitted on, by its manifest; None if that does not say.

    `ddg score --real` fits on the first ones, and counts no others.
    """
    said = artifacts.read_manifest(shipped(model)).metrics.get("frames", {})
    left = total - said.get("training", total)
    return said.get("held_out", left if left > 0 else None)


def _count(asked: int | None, held_out: int | None, progress: Progress) -> int:
    count = asked or min(held_out or SCORED_FRAMES, SCORED_FRAMES)
    if held_out is None:
        progress.note(
            f"the model does not say which frames it was fitted on: they may be among the last {count}"
        )
    elif count > held_out:
        progress.note(
            f"--count {count} of {held_out} frame(s) held out: if the model was fitted on these "
            "recordings, the others are ones that it knows"
        )
    return count


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
    return to_png(figure, dpi=110)
