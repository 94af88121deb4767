"""Bootstrap over whole episodes: frames of one trajectory resemble each other, trajectories do not."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

LEVEL = 0.95
Drawn = Sequence[tuple[Int[np.ndarray, " _"], Int[np.ndarray, " _"]]]
"""Groups of real and of simulated maps, per draw."""


@dataclass(frozen=True)
class Sample:
    """Features of one domain's maps."""

    features: Float[np.ndarray, "N d"]
    groups: Int[np.ndarray, " N"]
    """What each map belongs to."""

    def rows(self, drawn: Int[np.ndarray, " groups"]) -> Int[np.ndarray, " rows"]:
        """Row numbers of the drawn groups, one after the other, as often as they were drawn."""
        members = {group: np.flatnonzero(self.groups == group) for group in np.unique(drawn)}
        return np.concatenate([members[group] for group in drawn])


def draws(
    groups: Int[np.ndarray, " N"], count: int, rng: np.random.Generator
) -> list[Int[np.ndarray, " groups"]]:
    """`count` times as many groups as there are, with replacement."""
    names = np.unique(groups)
    return [rng.choice(names, len(names)) for _ in range(count)]


def interval(
    point: float, resampled: Sequence[float], least: float = -math.inf, most: float = math.inf
) -> dict[str, float]:
    """{value, low, high}: percentile interval of the resampled values, moved so that their mean lies on the
    point, as far as it is within what the figure can be.

    Resampling with replacement repeats maps, which moves Frechet distances and polynomial MMD upwards by more
    than they vary: only the spread is taken from it. Quantiles are at (n + 1) p of n values
    (Hyndman and Fan 1996, definition 6), below which a share p of what was not drawn lies; at (n - 1) p, 100
    draws would hold 93.3 %, not 95.
    """
    values = np.asarray([v for v in resampled if np.isfinite(v)])
    if not len(values) or not np.isfinite(point):
        return {"value": float(point), "low": float("nan"), "high": float("nan")}
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(values - values.mean(), (tail, 1 - tail), method="weibull")
    low, high = (float(np.clip(point + end, least, most)) for end in (low, high))
    return {"value": float(point), "low": low, "high": high}


def intervals(
    point: Mapping[str, float],
    resampled: Sequence[Mapping[str, float]],
    bounds: Mapping[str, tuple[float, float]],
) -> dict[str, dict[str, float]]:
    """`interval` of every named figure, within its `bounds` (least, most)."""
    return {
        name: interval(value, [other[name] for other in resampled], *bounds[name])
        for name, value in point.items()
    }


def bootstrap_pairs(
    real: Sample, sim: Sample, drawn: Drawn,
    statistic: Callable[[np.ndarray, np.ndarray], float],
) -> list[float]:  # fmt: skip
    """statistic(real rows, sim rows) for every (real groups, sim groups) drawn."""
    return [statistic(real.rows(r), sim.rows(s)) for r, s in drawn]
