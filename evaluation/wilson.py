"""Interval behind every success rate."""

import math
from typing import Any

Z_95 = 1.959963984540054
"""97.5 % quantile of the standard normal distribution."""


def wilson_interval(successes: int, n: int, z: float = Z_95) -> tuple[float, float]:
    """Wilson score interval of a proportion.

    (p + z²/2n ± z sqrt(p (1 - p)/n + z²/4n²)) / (1 + z²/n), with p = successes / n.
    Source: E. B. Wilson, "Probable inference, the law of succession, and statistical inference",
    Journal of the American Statistical Association 22 (1927) 209-212.

    Args:
      successes: trials that succeeded, 0 to n.
      n: trials; none leaves everything open, (0, 1).

    Returns:
      (low, high), both in [0, 1].
    """
    if n < 0 or not 0 <= successes <= max(n, 0):
        raise ValueError(f"successes={successes}, n={n}: expected 0 <= successes <= n")
    if n == 0:
        return 0.0, 1.0
    p = successes / n
    scale = 1.0 / (1.0 + z * z / n)
    centre = p + z * z / (2 * n)
    half = z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return max(0.0, scale * (centre - half)), min(1.0, scale * (centre + half))


def success(successes: int, n: int) -> dict[str, Any]:
    """{"rate", "n", "successes", "low", "high"} of a proportion; the rate of no trials is None."""
    low, high = wilson_interval(successes, n)
    rate = successes / n if n else None
    return {"rate": rate, "n": n, "successes": successes, "low": low, "high": high}


def describe(value: dict[str, Any]) -> str:
    """'96.7 % of 300 (94.0 to 98.2)': rate, trials and interval as people read them."""
    if not value["n"]:
        return "no trials"
    rate = 100 * value["rate"]
    digits = next(
        d for d in range(1, 17) if value["successes"] in (0, value["n"]) or 0 < round(rate, d) < 100
    )
    return f"{rate:.{digits}f} % of {value['n']} ({100 * value['low']:.1f} to {100 * value['high']:.1f})"
