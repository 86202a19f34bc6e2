"""Curves against hand-worked numbers."""

from pathlib import Path

import numpy as np
import polars as pl
import pytest

from gvz.reports.curves import (
    checkpoints_of_runs,
    evaluation_curve,
    learning_curve,
    running_mean,
    share_curve,
    usual_tasks,
)
from gvz.reports.runs import Run


def run_of(seed: int, episodes: list[tuple[int, str, float]]) -> Run:
    frame = pl.DataFrame(episodes, ["num_updates", "task", "normalized_score"], orient="row")
    config = {"name": "r", "seed": seed, "learner": {"total_updates": 100}}
    return Run(
        path=Path("r"),
        id="r",
        config=config,
        tasks=("a/x",),
        metrics=pl.DataFrame(),
        training_episodes=frame,
        starts=(),
    )


def test_the_running_mean_by_hand():
    assert running_mean(np.array([1.0, 2.0, 6.0, 7.0]), 2).tolist() == [1.0, 1.5, 4.0, 6.5]


def test_a_learning_curve_is_the_mean_of_the_seeds_running_means():
    runs = [run_of(1, [(0, "a/x", 10.0), (99, "a/x", 30.0)]), run_of(2, [(0, "a/x", 20.0), (99, "a/x", 20.0)])]
    curve = learning_curve("x", runs, ["a/x"])
    assert curve is not None
    assert curve.points is None
    assert curve.values[0] == 15.0  # of 10 and 20
    assert curve.values[-1] == 20.0  # of (10 + 30) / 2 and 20
    assert (curve.low[0], curve.high[0]) == (10.0, 20.0)


def test_a_learning_curve_is_of_the_gradient_steps_that_all_seeds_have_in_whatever_order_they_stand():
    runs = [
        run_of(1, [(99, "a/x", 50.0), (0, "a/x", 10.0)]),
        run_of(2, [(20, "a/x", 20.0), (79, "a/x", 40.0), (80, "a/x", 0.0)]),
    ]
    curve = learning_curve("x", runs, ["a/x"])
    assert curve is not None
    assert curve.updates[[0, -1]].tolist() == [20.0, 80.0]
    assert curve.values[[0, -1]].tolist() == [15.0, 15.0]  # 10 and 20; 10 and (20 + 40 + 0) / 3


def test_the_band_is_the_middle_95_percent_of_redrawn_seeds():
    """Of 0, 0 and 90: a redraw has three times 90 in 3.7 cases of 100, less often than 1 of 20, more than 1 of 40."""
    curve = learning_curve(
        "x", [run_of(n, [(0, "a/x", s), (99, "a/x", s)]) for n, s in enumerate((0.0, 0.0, 90.0))], ["a/x"]
    )
    assert curve is not None
    assert (curve.low[0], curve.high[0]) == (0.0, 90.0)


def test_a_curve_of_one_seed_shows_its_episodes():
    curve = learning_curve("x", [run_of(1, [(0, "a/x", 10.0), (99, "a/x", 30.0)])], ["a/x"])
    assert curve is not None
    assert curve.points is not None
    assert curve.points[1].tolist() == [10.0, 30.0]


def test_the_share_of_a_task_is_of_the_episodes_before():
    run = run_of(1, [(1, "a/x", 10.0), (2, "a/y", 30.0), (3, "a/x", 0.0), (4, "a/y", 0.0)])
    curve = share_curve(run, "a/y")
    assert curve is not None
    assert curve.values == pytest.approx([0, 50, 100 / 3, 50])
    assert share_curve(run_of(1, []), "a/y") is None


def test_without_episodes_of_a_task_there_is_no_curve():
    assert learning_curve("x", [run_of(1, [(0, "a/x", 10.0)])], ["a/x", "a/y"]) is None
    assert learning_curve("x", [], ["a/x"]) is None


def evaluated(rows: list[tuple[int, int, str, float]]) -> pl.DataFrame:
    """Episodes of one agent: training seed, gradient steps, task, score. The level is 0 for a/x, else 1."""
    frame = pl.DataFrame(rows, ["run_seed", "num_updates", "task", "normalized_score"], orient="row")
    return frame.with_columns(
        run_dir=pl.format("r{}", "run_seed"),
        run=pl.lit("r"),
        scenario=pl.lit("a"),
        level=(pl.col("task") != "a/x").cast(int),
    )


def test_an_evaluation_curve_takes_the_nth_checkpoints_together():
    scores = {1: ((100, 10.0), (200, 30.0)), 2: ((110, 20.0), (200, 50.0))}
    frame = evaluated(
        [(seed, at, task, score) for seed, of in scores.items() for at, score in of for task in ("a/x", "a/y")]
    )
    curve = evaluation_curve("r", frame, ["a/x", "a/y"])
    assert curve is not None
    assert curve.updates.tolist() == [105.0, 200.0]
    assert curve.values.tolist() == [15.0, 40.0]
    assert curve.low == pytest.approx([10.0, 30.0])
    assert evaluation_curve("r", frame, ["a/z"]) is None


def test_runs_with_other_numbers_of_evaluated_checkpoints_meet_at_the_same_gradient_steps():
    frame = evaluated([(1, 100, "a/x", 10.0), (1, 200, "a/x", 30.0), (2, 200, "a/x", 50.0)])
    curve = evaluation_curve("r", frame, ["a/x"])
    assert curve is not None
    assert curve.updates.tolist() == [100.0, 200.0]
    assert curve.values.tolist() == [10.0, 40.0]
    assert checkpoints_of_runs(frame).sort().to_list() == [1, 2]


def test_a_checkpoint_with_more_tasks_leaves_the_tasks_of_the_others():
    rows = [(seed, updates, task, 10.0) for seed in (1, 2) for updates in (100, 200, 300) for task in ("a/x", "a/y")]
    assert sorted(usual_tasks(evaluated([*rows, (1, 300, "a/z", 10.0)]))) == ["a/x", "a/y"]
    assert sorted(usual_tasks(evaluated([*rows, (1, 400, "a/x", 10.0)]))) == ["a/x", "a/y"]
    alike = evaluated([*rows[:2], (1, 100, "a/z", 10.0), (1, 200, "a/z", 10.0)])
    for _ in range(10):  # polars groups in any order
        assert sorted(usual_tasks(alike)) == ["a/x", "a/y", "a/z"], "of equally usual ones the more"
