"""Stage `samplers`: what fewer network evaluations cost. Behind `ddgrasp ddg samplers`.

One fitted generator, every sampler it has, the same simulated episodes: distance to recorded depth, holes,
and frames per second from clean to grafted depth (meant for a machine that does nothing else). Samplers are
scored one by one and episode by episode: what was finished is kept.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ddgrasp import artifacts
from ddgrasp.artifacts import Artifact
from ddgrasp.config import PROGRESSIVE
from ddgrasp.depth import to_metres
from ddgrasp.files import atomic_write_json
from ddgrasp.job import Job
from evaluation.depth_score import data as score_data
from evaluation.depth_score import features as score_features
from evaluation.depth_score import holes
from evaluation.depth_score import table as score_table
from evaluation.depth_score.domains import FLOOR, RAW, REFERENCES, Methods
from evaluation.depth_score.episodes import Load, Scored, collect, score_episodes

if TYPE_CHECKING:
    import ddg_jax.sample

JSON = "samplers.json"
REFERENCE = ("ddim", 50)
PLAIN = (REFERENCE, ("ddim", 10), ("ddim", 4), ("dpm_solver", 8), ("dpm_solver", 4))
"""Beside the generator's own; DDIM with its `ddg.sampling.eta`."""
TARGET = 1.1
"""FID of a sampler of at most 4 evaluations over that of REFERENCE."""
TIMED_FRAMES = 64
_DDG = "sim_ddg"


def run(job: Job) -> Artifact:
    """Scores every sampler of the generator."""
    directory, progress, fitted = job.directory, job.progress, job.parents["ddg"].directory
    config = replace(job.config, score=replace(job.config.score, columns=("sim_gt", "ddg")))
    extractor = score_features.load(config.score.features[0])  # before hours: it may not be there
    generators = dict(_generators(fitted))
    start = Methods(config.score, config.seed, generators[_name(*REFERENCE)])
    files = score_data.record_rig(
        config, job.parents["teacher"].directory, directory / "data", start.needs_rgb, progress
    )
    loads = [partial(score_data.load_episode, file) for file in files]
    known = score_episodes(start, [extractor], loads, [RAW, FLOOR, "sim_gt"], directory / "known", progress)
    common, simulated = collect(known), loads[len(loads) // 2 :]
    rows, floor = {}, {}
    for name, generator in generators.items():
        progress.note(name)
        methods = Methods(config.score, config.seed, generator)
        folder = directory / name.replace(" ", "_")
        made = collect(score_episodes(methods, [extractor], simulated, [_DDG], folder, progress, label=name))
        samples = {**common.features[extractor.name], **made.features[extractor.name]}
        compared = score_table.make_table(samples, config.score, config.seed, progress)
        rows[name] = _row(compared["ddg"], made, _DDG)
        rows[name]["frames_per_s"] = _frames_per_s(generator, simulated)
        floor = _row(compared["floor"], common, FLOOR)
    for row in rows.values():
        row["over_reference"] = row["fid"]["value"] / rows[_name(*REFERENCE)]["fid"]["value"]
    result = {"features": {extractor.name: extractor.source}, "floor": floor, "samplers": rows}
    atomic_write_json(directory / JSON, result)
    return job.finish({"samplers": table(rows, floor), "targets": [_target(rows)]})


def _generators(directory: Path) -> Iterator[tuple[str, "ddg_jax.sample.Generator"]]:
    """Name -> the fitted generator with that sampler, also with its own; distilled ones as far as they were
    made."""
    from ddg_jax.sample import Generator

    own = artifacts.config_from_json(artifacts.read_manifest(directory).config).ddg.sampling
    for sampler, steps in dict.fromkeys((*PLAIN, (own.sampler, own.steps))):
        if sampler != PROGRESSIVE:
            yield _name(sampler, steps), Generator.load(directory, sampler, steps)
    for file in sorted(directory.glob("distilled_*.msgpack"), reverse=True):
        steps = int(file.stem.split("_")[1])
        yield _name(PROGRESSIVE, steps), Generator.load(directory, PROGRESSIVE, steps)


def _name(sampler: str, steps: int) -> str:
    return f"{sampler} {steps}"


def _row(figures: dict[str, Any], scored: Scored, domain: str) -> dict[str, Any]:
    plain = {name: value for name, value in figures.items() if name != "resampled_fid"}
    return {**plain, "holes": holes.figures(holes.added(scored.sums[domain]))}


def _frames_per_s(generator: "ddg_jax.sample.Generator", loads: Sequence[Load]) -> float:
    """Speed of `ddg_jax.sample.generate` on TIMED_FRAMES frames, compiled before."""
    import jax

    from ddg_jax.sample import generate

    episodes = [load() for load in loads[: TIMED_FRAMES // len(loads[0]().clean_mm) + 1]]
    depth_m = to_metres(np.concatenate([e.clean_mm for e in episodes])[:TIMED_FRAMES])
    colours = [e.rgb for e in episodes if e.rgb is not None]
    rgb = np.concatenate(colours)[:TIMED_FRAMES] if colours else None
    generate(jax.random.key(0), generator, depth_m, rgb)
    begun = time.perf_counter()
    generate(jax.random.key(1), generator, depth_m, rgb)
    return len(depth_m) / (time.perf_counter() - begun)


def table(rows: dict[str, Any], floor: dict[str, Any]) -> list[dict[str, str]]:
    """The rows as text; the last one is recorded depth against recorded depth."""
    return [
        {
            "sampler": name, "FID": score_table.describe(row["fid"]),
            "FID / Sim GT's": score_table.describe(row["fid_ratio"]),
            f"over {_name(*REFERENCE)}": f"{row['over_reference']:.2f}" if "over_reference" in row else "",
            "KID x 100": score_table.describe(row["kid_x100"]),
            "hole regions per frame": f"{row['holes']['components_per_frame']:.1f}",
            "invalid pixels": f"{100 * row['holes']['invalid_share']:.2f} %",
            "flicker": f"{100 * row['holes']['flicker']:.2f} %",
            "frames/s": f"{row['frames_per_s']:.1f}" if "frames_per_s" in row else "",
        }
        for name, row in (rows | {REFERENCES["floor"].title: floor}).items()
    ]  # fmt: skip


def _target(rows: dict[str, Any]) -> dict[str, str]:
    few = {name: row["over_reference"] for name, row in rows.items() if int(name.split()[1]) <= 4}
    best = min(few, key=lambda name: few[name])
    return {
        "target": f"at most 4 evaluations: FID <= {TARGET} of 50 steps'",
        "measured": f"{best}: {few[best]:.2f}",
        "met": "met" if few[best] <= TARGET else "not met",
    }
