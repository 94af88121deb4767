"""Pictures of a score: the table, hole-rate curves, the t-SNE's pairings, the data-efficiency curve."""

from collections.abc import Mapping, Sequence
from string import ascii_lowercase
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ddgrasp.files import to_png
from evaluation.depth_score import holes
from evaluation.depth_score.domains import COLUMNS, DOMAINS, FLOOR, RAW

REAL_COLOR, SIM_COLOR = "tab:blue", "tab:orange"
_LABELS = {
    "depth_m": "depth (m)", "edge_distance_px": "distance to a depth edge (px)",
    "incidence_deg": "incidence angle (degrees)",
}  # fmt: skip


def draw_table(rows: Sequence[Mapping[str, str]], title: str) -> bytes:
    """PNG of records of text."""
    columns = list(rows[0])
    cells = [[row.get(c, "").replace(" (", "\n(") for c in columns] for row in rows]
    figure = Figure(figsize=(1.5 * len(columns) + 0.8, 0.52 * (len(rows) + 1) + 0.5), layout="constrained")
    axes = figure.add_subplot()
    axes.set_axis_off()
    axes.set_title(title, fontsize=10)
    table = axes.table(cells, colLabels=columns, loc="center", cellLoc="center")
    table.auto_set_font_size(False)
    table.set_fontsize(8)
    table.scale(1, 2.3)
    for (row, column), cell in table.get_celld().items():
        cell.set_linewidth(0.4)
        if row == 0 or column == 0:
            cell.set_text_props(weight="bold")
    return to_png(figure)


def draw_holes(scored: Mapping[str, Any]) -> bytes:
    """PNG: hole rate against depth, edge distance and incidence, and the size spectrum, one line per domain.

    scored: domain -> {"curves": ...} of `score_table.hole_figures`.
    """
    figure = Figure(figsize=(13, 3.4), layout="constrained")
    for index, name in enumerate((*holes.BINS, "size_px")):
        axes = figure.add_subplot(1, 4, index + 1)
        for domain, value in scored.items():
            y = np.asarray(value["curves"][name], float)
            if np.nansum(y) > 0:
                width = 2.2 if domain in (RAW, FLOOR) else 1.2
                x, title = _places(name, len(y)), DOMAINS[domain].title
                axes.plot(x, y, label=title, marker=".", linewidth=width)
        axes.set_xlabel(_LABELS.get(name, "hole size (px)"), fontsize=8)
        axes.set_ylabel("regions per frame" if name == "size_px" else "hole rate", fontsize=8)
        if name == "size_px":
            axes.set_xscale("log", base=2)
            axes.set_yscale("log")
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), fontsize=8, frameon=False)
    return to_png(figure)


def _places(name: str, count: int) -> np.ndarray:
    """Where a bin's point is drawn: its middle, for the last open one its lower edge."""
    if name == "size_px":
        return 2.0 ** np.arange(count)
    edges = np.asarray(holes.BINS[name], float)
    return np.where(np.isfinite(edges[1:]), (edges[:-1] + edges[1:]) / 2, edges[:-1])


def draw_embedding(
    flat: Mapping[str, Float[np.ndarray, "_ 2"]], table: Mapping[str, Any], floor: float
) -> bytes:
    """PNG: the t-SNE, one panel per column: recorded depth in blue, the method's in orange (the paper's t-SNE
    figure, with its letters).

    flat: domain -> (n, 2). Titles give the neighbour mixing in feature space; 1 = mixed.
    """
    shown = [name for name in table if name in COLUMNS and "fid" in table[name]]
    rows = -(-len(shown) // 3)
    figure = Figure(figsize=(11, 3.4 * rows), layout="constrained")
    count = sum(len(points) for points in flat.values())
    title = f"t-SNE of {count} maps; neighbour mixing (1 = mixed), real with real {floor:.2f}"
    figure.suptitle(title, fontsize=10)
    for index, name in enumerate(shown):
        axes = figure.add_subplot(rows, 3, index + 1)
        for domain, color in ((table[name]["real"], REAL_COLOR), (table[name]["sim"], SIM_COLOR)):
            axes.scatter(*flat[domain].T, s=3, c=color, label=DOMAINS[domain].title, alpha=0.5, linewidths=0)
        mixing = table[name]["mixing"]["value"]
        letter = ascii_lowercase[list(COLUMNS).index(name)]
        axes.set_title(f"({letter}) {table[name]['title']}: mixing {mixing:.2f}", fontsize=9)
        axes.set_xticks([])
        axes.set_yticks([])
        axes.legend(fontsize=7, markerscale=3, loc="upper right")
    return to_png(figure)


def draw_efficiency(points: Sequence[Mapping[str, Any]], floor: Mapping[str, Any], base: float) -> bytes:
    """PNG: FID and KID against the number of recorded trajectories, with intervals and the floor.

    points: records with `trajectories` and per column figures; base: FID of Sim GT, drawn as a line.
    """
    figure = Figure(figsize=(8.5, 3.4), layout="constrained")
    for index, (key, title) in enumerate((("fid", "FID"), ("kid_x100", "KID x 100"))):
        axes = figure.add_subplot(1, 2, index + 1)
        for name in ("ddg_no_graft", "ddg"):
            x = [point["trajectories"] for point in points]
            y = np.array([[point[name][key][k] for k in ("value", "low", "high")] for point in points])
            bars = np.nan_to_num(np.stack([y[:, 0] - y[:, 1], y[:, 2] - y[:, 0]]))
            axes.errorbar(x, y[:, 0], np.maximum(bars, 0), label=COLUMNS[name].title, marker="o", capsize=3)
        axes.axhline(floor[key]["value"], color="grey", linestyle="--", label="real vs real")
        if key == "fid":
            axes.axhline(base, color="tab:red", linestyle=":", label="Sim GT")
        axes.set_xscale("log", base=2)
        axes.set_yscale("symlog" if key == "kid_x100" else "log")
        axes.set_xticks([p["trajectories"] for p in points], [str(p["trajectories"]) for p in points])
        axes.set_xlabel("recorded trajectories", fontsize=8)
        axes.set_title(title, fontsize=9)
        axes.tick_params(labelsize=7)
        axes.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=7)
    return to_png(figure)
