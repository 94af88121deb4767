"""Telling two sets of features apart: identities, known answers, targets read off a table."""

import numpy as np
import pytest
from scipy.stats import norm

from ddgrasp.config import ScoreConfig
from ddgrasp.errors import UserError
from evaluation.depth_score import distances, two_samples
from evaluation.depth_score import table as score_table
from evaluation.depth_score.resampling import Sample, draws, interval

CONFIG = ScoreConfig(kid_subsets=5, kid_subset_size=20, bootstrap=6, neighbours=5)


def sample(seed: int, shift: float = 0.0, groups: int = 10, first: int = 0, each: int = 8) -> Sample:
    """Groups of similar vectors, as trajectories are."""
    rng = np.random.default_rng(seed)
    centres = rng.normal(shift, 1.0, (groups, 1, 6))
    features = centres + 0.5 * rng.normal(size=(groups, each, 6))
    return Sample(features.reshape(-1, 6), np.repeat(np.arange(first, first + groups), each))


def test_rows_repeat_groups_as_often_as_they_were_drawn():
    groups = Sample(np.zeros((5, 1)), np.array([7, 7, 8, 9, 9]))
    np.testing.assert_array_equal(groups.rows(np.array([9, 7, 9])), [3, 4, 0, 1, 3, 4])


def test_an_interval_has_the_spread_of_the_draws_around_the_point():
    found = interval(10.0, list(np.linspace(20, 40, 101)))
    assert (found["low"], found["high"]) == pytest.approx((10 - 9.69, 10 + 9.69))
    assert np.isnan(interval(1.0, [])["low"])
    within = interval(0.99, [0.90, 0.95, 1.0], 0.0, 1.0)
    assert within == {"value": 0.99, "low": pytest.approx(0.94), "high": 1.0}


def test_an_interval_of_few_draws_holds_95_percent_of_what_was_not_drawn():
    rng, held = np.random.default_rng(0), []
    for count in (50, 100):
        for _ in range(1000):
            values = rng.normal(size=count)
            found = interval(float(values.mean()), list(values))
            held.append(norm.cdf(found["high"]) - norm.cdf(found["low"]))
    assert 0.948 < np.mean(held) < 0.958


def test_weighted_kernels_give_the_discrepancy_of_the_drawn_rows():
    x, y = sample(0), sample(1, 0.3, first=20)
    rng = np.random.default_rng(2)
    drawn = list(zip(draws(x.groups, 3, rng), draws(y.groups, 3, rng), strict=True))
    expected = [distances.mmd2(x.features[x.rows(r)], y.features[y.rows(s)]) for r, s in drawn]
    np.testing.assert_allclose(two_samples._kid_draws(x, y, drawn), expected, rtol=1e-9)


def test_alike_and_different_sets():
    real, alike, far = sample(0, groups=40), sample(1, groups=40, first=100), sample(2, 4.0, 40, 200)
    drawn = [(real.groups[::8], alike.groups[::8])]
    same = two_samples.compare(real, alike, CONFIG, drawn)
    other = two_samples.compare(real, far, CONFIG, [(real.groups[::8], far.groups[::8])])
    assert 0.3 < same["auc"]["value"] < 0.7 and other["auc"]["value"] > 0.99
    assert same["mixing"]["value"] == pytest.approx(1, abs=0.25) and other["mixing"]["value"] < 0.05
    assert same["fid"]["value"] < 2 and other["fid"]["value"] == pytest.approx(6 * 4**2, rel=0.2)
    assert abs(same["kid_x100"]["value"]) < 0.1 * other["kid_x100"]["value"]
    kid, _ = distances.kid(real.features, far.features, CONFIG.kid_subsets, CONFIG.kid_subset_size)
    assert other["kid_x100"]["value"] == pytest.approx(100 * kid)


def test_kid_of_few_maps_draws_half_of_the_smaller_set():
    real, few = sample(0, groups=4), sample(2, 4.0, 3, 200)
    drawn = [(real.groups[:1], few.groups[:1])] * 2
    kid, _ = distances.kid(real.features, few.features, CONFIG.kid_subsets, len(few.features) // 2)
    assert len(few.features) // 2 < CONFIG.kid_subset_size
    assert two_samples.compare(real, few, CONFIG, drawn)["kid_x100"]["value"] == pytest.approx(100 * kid)


def test_neighbours_of_alike_sets_may_mix_more_than_by_chance():
    real, alike = sample(3, groups=40), sample(53, groups=40, first=100)
    rng = np.random.default_rng(3)
    drawn = list(zip(draws(real.groups, 20, rng), draws(alike.groups, 20, rng), strict=True))
    mixing = two_samples.compare(real, alike, CONFIG, drawn)["mixing"]
    assert mixing["low"] < mixing["value"] < mixing["high"] and mixing["high"] > 1


def test_a_classifier_never_trains_on_the_scene_it_is_tested_on():
    # Within a group the sets differ by a constant that is another in every group: only a leak could use it.
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(12), 6)
    place, sign = rng.normal(0, 5, (12, 8))[groups], rng.choice((-1, 1), (12, 1))[groups]
    real, sim = Sample(place + sign, groups), Sample(place - sign, groups)
    auc, _ = two_samples.classifier_auc(real, sim, [])
    assert auc < 0.75


def test_embedding_keeps_domains_apart_that_are_apart():
    features = {"a": sample(0).features, "b": sample(1, 8.0).features}
    flat = two_samples.embed(features, 0)
    centres = [flat[name].mean(0) for name in "ab"]
    spread = max(flat[name].std() for name in "ab")
    assert {name: part.shape for name, part in flat.items()} == {"a": (80, 2), "b": (80, 2)}
    assert np.linalg.norm(centres[0] - centres[1]) > spread


# --- the table -------------------------------------------------------------------------------------


def table(**fids: float) -> dict:
    entry = {"low": 0.0, "high": 0.0}
    made = {
        name: {"title": name, "fid": {"value": v, **entry}, "kid_x100": {"value": v / 2, **entry}}
        for name, v in fids.items()
    }
    for figures in made.values():
        figures["fid_ratio"] = {"value": figures["fid"]["value"] / fids["sim_gt"], **entry}
    return made


def test_targets_met_and_missed():
    good = score_table.targets(table(sim_gt=100, inpaint=40, ddg_no_graft=14, ddg=12, floor=1))
    assert [row["met"] for row in good] == ["met"] * 4
    bad = table(sim_gt=100, inpaint=20, ddg_no_graft=25, ddg=30, floor=1)
    bad["inpaint"]["kid_x100"]["value"] = 30.0
    assert [row["met"] for row in score_table.targets(bad)] == ["not met"] * 4
    assert score_table.targets(bad)[2]["measured"] == "1.200"


def test_what_was_not_measured_is_not_called_missed():
    rows = score_table.targets(table(sim_gt=100))
    assert [row["met"] for row in rows] == ["not measured"] * 4


def test_scenes_on_both_sides_are_resampled_together():
    real, same, others = sample(0), sample(1), sample(1, first=50)
    for sim, together in ((same, True), (others, False)):
        drawn = score_table._draw({"real_raw": real, "sim_sensed": sim}, CONFIG, 0)
        assert len(drawn) == CONFIG.bootstrap
        assert all(np.array_equal(r, s) for r, s in drawn) == together
        assert all(set(r) <= set(real.groups) and set(s) <= set(sim.groups) for r, s in drawn)


def test_unknown_names_are_refused_with_the_nearest():
    with pytest.raises(UserError, match="'ddg_graft'.*Did you mean 'ddg_no_graft'"):
        ScoreConfig(columns=("sim_gt", "ddg_graft"))
    with pytest.raises(UserError, match="'resnet'.*Did you mean 'resnet18'"):
        ScoreConfig(features=("resnet",))
    with pytest.raises(UserError, match="score.columns is empty"):
        ScoreConfig(columns=())
    with pytest.raises(UserError, match="score.trajectories is 1; expected at least 2"):
        ScoreConfig(trajectories=1)


def test_of_many_maps_the_classifier_sees_some_of_either_set(monkeypatch):
    monkeypatch.setattr(two_samples, "AUC_MAPS", 100)
    auc, _ = two_samples.classifier_auc(sample(0, groups=20), sample(2, 4.0, 20, 200), [])
    assert auc > 0.99
