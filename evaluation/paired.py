"""Whether two policies tried on the very same trials differ, and what many such questions cost."""

import math
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, TypeVar

Key = TypeVar("Key", bound=Hashable)


def mcnemar_exact(only_first: int, only_second: int) -> float:
    """Two-sided p of McNemar's test, exact and conditional on the pairs that differ.

    p = min(1, 2 sum_{i <= min(b, c)} C(b + c, i) / 2^(b + c)); 1 where no pair differs.
    Sources: Q. McNemar, "Note on the sampling error of the difference between correlated proportions or
    percentages", Psychometrika 12 (1947) 153-157; in this form equation 3 of M. W. Fagerland, S. Lydersen and
    P. Laake, "The McNemar test for binary matched-pairs data", BMC Medical Research Methodology 13:91 (2013).

    Args:
      only_first: b, trials in which only the one succeeded.
      only_second: c, trials in which only the other did.

    Raises ValueError for negative counts.
    """
    if only_first < 0 or only_second < 0:
        raise ValueError(f"{only_first} and {only_second} pairs differ; expected counts from 0")
    n, fewer = only_first + only_second, min(only_first, only_second)
    return min(1.0, sum(math.comb(n, i) for i in range(fewer + 1)) / 2 ** (n - 1)) if n else 1.0


def describe_p(p: float) -> str:
    """A p-value as tables show it: '0.0312', '< 0.0001'."""
    return "< 0.0001" if p < 1e-4 else f"{p:.4f}"


def holm(p_values: Sequence[float]) -> list[float]:
    """p-values adjusted for all being asked at once, in the order given.

    The i-th smallest of m is multiplied by m - i + 1, is at least the one before it, and at most 1.
    Source: S. Holm, "A simple sequentially rejective multiple test procedure", Scandinavian Journal of
    Statistics 6 (1979) 65-70.
    """
    order = sorted(range(len(p_values)), key=p_values.__getitem__)
    adjusted, least = [0.0] * len(p_values), 0.0
    for place, index in enumerate(order):
        least = max(least, min(1.0, (len(p_values) - place) * p_values[index]))
        adjusted[index] = least
    return adjusted


def compared(reference: Mapping[Key, bool], row: Mapping[Key, bool]) -> dict[str, Any]:
    """Success of two series by what names a trial, on the trials that both have.

    Keys: n, pairs of trials; only_reference, only_row, pairs in which one alone succeeded; p, McNemar's exact
    two-sided one; difference, the reference's success less the row's.
    """
    both = reference.keys() & row.keys()
    only_reference = sum(reference[i] and not row[i] for i in both)
    only_row = sum(row[i] and not reference[i] for i in both)
    return {
        "n": len(both),
        "only_reference": only_reference,
        "only_row": only_row,
        "difference": (only_reference - only_row) / len(both) if both else 0.0,
        "p": mcnemar_exact(only_reference, only_row),
    }
