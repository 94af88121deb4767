"""Wilson intervals against values worked out by hand."""

import pytest

from evaluation.wilson import Z_95, describe, success, wilson_interval


def test_all_failures_and_all_successes_have_closed_forms():
    """With p = 0 the interval is (0, z²/(n + z²)); with p = 1 it is (n/(n + z²), 1)."""
    square = Z_95**2
    assert wilson_interval(0, 10) == (0.0, pytest.approx(square / (10 + square), abs=1e-12))
    assert wilson_interval(10, 10) == (pytest.approx(10 / (10 + square), abs=1e-12), pytest.approx(1.0))


def test_half_of_ten():
    """p = 1/2, n = 10: centre 1/2, half width z/2 / sqrt(n + z²) = 0.97998 / sqrt(13.84146) = 0.26341."""
    low, high = wilson_interval(5, 10)
    assert low == pytest.approx(0.23659, abs=1e-5)
    assert high == pytest.approx(0.76341, abs=1e-5)


def test_eighty_one_of_263():
    """Newcombe (1998), Statistics in Medicine 17, table I, method 3: 81/263 gives 0.2553 to 0.3662."""
    low, high = wilson_interval(81, 263)
    assert (round(low, 4), round(high, 4)) == (0.2553, 0.3662)


def test_the_interval_mirrors_and_shrinks_with_trials():
    low, high = wilson_interval(7, 60)
    mirrored = wilson_interval(53, 60)
    assert (low, high) == (pytest.approx(1 - mirrored[1]), pytest.approx(1 - mirrored[0]))
    wider, narrower = wilson_interval(6, 10), wilson_interval(600, 1000)
    assert wider[0] < narrower[0] < 0.6 < narrower[1] < wider[1]


def test_no_trials_say_nothing():
    assert success(0, 0) == {"rate": None, "n": 0, "successes": 0, "low": 0.0, "high": 1.0}
    assert describe(success(0, 0)) == "no trials"


@pytest.mark.parametrize(("successes", "n"), [(3, 2), (-1, 2), (0, -1)])
def test_impossible_counts_are_refused(successes, n):
    with pytest.raises(ValueError, match=f"successes={successes}, n={n}"):
        wilson_interval(successes, n)


def test_description():
    assert describe(success(5, 10)) == "50.0 % of 10 (23.7 to 76.3)"


@pytest.mark.parametrize(
    ("successes", "n", "text"),
    [(2399, 2400, "99.96 % of 2400"), (1, 2400, "0.04 % of 2400"), (2400, 2400, "100.0 %"), (0, 9, "0.0 %"),
     (1999, 2000, "99.95 %"), (999, 1000, "99.9 %")],
)  # fmt: skip
def test_a_hundred_percent_is_all_of_them(successes, n, text):
    assert describe(success(successes, n)).startswith(text)
