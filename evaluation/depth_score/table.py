"""Table I from what the episodes said: distances per column, hole-level figures per domain, targets."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ddgrasp.config import ScoreConfig
from ddgrasp.progress import Progress
from evaluation.depth_score import holes, two_samples
from evaluation.depth_score.domains import COLUMNS, DOMAINS, RAW, REFERENCES, Column
from evaluation.depth_score.episodes import Scored
from evaluation.depth_score.resampling import Sample, draws, interval, intervals

NO_WEIGHTS = "no weights"
RATIO_TARGET = 0.15
"""DDG's FID over Sim GT's; the paper's is 87.01 / 422.24 = 0.206."""
GRAFT_TARGET = 1.1
"""FID with grafting over FID without."""

Table = dict[str, Any]


def make_table(samples: Mapping[str, Sample], config: ScoreConfig, seed: int, progress: Progress) -> Table:
    """Column -> figures with intervals (see two_samples.compare), then the references that there are.

    The same resampled trajectories serve all columns, so that their ratios have intervals too. A column
    whose domains are missing says why.
    """
    drawn = _draw(samples, config, seed)
    columns = {n: COLUMNS[n] for n in config.columns}
    columns |= {n: c for n, c in REFERENCES.items() if c.sim in samples}
    table: Table = {
        n: _compare(columns[n], samples, config, drawn) for n in progress.track(list(columns), "distances")
    }
    base = table.get("sim_gt", {})
    for figures in table.values():
        if "fid" in figures and "fid" in base:
            figures["fid_ratio"] = _ratio(figures, base)
    return table


def _draw(
    samples: Mapping[str, Sample], config: ScoreConfig, seed: int
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Groups resampled on either side; the same ones where both sides show the same scenes."""
    rng = np.random.default_rng(seed)
    real, sim = samples[REFERENCES["floor"].real].groups, samples[REFERENCES["floor"].sim].groups
    drawn = draws(real, config.bootstrap, rng)
    paired = np.array_equal(np.unique(real), np.unique(sim))
    return list(zip(drawn, drawn if paired else draws(sim, config.bootstrap, rng), strict=True))


def _compare(
    column: Column, samples: Mapping[str, Sample], config: ScoreConfig, drawn: two_samples.Drawn
) -> Table:
    if column.real not in samples or column.sim not in samples:
        return {"title": column.title, "absent": NO_WEIGHTS}
    figures = two_samples.compare(samples[column.real], samples[column.sim], config, drawn)
    return {"title": column.title, "real": column.real, "sim": column.sim, **figures}


def _ratio(figures: Table, base: Table) -> dict[str, float]:
    resampled = np.asarray(figures["resampled_fid"]) / np.asarray(base["resampled_fid"])
    return interval(figures["fid"]["value"] / base["fid"]["value"], list(resampled), least=0.0)


# --- hole-level figures ----------------------------------------------------------------------------


def hole_figures(scored: Scored, bootstrap: int, seed: int) -> dict[str, Any]:
    """Domain -> figures with intervals, distances of its hole-rate curves from the recorded ones, curves."""
    rng = np.random.default_rng(seed)
    draws: dict[tuple[int, ...], list[np.ndarray]] = {}  # domains of the same scenes are drawn together
    made = {}
    for name in (RAW, *(n for n in DOMAINS if n in scored.sums and n != RAW)):
        mine, scenes = scored.sums[name], tuple(scored.groups[name])
        if scenes not in draws:
            draws[scenes] = [rng.integers(len(mine), size=len(mine)) for _ in range(bootstrap)]
        drawn = list(zip(draws[scenes], draws[tuple(scored.groups[RAW])], strict=True))
        made[name] = _domain_figures(mine, scored.sums[RAW], drawn)
    return made


def _domain_figures(
    mine: Sequence[holes.Sums], real: Sequence[holes.Sums], drawn: two_samples.Drawn
) -> dict[str, Any]:
    def figures(own: Sequence[holes.Sums], theirs: Sequence[holes.Sums]) -> dict[str, float]:
        total, reference = holes.added(own), holes.added(theirs)
        return {**holes.figures(total), **holes.gaps(total, reference)}

    resampled = [figures([mine[i] for i in o], [real[i] for i in t]) for o, t in drawn]
    curves = {name: list(values) for name, values in holes.curves(holes.added(mine)).items()}
    point = figures(mine, real)
    return {"figures": intervals(point, resampled, holes.bounds(point)), "curves": curves}


# --- targets ---------------------------------------------------------------------------------------


def targets(table: Table) -> list[dict[str, str]]:
    """Each target with what was measured and whether it is met."""
    present = {name: f for name, f in table.items() if name not in REFERENCES and "fid" in f}
    ranks = {key: sorted(present, key=lambda n: present[n][key]["value"]) for key in ("fid", "kid_x100")}
    order = [" < ".join(present[n]["title"] for n in names) for names in ranks.values()]
    measured_order = order if len(present) > 1 else [None, None]
    ddg, plain = present.get("ddg"), present.get("ddg_no_graft")
    graft = ddg["fid"]["value"] / plain["fid"]["value"] if ddg and plain else None
    rows = [
        (f"FID of DDG <= {RATIO_TARGET} of Sim GT's (paper: 0.206)",
         describe(ddg["fid_ratio"]) if ddg and "fid_ratio" in ddg else None,
         bool(ddg and "fid_ratio" in ddg and ddg["fid_ratio"]["value"] <= RATIO_TARGET)),
        ("FID of DDG lowest of all columns", measured_order[0] if ddg else None,
         ranks["fid"][:1] == ["ddg"]),
        (f"FID with grafting <= {GRAFT_TARGET} of FID without",
         None if graft is None else f"{graft:.3f}", graft is not None and graft <= GRAFT_TARGET),
        ("KID in the order of FID", measured_order[1], ranks["fid"] == ranks["kid_x100"]),
    ]  # fmt: skip
    return [
        {"target": text, "measured": measured or "not measured",
         "met": "not measured" if measured is None else "met" if met else "not met"}
        for text, measured, met in rows
    ]  # fmt: skip


# --- for people ------------------------------------------------------------------------------------

DISTANCES = {
    "fid": "FID", "fid_ratio": "FID / Sim GT's", "kid_x100": "KID x 100", "auc": "classifier AUC",
    "mixing": "neighbour mixing",
}  # fmt: skip
HOLES = {
    "invalid_share": "invalid pixels", "components_per_frame": "hole regions per frame",
    "gap_size_px": "size spectrum, distance from real", "gap_depth_m": "hole rate over depth, distance",
    "gap_edge_distance_px": "hole rate over edge distance, distance",
    "gap_incidence_deg": "hole rate over incidence, distance", "flicker": "validity flicker",
    "persistence": "hole persists to next frame", "repeat_iou": "hole IoU over repeats",
    "repeat_flicker": "flicker, still scene", "repeat_deviation_mm": "deviation over repeats (mm)",
    "rmse_mm": "RMSE of valid pixels (mm)", "bias_mm": "bias of valid pixels (mm)",
    "outlier_share": "valid pixels off by > 5 cm",
}  # fmt: skip


def distance_rows(table: Table) -> list[dict[str, str]]:
    """Table I as text: one record per measure, one entry per column, references last."""
    return [
        {"measure": title,
         **{table[n]["title"]: describe(table[n].get(key), table[n].get("absent", "")) for n in table}}
        for key, title in DISTANCES.items()
    ]  # fmt: skip


def hole_rows(figures: Mapping[str, Any]) -> list[dict[str, str]]:
    """Hole-level figures as text: one record per measure, one entry per domain."""
    return [
        {"measure": title,
         **{DOMAINS[name].title: describe(value["figures"][key]) for name, value in figures.items()}}
        for key, title in HOLES.items()
    ]  # fmt: skip


def describe(value: Mapping[str, float] | None, absent: str = "") -> str:
    """'87 (80.1 to 93.2)'."""
    if value is None or not np.isfinite(value["value"]):
        return absent or "-"
    if not np.isfinite(value["low"]):
        return f"{value['value']:.3g}"
    return f"{value['value']:.3g} ({value['low']:.3g} to {value['high']:.3g})"
