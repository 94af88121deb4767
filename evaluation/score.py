"""Stages `score` and `score_real`: is generated depth what a camera records? Table I, hole measures, t-SNE.

Behind `ddgrasp ddg score`. Writes score.json (everything), score.html, and pictures/*.png.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ddgrasp import artifacts
from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.errors import UserError
from ddgrasp.progress import PICTURES, Progress
from evaluation import score_data, score_features, score_figures, score_table, two_samples
from evaluation.figures import draw_panels
from evaluation.score_domains import COLUMNS, DOMAINS, Methods, wanted_domains
from evaluation.score_episodes import Load, Scored, collect, score_episodes
from evaluation.score_page import HTML, JSON, render, summary

if TYPE_CHECKING:
    from ddg_jax.sample import Generator

STAGE, STAGE_REAL = "score", "score_real"
_EMBED_SEED = 0

RIG_SETTING = (
    "Pseudo-real rig. Recorded depth: {n} trajectories that nothing was trained on. Simulated: clean "
    "geometry of {n} other trajectories of the same teacher, with the same spread of cameras: the distance "
    "of Sim GT is the sensor's share alone. Real vs real: what the rig's camera recorded of those others."
)
REAL_SETTING = (
    "{root}: fitted on the first {fit} frames, scored on the last {score}. Nobody modelled that room: its "
    "geometry is the recorded depth of the odd frames, holes filled, made piecewise smooth "
    "(ddg_jax/piecewise.py); recorded depth is the even frames, a frame earlier. So the layout is the same "
    "on both sides, and errors of valid pixels are relative to that stand-in."
)


@dataclass(frozen=True)
class Setting:
    """What a score is about: text for people, and what was made of which files."""

    text: str
    config: Config
    directory: Path


def run(config: Config, run_dir: Path, out: Path, *, progress: Progress) -> Artifact:
    """Scores the generator in `run_dir`/ddg on new trajectories of the rig; works in `out`/score."""
    from ddg_jax.sample import Generator

    directory = out / STAGE
    methods = Methods(config.score, config.seed, Generator.load(run_dir / "ddg"))
    files = score_data.record_rig(config, run_dir, directory / "data", methods.needs_rgb, progress)
    loads = [partial(score_data.load_episode, file) for file in files]
    setting = Setting(RIG_SETTING.format(n=config.score.trajectories), config, directory)
    parents = [artifacts.read_artifact(run_dir / name) for name in ("teacher", "ddg")]
    return _finish(STAGE, setting, methods, loads, parents, progress)


def real_config(config: Config, root: Path) -> Config:
    """`config` with the generator's rows those of the recordings below `root`: nothing is cropped."""
    rows, _ = score_data.real_size(root, config.ddg.width_px)
    return replace(config, ddg=replace(config.ddg, height_px=rows))


def run_real(
    config: Config, root: Path, fit_frames: int, score_frames: int, out: Path, *, progress: Progress
) -> Artifact:
    """Fits a generator on the first frames of the recordings below `root` and scores it on the last ones.

    `config` is one of `real_config`.
    """
    directory = out / STAGE_REAL
    least = 4 * score_data.BLOCK_FRAMES
    if score_frames < least:
        raise UserError(f"--score-frames is {score_frames}; expected {least} or more: two blocks per side.")
    frames = score_data.load_real(root, config.ddg.width_px, score_frames)
    if fit_frames < 2 or fit_frames + score_frames > frames.total:
        raise UserError(
            f"--fit-frames {fit_frames} and --score-frames {score_frames} of {frames.total} frame(s): "
            "they must not overlap, and fitting needs 2 or more."
        )
    fitted = _fit_real(config, root, fit_frames, directory / "ddg", progress)
    methods = Methods(config.score, config.seed, fitted)
    episodes = score_data.real_episodes(frames, methods.needs_rgb)
    loads: list[Load] = [partial(lambda e: e, episode) for episode in episodes]
    text = REAL_SETTING.format(root=root.name, fit=fit_frames, score=score_frames)
    parents = [artifacts.read_artifact(directory / "ddg")]
    return _finish(STAGE_REAL, Setting(text, config, directory), methods, loads, parents, progress)


def _fit_real(
    config: Config, root: Path, fit_frames: int, directory: Path, progress: Progress
) -> "Generator":
    """The generator fitted on the first frames, or the finished one."""
    from ddg_jax.data import load_frames
    from ddg_jax.prior import make_prior
    from ddg_jax.sample import Generator
    from ddg_jax.stage import fitted_generator

    if not artifacts.is_finished(directory):
        prior = make_prior(config.ddg)
        frames = load_frames(root, config.ddg, prior, config.seed, progress, max_frames=fit_frames)
        fitted_generator(config.ddg, prior, frames, directory, config.seed, progress)
        metrics = {"frames": {"training": len(frames)}}
        artifacts.finish(directory, "ddg", config, seconds=progress.seconds, metrics=metrics)
    return Generator.load(directory)


def _finish(
    stage: str, setting: Setting, methods: Methods, loads: Sequence[Load], parents: Sequence[Artifact],
    progress: Progress,
) -> Artifact:  # fmt: skip
    """Scores all episodes, writes every output, and the manifest last."""
    config, directory = setting.config, setting.directory
    extractors = [score_features.load(name) for name in config.score.features]
    names = available_domains(methods)
    files = score_episodes(methods, extractors, loads, names, directory / "episodes", progress)
    scored = collect(files)
    result = evaluate(scored, config, setting.text, progress)
    result["features"] = {extractor.name: extractor.source for extractor in extractors}
    pictures = _draw(scored, result, config, progress)
    artifacts.atomic_write_json(directory / JSON, _without_draws(result))
    for name, png in pictures.items():
        artifacts.atomic_write_bytes(directory / PICTURES / f"{name}.png", png)
    artifacts.atomic_write_text(directory / HTML, render(result, pictures))
    return artifacts.finish(
        directory, stage, config, seconds=progress.seconds, metrics=summary(result), parents=parents
    )


def available_domains(methods: Methods) -> list[str]:
    """Domains of the configured columns, those of the monocular network only if its weights are there."""
    names = wanted_domains(methods.config.columns)
    if "monocular" in methods.config.columns and methods.monocular is None:
        return [name for name in names if not name.endswith("monocular")]
    return names


def evaluate(scored: Scored, config: Config, text: str, progress: Progress) -> dict[str, Any]:
    """All numbers: a table per extractor, hole-level figures, targets judged by the first extractor."""
    tables = {}
    for name in progress.track(config.score.features, "distances"):
        tables[name] = score_table.make_table(scored.features[name], config.score, config.seed)
    first = tables[config.score.features[0]]
    samples = scored.features[config.score.features[0]]
    return {
        "setting": text,
        "maps": {name: len(sample.features) for name, sample in samples.items()},
        "tables": tables,
        "targets": score_table.targets(first),
        "holes": score_table.hole_figures(scored, config.score.bootstrap, config.seed),
    }


def _draw(scored: Scored, result: dict[str, Any], config: Config, progress: Progress) -> dict[str, bytes]:
    """Picture name -> PNG. Notes in `result` how many maps the t-SNE has of each domain."""
    first = config.score.features[0]
    own = result["tables"][first]
    pictures = {
        f"table_1_{name.replace('-', '_')}": score_figures.draw_table(
            score_table.distance_rows(value), f"Distance to recorded depth, features {name}"
        )
        for name, value in result["tables"].items()
    }
    pictures["examples"] = draw_panels(_examples(scored))
    pictures["holes"] = score_figures.draw_holes(result["holes"])
    paired = {domain for name in config.score.columns for domain in vars(COLUMNS[name]).values()}
    shown = {name: sample for name, sample in scored.features[first].items() if name in paired}
    share = max(2, config.score.tsne_maps // len(shown))
    thin = {name: _spread(sample.features, share) for name, sample in shown.items()}
    progress.note(f"t-SNE of {sum(map(len, thin.values()))} maps")
    result["tsne_maps"] = {name: len(f) for name, f in thin.items()}
    flat = two_samples.embed(thin, _EMBED_SEED)
    floor = own["floor"]["mixing"]["value"]
    pictures["tsne"] = score_figures.draw_embedding(flat, own, floor)
    return pictures


def _spread(rows: np.ndarray, count: int) -> np.ndarray:
    """At most `count` rows, evenly spread."""
    return rows[np.linspace(0, len(rows) - 1, min(count, len(rows))).round().astype(int)]


def _examples(scored: Scored) -> dict[str, np.ndarray]:
    """Title -> (N, H, W) maps in mm of every domain; those of one side show the same moments."""
    names = [name for name in DOMAINS if name in scored.examples]
    count = min(len(scored.examples[name]) for name in names)
    return {DOMAINS[name].title: np.stack(scored.examples[name][:count]) for name in names}


def _without_draws(result: Mapping[str, Any]) -> dict[str, Any]:
    """For the file: resampled values served the ratios and go."""

    def cleaned(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: cleaned(item) for key, item in value.items() if key != "resampled_fid"}
        return value

    return cleaned(result)
