"""Distances between two sets of feature vectors: FID (as pytorch-fid) and KID (as torch-fidelity). NumPy
alone.

Both are meant for features of foundation/features.py; the extractor's name belongs beside every figure.
"""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

from ddgrasp.errors import UserError

KID_SEED = 2020
"""torch-fidelity's."""
Features = Float[np.ndarray, "n d"]
Others = Float[np.ndarray, "m d"]


def fid(x: Features, y: Others) -> float:
    """Frechet distance of the Gaussians fitted to two sets of features (Heusel et al. 2017, eq. 6).

    |m1 - m2|^2 + tr(S1 + S2) - 2 tr (S1 S2)^(1/2), covariances with n - 1. The trace of the root is the sum
    of the singular values of A B^T, where S1 = A^T A and S2 = B^T B: no matrix root, and nothing complex,
    where covariances are singular. Rounding may leave the distance of equal sets slightly below 0.

    Args:
      x: (n, d), two rows or more.
      y: (m, d), two rows or more.
    """
    _check(x, y)
    x, y = np.asarray(x, np.float64), np.asarray(y, np.float64)
    a, b = ((f - f.mean(0)) / np.sqrt(len(f) - 1) for f in (x, y))
    a, b = (np.asarray(np.linalg.qr(factor, mode="r")) for factor in (a, b))
    difference = x.mean(0) - y.mean(0)
    root = np.linalg.svd(a @ b.T, compute_uv=False).sum()
    return float(difference @ difference + np.sum(a * a) + np.sum(b * b) - 2 * root)


def kernel(x: Features, y: Others) -> Float[np.ndarray, "n m"]:
    """(n, d), (m, d) -> (n, m): the cubic kernel of KID, (x.y / d + 1)^3."""
    return (x @ y.T / x.shape[1] + 1) ** 3


def mmd2(x: Features, y: Others) -> float:
    """Unbiased squared maximum mean discrepancy (Gretton et al. 2012, lemma 6) under `kernel`.

    x and y (m, d) of one length. It can be negative.
    """
    _check(x, y)
    if len(x) != len(y):
        raise UserError(f"mmd2 compares sets of one size, not {len(x)} and {len(y)} vectors.")
    x, y, count = np.asarray(x, np.float64), np.asarray(y, np.float64), len(x)
    within = (kernel(p, p) for p in (x, y))
    same = sum(float(k.sum() - np.trace(k)) for k in within) / (count * (count - 1))
    return same - 2 * float(kernel(x, y).mean())


def kid_subsets(
    count_x: int, count_y: int, subsets: int, size: int
) -> Iterator[tuple[Int[np.ndarray, " size"], Int[np.ndarray, " size"]]]:
    """Rows of x and of y, `size` each without replacement, that torch-fidelity draws for every subset."""
    rng = np.random.RandomState(KID_SEED)
    for _ in range(subsets):
        rows = rng.choice(count_x, size, replace=False)
        yield rows, rng.choice(count_y, size, replace=False)


def kid(x: Features, y: Others, subsets: int = 100, size: int = 1000) -> tuple[float, float]:
    """Mean and (population) standard deviation of `mmd2` over random subsets (Binkowski et al. 2018).

    UserError if a set has fewer than `size` vectors.
    """
    _check(x, y)
    if min(len(x), len(y)) < size:
        raise UserError(f"KID with subsets of {size} needs as many vectors, not {len(x)} and {len(y)}.")
    values = [mmd2(x[i], y[j]) for i, j in kid_subsets(len(x), len(y), subsets, size)]
    return float(np.mean(values)), float(np.std(values))


def _check(x: np.ndarray, y: np.ndarray) -> None:
    if x.ndim != 2 or y.ndim != 2 or x.shape[1] != y.shape[1] or min(len(x), len(y)) < 2:
        raise UserError(
            f"Features are {x.shape} and {y.shape}; expected (n, d) and (m, d), n and m at least 2."
        )
