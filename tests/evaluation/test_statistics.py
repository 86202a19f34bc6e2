"""Statistics against hand-worked numbers, scipy and rliable."""

import re
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

from gvz.evaluation.statistics import (
    Estimate,
    bootstrap,
    bootstrap_runs,
    difference,
    generalization_gap,
    interquartile_mean,
    mean,
    mean_over_scenarios,
    median,
    normalize,
    probability_of_improvement,
    solved,
)

OURS = np.array([[12.0, 40, 55, 8], [18, 35, 60, 9], [11, 52, 41, 30]])
THEIRS = np.array([[10.0, 41, 30, 8], [14, 35, 44, 2], [19, 20, 33, 5]])


def cells(scores: np.ndarray) -> list[list[np.ndarray]]:
    """Runs that were evaluated for one episode a task."""
    return [[np.array([score]) for score in run] for run in scores]


def test_interquartile_mean_by_hand():
    assert interquartile_mean(np.array([100.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, -90.0])) == 3.5  # of 2, 3, 4, 5


def test_interquartile_mean_is_scipys_trimmed_mean():
    scores = np.random.default_rng(0).normal(size=(3, 41))
    assert interquartile_mean(scores) == pytest.approx(stats.trim_mean(scores, 0.25, axis=None))


def test_statistics_of_two_runs_and_two_tasks_by_hand():
    scores = np.array([[10.0, 40.0], [30.0, 80.0]])
    assert mean(scores) == 40.0
    assert median(scores) == 40.0  # of the tasks' means 20 and 60
    assert mean_over_scenarios(scores, np.array([[1.0, 2.0, 3.0]])) == 21.0  # of 40 and 2
    assert difference(scores, np.array([[5.0, 7.0]])) == 34.0
    assert generalization_gap(scores, 1) == -40.0  # 20 on the first task, 60 on the other
    assert normalize(550.0, 1100.0) == 50.0


def test_probability_of_improvement_by_hand():
    # first task: 3 > 1, 3 > 2, 2 > 1, and 2 ties 2: 3.5 of 4; second task: 0 of 4
    ours, theirs = np.array([[3.0, 0.0], [2.0, 0.0]]), np.array([[1.0, 5.0], [2.0, 5.0]])
    assert probability_of_improvement(ours, theirs) == 3.5 / 8


def test_probability_of_improvement_is_the_mann_whitney_statistic():
    tasks = range(OURS.shape[1])
    of_tasks = [stats.mannwhitneyu(OURS[:, t], THEIRS[:, t]).statistic / len(OURS) ** 2 for t in tasks]
    assert probability_of_improvement(OURS, THEIRS) == pytest.approx(np.mean(of_tasks))


@pytest.mark.parametrize("statistic", [mean, median, interquartile_mean])
def test_statistics_keep_the_axes_before_runs_and_tasks(statistic):
    many = np.random.default_rng(0).normal(size=(5, 2, 3, 4))
    assert statistic(many).shape == (5, 2)
    assert statistic(many)[3, 1] == pytest.approx(statistic(many[3, 1]))
    assert statistic(many[0, 0, 0]).shape == ()


# rliable 1.2.0 on OURS and THEIRS: aggregate_*, probability_of_improvement and get_interval_estimates(reps=50000),
# whose StratifiedBootstrap draws runs within each task
RLIABLE = {
    interquartile_mean: (29.333333, 24.666667, 36.166667),
    median: (29.0, 25.0, 36.166667),
    mean: (30.916667, 26.75, 35.333333),
}


@pytest.mark.parametrize("statistic", RLIABLE)
def test_value_and_interval_are_rliables(statistic):
    ours = bootstrap_runs([cells(OURS)], statistic, redraw=["runs_by_task"], num_resamples=20_000)
    assert (ours.value, ours.low, ours.high) == pytest.approx(RLIABLE[statistic], abs=0.35)
    assert ours.value == pytest.approx(RLIABLE[statistic][0])


def test_the_interval_of_the_probability_of_improvement_is_rliables():
    pair = [cells(OURS), cells(THEIRS)]
    ours = bootstrap_runs(pair, probability_of_improvement, redraw=["runs_by_task"] * 2, num_resamples=20_000)
    assert ours == Estimate(value=0.75, low=pytest.approx(0.5556, abs=0.03), high=pytest.approx(0.9167, abs=0.03))


def test_the_interval_of_a_mean_agrees_with_scipys_bootstrap():
    scores = np.random.default_rng(1).exponential(300, size=120)
    ours = bootstrap([scores], num_resamples=4000)
    theirs = stats.bootstrap((scores,), np.mean, method="percentile", n_resamples=4000, rng=2).confidence_interval
    assert ours.value == pytest.approx(scores.mean())
    assert (ours.low, ours.high) == pytest.approx((theirs.low, theirs.high), rel=0.02)


def test_redrawing_episodes_of_one_run_is_the_bootstrap_of_its_episodes():
    scores = np.random.default_rng(1).exponential(300, size=120)
    one = bootstrap_runs([[[scores]]], redraw=["episodes"], num_resamples=4000)
    assert one == bootstrap([scores], num_resamples=4000)


def test_a_run_drawn_whole_keeps_its_tasks_together():
    # two runs, each good where the other is bad: whole runs have the same mean, and task by task anything may come
    opposite = cells(np.array([[0.0, 10.0], [10.0, 0.0]]))
    assert bootstrap_runs([opposite], redraw=["runs"]) == Estimate(value=5.0, low=5.0, high=5.0)
    assert bootstrap_runs([opposite], redraw=["runs_by_task"]) == Estimate(value=5.0, low=0.0, high=10.0)


def test_episodes_are_redrawn_within_their_run_and_task():
    certain = [[np.full(20, 10.0), np.full(5, 30.0)], [np.full(20, 20.0), np.full(1, 40.0)]]
    assert bootstrap_runs([certain], redraw=["episodes"]) == Estimate(value=25.0, low=25.0, high=25.0)


def test_every_run_and_task_counts_alike_however_many_episodes_it_has():
    assert bootstrap_runs([[[np.array([0.0]), np.array([6.0, 6.0, 6.0])]]], redraw=["episodes"]).value == 3.0


def test_strata_are_resampled_within_themselves():
    strata = [np.full(20, 10.0), np.full(20, 30.0)]
    assert bootstrap(strata) == Estimate(value=20.0, low=20.0, high=20.0)
    assert bootstrap([np.concatenate(strata)]).low < 20.0


def test_resamples_drawn_in_blocks_are_as_many_as_asked_for(monkeypatch):
    scores = np.random.default_rng(1).exponential(300, size=120)
    whole = bootstrap([scores], num_resamples=500)
    monkeypatch.setattr("gvz.evaluation.statistics._BLOCK_NUMBERS", 120 * 7)
    assert bootstrap([scores], num_resamples=500) == whole


def test_the_same_seed_gives_the_same_interval():
    scores = np.arange(50.0)
    assert bootstrap([scores], seed=3) == bootstrap([scores], seed=3)


def test_intervals_overlap_or_not():
    assert Estimate(value=2, low=1, high=3).overlaps(Estimate(value=4, low=3, high=5))
    assert not Estimate(value=2, low=1, high=3).overlaps(Estimate(value=4, low=3.1, high=5))


def test_a_task_is_solved_by_ten_time_outs_in_a_row():
    assert solved(np.array([False] + [True] * 10))
    assert not solved(np.array([True] * 9 + [False] + [True] * 9))
    assert not solved(np.array([], bool))


@pytest.mark.parametrize("strata", [[], [np.zeros(0)]])
def test_nothing_to_resample_is_an_error(strata):
    with pytest.raises(ValueError, match="at least one episode in each"):
        bootstrap(strata)


@pytest.mark.parametrize("runs", [[], [[]], [[np.zeros(0)]], [[np.ones(1)], [np.ones(1), np.ones(1)]]])
def test_runs_that_are_no_matrix_are_an_error(runs):
    with pytest.raises(ValueError, match="want runs with the same tasks, at least one episode in each"):
        bootstrap_runs([runs], redraw=["runs"])


def test_every_group_of_runs_needs_its_way():
    with pytest.raises(ValueError, match="got 0 groups of runs and 0 ways, want one for each"):
        bootstrap_runs([], redraw=[])
    with pytest.raises(ValueError, match="got 1 groups of runs and 2 ways"):
        bootstrap_runs([cells(OURS)], redraw=["runs", "runs"])


def test_one_side_may_be_redrawn_by_runs_and_the_other_by_episodes():
    # ours: two runs of 10 and 30; theirs: one run with the episodes 0 and 2, so the difference lies in 8..30
    theirs = [[np.array([0.0, 2.0])]]
    gain = bootstrap_runs([[[np.array([10.0])], [np.array([30.0])]], theirs], difference, redraw=["runs", "episodes"])
    assert gain == Estimate(value=19.0, low=8.0, high=30.0)


def test_the_guide_says_how_often_an_interval_over_few_seeds_holds_the_true_value():
    """Of normal seeds: what is drawn has the mean 0, and so has the difference of two such agents."""
    page = (Path(__file__).parents[2] / "docs" / "REPORTS.md").read_text()
    rng = np.random.default_rng(0)
    for num_seeds in (2, 3, 5, 10, 20):
        (row,) = re.findall(rf"^\| {num_seeds} \| (\d+) \| (\d+) \|$", page, re.MULTILINE)
        held = np.zeros(2)
        for _ in range(500):
            one, other = ([[np.array([score])] for score in rng.normal(size=num_seeds)] for _ in range(2))
            estimates = (
                bootstrap_runs([one], redraw=["runs"], num_resamples=500),
                bootstrap_runs([one, other], difference, redraw=["runs", "runs"], num_resamples=500),
            )
            held += [found.low <= 0 <= found.high for found in estimates]
        np.testing.assert_allclose(held / 5, list(map(int, row)), atol=10)  # 4.5 standard deviations of the count


def test_groups_of_the_same_runs_are_redrawn_together():
    runs = cells([[40.0], [50.0], [60.0]])
    wide = bootstrap_runs([runs, runs], mean_over_scenarios, redraw=["runs"] * 2, together=True)
    assert (wide.value, wide.low, wide.high) == (50.0, 40.0, 60.0)
    with pytest.raises(ValueError, match="want the same runs in each group"):
        bootstrap_runs([runs, runs[:2]], mean_over_scenarios, redraw=["runs"] * 2, together=True)
    with pytest.raises(ValueError, match="and to redraw runs"):
        bootstrap_runs([runs, runs], mean_over_scenarios, redraw=["runs", "episodes"], together=True)
