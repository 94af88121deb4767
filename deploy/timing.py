"""How well a loop kept its time."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

SECONDS = ("sense_s", "infer_s", "act_s", "latency_s", "period_s")
"""The lists of `Timings`."""


@dataclass
class Timings:
    """Raw seconds, one entry per control step (periods: one less per run)."""

    sense_s: list[float] = field(default_factory=list)
    """Camera and joints."""
    infer_s: list[float] = field(default_factory=list)
    """Policy network, where it ran (not where a chunk was played on)."""
    act_s: list[float] = field(default_factory=list)
    """Safety filter and command."""
    latency_s: list[float] = field(default_factory=list)
    """From frame in hand to command sent, on steps that ran the network: infer + act."""
    period_s: list[float] = field(default_factory=list)
    """From one step's start to the next one's, on the loop's clock."""
    missed_deadlines: int = 0
    """Periods skipped because a step took too long."""

    def extend(self, other: "Timings") -> None:
        """Add another run's entries."""
        for name in SECONDS:
            getattr(self, name).extend(getattr(other, name))
        self.missed_deadlines += other.missed_deadlines

    def summary(self, nominal_period_s: float) -> dict[str, Any]:
        """Milliseconds: p50 and p99 of every part; jitter = |period - nominal|, missed deadlines included."""
        jitter = [abs(period - nominal_period_s) for period in self.period_s]
        return {
            "sense_ms": percentiles_ms(self.sense_s),
            "infer_ms": percentiles_ms(self.infer_s),
            "act_ms": percentiles_ms(self.act_s),
            "latency_ms": percentiles_ms(self.latency_s),
            "period_ms": percentiles_ms(self.period_s),
            "jitter_ms": percentiles_ms(jitter) | {"max": round(1e3 * max(jitter), 4) if jitter else None},
            "missed_deadlines": self.missed_deadlines,
        }


def percentiles_ms(seconds: list[float]) -> dict[str, float | None]:
    """Median and 99th percentile in milliseconds; None where nothing was measured."""
    if not seconds:
        return {"p50": None, "p99": None}
    p50, p99 = np.percentile(seconds, (50, 99)) * 1e3
    return {"p50": round(float(p50), 4), "p99": round(float(p99), 4)}
