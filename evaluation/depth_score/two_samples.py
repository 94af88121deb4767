"""How well two sets of features can be told apart: distances, a classifier's AUC, mixing of neighbours."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from ddgrasp.config import ScoreConfig
from evaluation.depth_score import distances
from evaluation.depth_score.resampling import Drawn, Sample, bootstrap_pairs, interval

FOLDS = 5
KID_SCALE = 100.0
"""KID is printed times 100, as in the paper."""
AUC_MAPS = 4000
"""Largest number of maps a classifier is trained on."""


def compare(real: Sample, sim: Sample, config: ScoreConfig, drawn: Drawn) -> dict[str, Any]:
    """FID, KID (x 100), AUC and neighbour mixing with their intervals.

    `drawn`: groups resampled on either side; under "resampled_fid" the FID of each draw, for ratios.
    """
    fid, kid = distances.fid(real.features, sim.features), _kid(real.features, sim.features, config)
    fids = bootstrap_pairs(real, sim, drawn, lambda r, s: distances.fid(real.features[r], sim.features[s]))
    auc, aucs = classifier_auc(real, sim, drawn)
    mixing, mixings = neighbour_mixing(real, sim, config.neighbours, drawn)
    return {
        "fid": interval(fid, fids, least=0.0),
        "kid_x100": interval(KID_SCALE * kid, [KID_SCALE * v for v in _kid_draws(real, sim, drawn)]),
        "auc": interval(auc, aucs, 0.0, 1.0),
        "mixing": interval(mixing, mixings, least=0.0),
        "resampled_fid": fids,
    }


# --- kernel distance -------------------------------------------------------------------------------


def _kid(x: np.ndarray, y: np.ndarray, config: ScoreConfig) -> float:
    """torch-fidelity's KID with subsets of at most half of the smaller set."""
    size = max(2, min(config.kid_subset_size, len(x) // 2, len(y) // 2))
    return distances.kid(x, y, config.kid_subsets, size)[0]


def _kid_draws(real: Sample, sim: Sample, drawn: Drawn) -> list[float]:
    """The squared maximum mean discrepancy of every draw, by weights: kernels are computed once."""
    x, y = real.features.astype(np.float64), sim.features.astype(np.float64)
    kxx, kyy, kxy = distances.kernel(x, x), distances.kernel(y, y), distances.kernel(x, y)

    def within(k: np.ndarray, w: np.ndarray) -> float:
        return float((w @ k @ w - w @ np.diag(k)) / (w.sum() * (w.sum() - 1)))

    values = []
    for r, s in drawn:
        w = np.bincount(real.rows(r), minlength=len(x)).astype(float)
        v = np.bincount(sim.rows(s), minlength=len(y)).astype(float)
        values.append(within(kxx, w) + within(kyy, v) - 2 * (w @ kxy @ v) / (w.sum() * v.sum()))
    return values


# --- classifier ------------------------------------------------------------------------------------


def classifier_auc(real: Sample, sim: Sample, drawn: Drawn) -> tuple[float, list[float]]:
    """Area under the ROC curve of a logistic regression that tells the sets apart (Lopez-Paz & Oquab 2017).

    Cross-validated: a group (a scene of the rig; eight frames in a row of a real camera, whose next eight are
    another group) is never both trained on and tested. 0.5 = not to be told apart. The draws resample the
    tested scores. nan with fewer than two groups.
    """
    from sklearn.linear_model import LogisticRegression
    from sklearn.metrics import roc_auc_score
    from sklearn.model_selection import cross_val_predict
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    folds = min(FOLDS, len(np.unique(real.groups)), len(np.unique(sim.groups)))
    if folds < 2:
        return float("nan"), []
    x = np.concatenate([real.features, sim.features])
    y = np.concatenate([np.zeros(len(real.features)), np.ones(len(sim.features))])
    thin = np.arange(len(x))[:: -(-len(x) // AUC_MAPS)]
    model = make_pipeline(StandardScaler(), LogisticRegression(C=0.1, max_iter=500))
    score = np.full(len(x), np.nan)
    splits = _folds(folds, real, sim, thin)
    score[thin] = cross_val_predict(model, x[thin], y[thin], cv=splits, method="decision_function")
    n = len(real.features)

    def auc(r: np.ndarray, s: np.ndarray) -> float:
        a, b = (part[~np.isnan(part)] for part in (score[:n][r], score[n:][s]))
        return float(roc_auc_score(np.repeat([0, 1], [len(a), len(b)]), np.concatenate([a, b])))

    return auc(np.arange(n), np.arange(len(x) - n)), bootstrap_pairs(real, sim, drawn, auc)


def _folds(count: int, real: Sample, sim: Sample, thin: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """(training, test) rows, groups of both sets in each: the n-th group of either goes into fold n % count.

    Shared groups (the same scene on both sides) have the same n.
    """
    order = {}
    for sample in (real, sim):
        order.update({group: n for n, group in enumerate(np.unique(sample.groups))})
    fold = np.array([order[g] % count for g in np.concatenate([real.groups, sim.groups])[thin]])
    return [(np.flatnonzero(fold != f), np.flatnonzero(fold == f)) for f in range(count)]


# --- neighbours --------------------------------------------------------------------------------------


def neighbour_mixing(real: Sample, sim: Sample, neighbours: int, drawn: Drawn) -> tuple[float, list[float]]:
    """Share of a map's nearest maps that are from the other set, over the share that chance gives: 1 = mixed,
    0 = apart. Maps of the same group do not count as neighbours.
    """
    x = np.concatenate([real.features, sim.features]).astype(np.float32)
    groups, n = np.concatenate([real.groups, sim.groups]), len(real.features)
    other = np.arange(len(x)) >= n
    share, expected = np.zeros(len(x)), np.zeros(len(x))
    square = np.sum(x * x, axis=1)
    for start in range(0, len(x), 512):
        now = slice(start, start + 512)
        distance = square[None] - 2 * x[now] @ x.T
        allowed = groups[now, None] != groups[None]
        k = min(neighbours, int(allowed.sum(1).min()))
        if k < 1:
            return float("nan"), []
        nearest = np.argpartition(np.where(allowed, distance, np.inf), k - 1, axis=1)[:, :k]
        crossing = other[None] != other[now, None]
        share[now] = np.take_along_axis(crossing, nearest, 1).mean(1)
        expected[now] = (crossing & allowed).sum(1) / allowed.sum(1)

    def mixing(r: np.ndarray, s: np.ndarray) -> float:
        rows = np.concatenate([r, s + n])
        return float(share[rows].mean() / expected[rows].mean())

    every = np.arange(n), np.arange(len(x) - n)
    return mixing(*every), bootstrap_pairs(real, sim, drawn, mixing)


# --- embedding ---------------------------------------------------------------------------------------


def embed(features: Mapping[str, Float[np.ndarray, "_ d"]], seed: int) -> dict[str, Float[np.ndarray, "_ 2"]]:
    """(n, 2) t-SNE coordinates of every domain, all embedded together (van der Maaten & Hinton 2008).

    Features are reduced to their 50 strongest principal components first, as is customary.
    """
    from sklearn.decomposition import PCA
    from sklearn.manifold import TSNE

    joined = np.concatenate(list(features.values()))
    size = min(50, *joined.shape)
    reduced = PCA(size, random_state=seed).fit_transform(joined)
    perplexity = min(30.0, (len(joined) - 1) / 3)
    flat = TSNE(2, perplexity=perplexity, init="pca", random_state=seed).fit_transform(reduced)
    ends = np.cumsum([len(f) for f in features.values()])[:-1]
    return dict(zip(features, np.split(np.asarray(flat), ends), strict=True))
