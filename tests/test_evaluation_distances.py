"""FID and KID: recorded values of the originals, and small cases by hand."""

import re

import numpy as np
import pytest

import parity_support as parity
from ddgrasp.errors import UserError
from evaluation.depth_score import distances


@pytest.mark.parametrize("name", parity.names("unit_fid_kid*") or [""])
def test_recorded_values(name):
    if not name:
        pytest.skip(parity.ABSENT)
    fixture = parity.load(name)
    cases = [found[1] for key in fixture.arrays if (found := re.fullmatch(r"in/([a-z]+)_x", key))]
    assert cases
    checked = 0
    for case in cases:
        x, y = fixture.arrays[f"in/{case}_x"], fixture.arrays[f"in/{case}_y"]
        rows_x, rows_y = fixture.arrays[f"in/{case}_kid_idx_x"], fixture.arrays[f"in/{case}_kid_idx_y"]
        drawn = list(distances.kid_subsets(len(x), len(y), *rows_x.shape))
        np.testing.assert_array_equal([rows for rows, _ in drawn], rows_x)
        np.testing.assert_array_equal([rows for _, rows in drawn], rows_y)
        mean, std = distances.kid(x, y, *rows_x.shape)
        first = min(len(x), len(y))
        made = {
            "fid": distances.fid(x, y),
            "fid_eig": distances.fid(x, y),
            "fid_self": distances.fid(x, x),
            "kid_subset_values": [distances.mmd2(x[i], y[j]) for i, j in drawn],
            "kid_mean": mean,
            "kid_std": std,
            "mmd2_first": distances.mmd2(x[:first], y[:first]),
        }
        for what, value in made.items():
            key = f"out/{case}_{what}"
            error = np.max(np.abs(np.asarray(value) - fixture.arrays[key]))
            print(f"{name} {key}: {error:.1e} of {fixture.tolerance(key):.1e}")
            assert error <= fixture.tolerance(key), (key, error)
            checked += 1
    assert checked == sum(key.startswith("out/") for key in fixture.arrays)


def test_fid_by_hand():
    x = np.array([[0.0], [2.0]])  # mean 1, variance 2
    y = np.array([[3.0], [3.0], [9.0]])  # mean 5, variance 12
    assert distances.fid(x, y) == pytest.approx(16 + 2 + 12 - 2 * np.sqrt(24))
    assert distances.fid(x, x) == pytest.approx(0, abs=1e-12)
    spread = np.array([[-1.0, 0], [1, 0]])
    assert distances.fid(spread, spread[:, ::-1]) == pytest.approx(4)  # orthogonal lines: nothing shared


def test_kid_by_hand():
    x, y = np.array([[0.0], [1.0]]), np.array([[0.0], [0.0]])
    # k = (pq + 1)^3: within x 1 and 1, within y 1 and 1, across 1 everywhere
    assert distances.mmd2(x, y) == pytest.approx(0)
    assert distances.mmd2(x, x) == pytest.approx(1 + 1 - 2 * (1 + 1 + 1 + 8) / 4)
    # By the number of features: (1 * 2 + 3 * 1) / 2 + 1.
    assert distances.kernel(np.array([[1.0, 3.0]]), np.array([[2.0, 1.0]])).item() == pytest.approx(3.5**3)
    with pytest.raises(UserError, match="subsets of 1000"):
        distances.kid(x, y)
    with pytest.raises(UserError, match="expected"):
        distances.fid(x, np.zeros((3, 2)))
