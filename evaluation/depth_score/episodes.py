"""Scores episode by episode: every domain's maps become features and hole sums, which are kept; maps are not.

One file per episode, written when complete: a run that was stopped goes on with the next episode.
"""

from collections import Counter
from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt16

from ddgrasp.depth import to_metres
from ddgrasp.files import atomic_path, read_npz
from ddgrasp.progress import Progress
from evaluation.depth_score import holes
from evaluation.depth_score.data import MADE_ANEW, Episode
from evaluation.depth_score.domains import DOMAINS, Methods, sense, sense_repeats
from evaluation.depth_score.features import FeatureExtractor
from evaluation.depth_score.resampling import Sample

EXAMPLES = 4
"""Episodes per side of which one frame of every domain is kept for a picture."""
_GROUP = "group"
Load = Callable[[], Episode]


@dataclass
class Scored:
    """What is known about every domain: extractor -> domain -> Sample; domain -> sums and group per episode;
    domain -> example maps (millimetres)."""

    features: dict[str, dict[str, Sample]] = field(default_factory=dict)
    sums: dict[str, list[holes.Sums]] = field(default_factory=dict)
    groups: dict[str, list[int]] = field(default_factory=dict)
    examples: dict[str, list[UInt16[np.ndarray, "H W"]]] = field(default_factory=dict)


def score_episodes(
    methods: Methods, extractors: Sequence[FeatureExtractor], episodes: Sequence[Load], names: Sequence[str],
    directory: Path, progress: Progress, label: str = "scoring episodes",
) -> list[Path]:  # fmt: skip
    """Files with what every episode says about the domains `names`; those there already are kept, unless they
    are about others: weights may have come, or gone, since."""
    files = [directory / f"{number:04d}.npz" for number in range(len(episodes))]
    had = {file: _domains(file) for file in files if file.exists()}
    done = [file in had and _is_about(had[file], names) for file in files]
    if stale := len(had) - sum(done):
        progress.note(f"{stale} episode(s) are scored again: what was there is about other columns")
    with progress.task(label, len(files)) as task:
        task.start_at(sum(done))
        seen = Counter[str]()
        for load, file, is_done in zip(episodes, files, done, strict=True):
            if is_done:
                seen.update(_sides(had[file]))
                continue
            episode = load()
            seen[episode.side] += 1
            arrays: dict[str, Any] = _score(
                methods, extractors, episode, names, seen[episode.side] <= EXAMPLES
            )
            with atomic_path(file) as path:
                np.savez(path, **arrays)
            task.advance()
    return files


def _domains(file: Path) -> set[str]:
    """What an episode's file is about."""
    return {key.split("|")[0] for key in read_npz(file, MADE_ANEW) if key != _GROUP}


def _sides(had: Set[str]) -> set[str]:
    return {DOMAINS[name].side for name in had if name in DOMAINS}


def _is_about(had: Set[str], names: Sequence[str]) -> bool:
    """Whether a file about `had` has all those domains `names` that are of its side, and no others."""
    sides = _sides(had)
    return had == {name for name in names if DOMAINS[name].side in sides}


def _score(
    methods: Methods, extractors: Sequence[FeatureExtractor], episode: Episode, names: Sequence[str],
    example: bool,
) -> dict[str, np.ndarray]:  # fmt: skip
    clean_m = to_metres(episode.clean_mm)
    places = [holes.geometry(frame, episode.focal_px) for frame in clean_m]
    arrays: dict[str, np.ndarray] = {_GROUP: np.array(episode.group)}
    for name, depth_mm in sense(methods, episode, names).items():
        depth_m = to_metres(depth_mm)
        arrays.update({f"{name}|features|{e.name}": e(depth_m) for e in extractors})
        sums = holes.episode_sums(depth_m, clean_m, places)
        arrays.update({f"{name}|sums|{key}": value for key, value in sums.items()})
        if example:
            arrays[f"{name}|example|"] = depth_mm[len(depth_mm) // 2]
    for name, depth_mm in sense_repeats(methods, episode, names).items():
        sums = holes.repeat_sums(to_metres(depth_mm))
        arrays.update({f"{name}|sums|{key}": value for key, value in sums.items()})
    return arrays


def collect(files: Sequence[Path]) -> Scored:
    """Everything in the files of `score_episodes`; UserError if one is damaged."""
    scored = Scored()
    features: dict[tuple[str, str], list[np.ndarray]] = {}
    for file in files:
        arrays = read_npz(file, MADE_ANEW)
        group, sums = int(arrays.pop(_GROUP)), {}
        for key, value in arrays.items():
            name, kind, what = key.split("|")
            if kind == "features":
                features.setdefault((what, name), []).append(value)
            elif kind == "sums":
                sums.setdefault(name, {})[what] = value
            else:
                scored.examples.setdefault(name, []).append(value)
        for name, item in sums.items():
            scored.sums.setdefault(name, []).append(item)
            scored.groups.setdefault(name, []).append(group)
    for (extractor, name), parts in features.items():
        rows = np.repeat(scored.groups[name], [len(part) for part in parts])
        scored.features.setdefault(extractor, {})[name] = Sample(np.concatenate(parts), rows)
    return scored
