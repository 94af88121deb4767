"""A plane in a picture for scikit-learn's RANSAC. It imports scikit-learn: import it where it is used."""

import numpy as np
from jaxtyping import Float, Int
from sklearn.base import BaseEstimator


class Plane(BaseEstimator):
    """Least squares without the checks of scikit-learn's LinearRegression, which are five sixths of the time
    that RANSAC takes with it."""

    def fit(self, pixels: Int[np.ndarray, "n 2"], values: Float[np.ndarray, " n"]) -> "Plane":
        """The plane next to `values` (n,) at `pixels` (n, 2)."""
        self._slopes_and_offset = np.linalg.lstsq(_with_one(pixels), values, rcond=None)[0]
        return self

    def predict(self, pixels: Int[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
        """(n,) its values at `pixels` (n, 2)."""
        return _with_one(pixels) @ self._slopes_and_offset

    def score(self, pixels: Int[np.ndarray, "n 2"], values: Float[np.ndarray, " n"]) -> float:
        """Decides between planes that equally many pixels are near: the larger, the nearer."""
        return -float(np.mean((self.predict(pixels) - values) ** 2))


def _with_one(pixels: Int[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 3"]:
    return np.column_stack([pixels, np.ones(len(pixels))])
