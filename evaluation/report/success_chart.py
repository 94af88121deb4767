"""Success of several policies in one picture: bars with intervals, and every object by itself."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ddgrasp import contract
from ddgrasp.files import to_png

Rows = Mapping[str, Mapping[str, Any]]
"""Title -> what `evaluation.rig_trials.tabulate` gives."""


def draw(sets: Mapping[str, Rows]) -> bytes:
    """PNG: for every set of trials, by its name, success of all rows with Wilson intervals, and by object."""
    sets = {name: rows for name, rows in sets.items() if rows}
    tallest = max((len(rows) for rows in sets.values()), default=1)
    figure = Figure(figsize=(14, max(1, len(sets)) * (1.6 + 0.36 * tallest)), layout="constrained")
    for index, (name, rows) in enumerate(sets.items()):
        bars = figure.add_subplot(len(sets), 2, 2 * index + 1)
        _draw_bars(bars, rows)
        bars.set_title(f"{name}: success, Wilson 95 %", fontsize=9)
        _draw_objects(figure.add_subplot(len(sets), 2, 2 * index + 2), rows)
    return to_png(figure)


def objects(rows: Rows) -> list[str]:
    """Every object of `rows`, those of training's lists first and in their order."""
    order = (*contract.SEEN_OBJECTS, *contract.UNSEEN_OBJECTS)
    found = dict.fromkeys(name for made in rows.values() for name in made["objects"])
    return sorted(found, key=lambda name: order.index(name) if name in order else len(order))


def _drawn(name: str) -> str:
    """A folder's name as text that Matplotlib draws: $ is its sign of a formula, and it has no letters for
    what is no UTF-8."""
    return name.replace("$", r"\$").encode(errors="backslashreplace").decode()


def _draw_bars(axes: Axes, rows: Rows) -> None:
    total = [made["all"] for made in rows.values()]
    rates = np.array([success["rate"] for success in total])
    whiskers = np.abs(np.array([[s["low"], s["high"]] for s in total]).T - rates)
    places = np.arange(len(rows))
    axes.barh(places, 100 * rates, xerr=100 * whiskers, height=0.6, color="#7a9cc6", capsize=3)
    axes.set_yticks(places, [_drawn(name) for name in rows], fontsize=8)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlim(0, 100)
    axes.set_xlabel("%", fontsize=8)
    axes.tick_params(axis="x", labelsize=8)


def _draw_objects(axes: Axes, rows: Rows) -> None:
    names = objects(rows)
    rates = [[made["objects"].get(name, {}).get("rate") for name in names] for made in rows.values()]
    values = 100 * np.array([[np.nan if rate is None else rate for rate in line] for line in rates], float)
    axes.imshow(values, vmin=0, vmax=100, cmap="RdYlGn", aspect="auto")
    for (i, j), value in np.ndenumerate(values):
        if np.isfinite(value):
            axes.text(j, i, f"{value:.0f}", ha="center", va="center", fontsize=7)
    axes.set_xticks(np.arange(len(names)), names, rotation=60, ha="right", fontsize=8)
    axes.set_yticks([])
    axes.set_title("by object, %", fontsize=9)
