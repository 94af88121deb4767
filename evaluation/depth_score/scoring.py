"""Scores all episodes of a setting and writes every output: what stages `score` and `score_real` share.

Leaves score.json (everything), score.html, and pictures/*.png.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ddgrasp.artifacts import Artifact
from ddgrasp.config import Config
from ddgrasp.files import atomic_write_bytes, atomic_write_json, atomic_write_text
from ddgrasp.job import Job
from ddgrasp.progress import PICTURES, Progress
from evaluation.depth_score import figures as score_figures
from evaluation.depth_score import table as score_table
from evaluation.depth_score import two_samples
from evaluation.depth_score.domains import COLUMNS, DOMAINS, Methods, wanted_domains
from evaluation.depth_score.episodes import Load, Scored, collect, score_episodes
from evaluation.depth_score.features import FeatureExtractor
from evaluation.depth_score.page import HTML, JSON, render, summary
from evaluation.report.figures import draw_panels

_EMBED_SEED = 0


def score_setting(
    job: Job, text: str, resampled: str, methods: Methods, extractors: Sequence[FeatureExtractor],
    loads: Sequence[Load],
) -> Artifact:  # fmt: skip
    """Scores the episodes behind `loads`. Ends the stage.

    Args:
      text: what is compared, for people.
      resampled: what an episode is, of which the bootstrap draws.
      extractors: those of `config.score.features`.
    """
    config, directory, progress = job.config, job.directory, job.progress
    names = available_domains(methods)
    files = score_episodes(methods, extractors, loads, names, directory / "episodes", progress)
    scored = collect(files)
    result = evaluate(scored, config, text, resampled, progress)
    result["features"] = {extractor.name: extractor.source for extractor in extractors}
    pictures = _draw(scored, result, config, progress)
    atomic_write_json(directory / JSON, _without_draws(result))
    for name, png in pictures.items():
        atomic_write_bytes(directory / PICTURES / f"{name}.png", png)
    atomic_write_text(directory / HTML, render(result, pictures))
    return job.finish(summary(result))


def available_domains(methods: Methods) -> list[str]:
    """Domains of the configured columns, those of the monocular network only if its weights are there."""
    names = wanted_domains(methods.config.columns)
    if "monocular" in methods.config.columns and methods.monocular is None:
        return [name for name in names if not name.endswith("monocular")]
    return names


def evaluate(scored: Scored, config: Config, text: str, resampled: str, progress: Progress) -> dict[str, Any]:
    """All numbers: a table per extractor, hole-level figures, targets judged by the first extractor."""
    tables = {}
    for name in config.score.features:
        tables[name] = score_table.make_table(scored.features[name], config.score, config.seed, progress)
    first = tables[config.score.features[0]]
    samples = scored.features[config.score.features[0]]
    return {
        "setting": text,
        "resampled": resampled,
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
