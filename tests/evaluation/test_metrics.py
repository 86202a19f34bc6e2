"""Statistics against hand-worked numbers and scipy."""

import numpy as np
import pytest
from scipy import stats

from gvz.evaluation.metrics import Estimate, bootstrap, interquartile_mean, mean


def test_interquartile_mean_by_hand():
    assert interquartile_mean(np.array([100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -90.0])) == 3.5  # of 2, 3, 4, 5


def test_interquartile_mean_is_scipys_trimmed_mean():
    scores = np.random.default_rng(0).normal(size=(3, 41))
    assert interquartile_mean(scores) == pytest.approx(stats.trim_mean(scores, 0.25, axis=None))


def test_the_interval_of_a_mean_agrees_with_scipys_bootstrap():
    scores = np.random.default_rng(1).exponential(300, size=120)
    ours = bootstrap([scores], num_resamples=4000)
    theirs = stats.bootstrap((scores,), np.mean, method="percentile", n_resamples=4000, rng=2).confidence_interval
    assert ours.value == pytest.approx(scores.mean())
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), rel=0.02)


def test_strata_are_resampled_within_themselves():
    strata = [np.full(20, 10.0), np.full(20, 30.0)]
    assert bootstrap(strata) == Estimate(value=20.0, low=20.0, high=20.0)
    assert bootstrap([np.concatenate(strata)]).low < 20.0


def test_the_same_seed_gives_the_same_interval():
    scores = np.arange(50.0)
    assert bootstrap([scores], mean, seed=3) == bootstrap([scores], mean, seed=3)


def test_intervals_overlap_or_not():
    assert Estimate(value=2, low=1, high=3).overlaps(Estimate(value=4, low=3, high=5))
    assert not Estimate(value=2, low=1, high=3).overlaps(Estimate(value=4, low=3.1, high=5))


@pytest.mark.parametrize(("strata", "confidence"), [([], 0.95), ([np.zeros(0)], 0.95), ([np.zeros(3)], 1.5)])
def test_nothing_to_resample_is_an_error(strata, confidence):
    with pytest.raises(ValueError, match="bootstrap: got"):
        bootstrap(strata, confidence=confidence)
