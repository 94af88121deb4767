"""Stage `curve`: how many recorded trajectories the generator needs. Behind `ddgrasp ddg curve`.

A generator per size is fitted on the first n trajectories, all for as many steps, and scored on the same
frames, by the same sampler. Points are finished one by one: a stopped curve goes on inside the point it
stopped in.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ddgrasp.artifacts import Artifact
from ddgrasp.config import DPM_SOLVER, Config
from ddgrasp.files import atomic_write_bytes, atomic_write_json, read_json, to_json
from ddgrasp.job import Job
from ddgrasp.progress import PICTURES, Progress
from evaluation.depth_score import data as score_data
from evaluation.depth_score import features as score_features
from evaluation.depth_score import figures as score_figures
from evaluation.depth_score import table as score_table
from evaluation.depth_score.domains import FLOOR, RAW, Methods
from evaluation.depth_score.episodes import Load, collect, score_episodes
from evaluation.depth_score.resampling import Sample

if TYPE_CHECKING:
    import ddg_jax.data
    import ddg_jax.sample

JSON = "curve.json"
POINT = "point.json"
COLUMNS = ("sim_gt", "ddg_no_graft", "ddg")
EVALUATIONS = 8
"""Evaluations of the second-order sampler: what is compared is the fit, so no point is distilled."""


def run(job: Job) -> Artifact:
    """Fits and scores at every size of `config.score.curve_trajectories`; a fit each.

    Recordings come from the stage record; those that it lacks are recorded as it would have been.
    """
    from ddg_jax.sample import Generator

    directory, progress = job.directory, job.progress
    sizes = sorted(set(job.config.score.curve_trajectories))
    config = replace(job.config, score=replace(job.config.score, columns=COLUMNS))
    extractor = score_features.load(config.score.features[0])  # before hours: it may not be there
    start = Methods(config.score, config.seed, Generator.load(job.parents["ddg"].directory))
    files = score_data.record_rig(
        config, job.parents["teacher"].directory, directory / "data", start.needs_rgb, progress
    )
    loads = [partial(score_data.load_episode, file) for file in files]
    reference = score_episodes(
        start, [extractor], loads, [RAW, FLOOR, "sim_gt"], directory / "reference", progress
    )
    common = collect(reference).features[extractor.name]
    frames = _frames(config, job.parents, max(sizes), directory / "record", progress)
    points = []
    for size in sizes:
        progress.note(f"{size} trajectories")
        points.append(_point(config, size, frames, common, extractor, loads, directory, progress))
    result = {"features": {extractor.name: extractor.source}, "points": points}
    atomic_write_json(directory / JSON, result)
    floor, base = points[0]["floor"], points[0]["sim_gt"]["fid"]["value"]
    picture = score_figures.draw_efficiency(points, floor, base)
    atomic_write_bytes(directory / PICTURES / "curve.png", picture)
    return job.finish({"points": rows(points)})


def rows(points: Sequence[dict[str, Any]]) -> list[dict[str, str]]:
    """The curve as text, one record per size."""
    return [
        {"trajectories": str(p["trajectories"]), "frames": str(p["frames"]), "steps": str(p["steps"]),
         **{f"{p[name]['title']}, {title}": score_table.describe(p[name][key])
            for name in (*COLUMNS[1:], "floor")
            for key, title in (("fid", "FID"), ("kid_x100", "KID x 100"))}}
        for p in points
    ]  # fmt: skip


def _point(
    config: Config, size: int, frames: "ddg_jax.data.Frames", common: dict[str, Sample],
    extractor: score_features.FeatureExtractor, loads: Sequence[Load], directory: Path, progress: Progress,
) -> dict[str, Any]:  # fmt: skip
    """One point: read if it was finished, else fitted and scored."""
    folder = directory / f"n{size:03d}"
    if (folder / POINT).exists():
        return read_json(folder / POINT)
    chosen = frames.part(slice(int(np.searchsorted(frames.recording, size))))  # views: sorted by recording
    generator = _fitted(config, chosen, folder, progress)
    methods = Methods(config.score, config.seed, generator)
    simulated = loads[len(loads) // 2 :]  # the real side comes first and needs no generator
    files = score_episodes(
        methods, [extractor], simulated, ["sim_ddg_no_graft", "sim_ddg"], folder / "episodes", progress
    )
    samples = {**common, **collect(files).features[extractor.name]}
    table = score_table.make_table(samples, config.score, config.seed, progress)
    for figures in table.values():
        figures.pop("resampled_fid", None)
    point = {"trajectories": size, "frames": len(chosen), "steps": generator.config.training.steps, **table}
    atomic_write_json(folder / POINT, point)
    return to_json(point)


def _fitted(
    config: Config, frames: "ddg_jax.data.Frames", folder: Path, progress: Progress
) -> "ddg_jax.sample.Generator":
    """A generator fitted on `frames`, from its checkpoints if there are any."""
    from ddg_jax.prior import make_prior
    from ddg_jax.stage import fitted_generator

    steps = config.score.curve_steps or config.ddg.training.steps
    settings = replace(
        config.ddg,
        training=replace(config.ddg.training, steps=steps),
        init_from="",
        sampling=replace(
            config.ddg.sampling, sampler=DPM_SOLVER, steps=EVALUATIONS, spacing="quadratic"
        ),  # as the published curve has it; a second-order sampler leaves specks with linspace steps
    )
    return fitted_generator(
        settings, make_prior(settings), frames, folder, config.seed, progress, f"{folder.name}/"
    )


def _frames(
    config: Config, parents: Mapping[str, Artifact], count: int, extra: Path, progress: Progress
) -> "ddg_jax.data.Frames":
    """Frames of `count` trajectories: the run's, then more from the same teacher, recorded into `extra`."""
    from ddg_jax.data import Frames, load_frames
    from ddg_jax.prior import make_prior
    from sensors.recordings.recording import find_recordings

    record = parents["record"].directory
    recorded = len(find_recordings(record))
    as_the_run = replace(config, seed=parents["record"].manifest.seed)
    _record_more(as_the_run, parents["teacher"].directory, range(recorded, count), extra, progress)
    prior = make_prior(config.ddg)
    roots = [record, *([extra] if count > recorded else [])]
    parts = [load_frames(root, config.ddg, prior, config.seed, progress) for root in roots]
    if len(parts) == 1:
        return parts[0]
    offsets = np.cumsum([0, recorded])[: len(parts)]
    return Frames(
        np.concatenate([part.depth_m for part in parts]),
        np.concatenate([part.surface_m for part in parts]),
        np.concatenate([part.prior for part in parts]),
        np.concatenate([part.recording + offset for part, offset in zip(parts, offsets, strict=True)]),
    )


def _record_more(config: Config, teacher: Path, numbers: range, directory: Path, progress: Progress) -> None:
    """Trajectories that the run's record stage would have recorded next; finished ones are kept."""
    from rig.stage import record_all
    from sensors.recordings.recording import is_recording

    folders = [(number, directory / f"rig_{number:04d}") for number in numbers]
    missing = [(number, folder) for number, folder in folders if not is_recording(folder)]
    with progress.task("more trajectories", len(missing)) as task:
        for _ in record_all(config, teacher, missing):
            task.advance()
