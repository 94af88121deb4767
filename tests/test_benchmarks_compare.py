"""Ratios of the benchmarks by hand."""

import time

import numpy as np
import pytest

from benchmarks.compare import Contender, as_json, compare, measure

RATES = {"ours": np.array([10.0, 40.0, 60.0]), "peer": np.array([10.0, 20.0, 20.0])}


def test_the_ratio_is_the_median_over_rounds():
    row = compare(RATES, "steps", "steps/s", "ours", "peer", target=2.0)
    assert (row.ours_rate, row.peer_rate, row.ratio, row.met) == (40.0, 20.0, 2.0, True)
    assert compare(RATES, "steps", "steps/s", "ours", "peer", target=2.5).met is False
    assert compare(RATES, "steps", "steps/s", "ours", "peer").met is None


def test_units_of_each_side_count():
    row = compare(RATES, "steps", "control steps/s", "ours", "peer", ours_units=20, peer_units=4)
    assert (row.ours_rate, row.peer_rate, row.ratio) == (2.0, 5.0, pytest.approx(0.4))


def test_a_peer_that_is_not_there_leaves_the_target_open():
    row = compare(RATES, "frames", "frames/s", "ours", "OpenGL", target=1.0)
    assert (row.ours_rate, row.peer_rate, row.met) == (40.0, None, None)
    assert as_json([row])[0]["met"] is None


def test_work_and_calls_enter_the_rate():
    calls = []
    contenders = {
        "once": Contender(lambda: (time.sleep(0.02), calls.append("once")), work=3),
        "twice": Contender(lambda: (time.sleep(0.02), calls.append("twice")), work=3, calls=2),
    }
    rates = measure(contenders, rounds=2)
    warm_up = ["once", "once", "twice", "twice"]
    assert calls == warm_up + 2 * ["once", "twice", "twice"]  # then in turns
    for name in contenders:
        assert rates[name].shape == (2,)
        assert (rates[name] < 3 / 0.02).all()
        assert (rates[name] > 3 / 0.5).all()
