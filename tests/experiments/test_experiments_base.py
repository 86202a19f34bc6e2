"""Experiments as data: every one there is, the published numbers by their own averages, and what is refused."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from gvz.core.errors import ConfigError
from gvz.experiments.base import SCENARIOS, Experiment, TrainingRun, experiment_named, experiments
from gvz.tasks import named_tasks, parse_task

THESIS_AVERAGES = {
    "training_difficulty": (79.99, 66.23, 42.91, 30.84, 24.81),
    "training_set_size": (32.34, 38.22, 37.33),
    "algorithm_comparison": (23.44, 41.84),
    "rainbow_evaluation": (82.24, 66.64, 52.08, 34.02, 23.87),
}
"""last rows of Tables 5.3 to 5.6"""

LEVEL_AVERAGES = {
    "training_difficulty": (50.42, 56.90, 33.72, 54.79),
    "rainbow_evaluation": (60.42, 51.91, 46.27, 48.47),
}
"""last columns of Tables 5.3 and 5.6"""

ALL = sorted(experiments())


def make_experiment(**changes) -> Experiment:
    return dataclasses.replace(experiments()["quick_comparison"], **changes)


def test_the_thesis_s_four_and_the_quick_one_are_there():
    assert set(ALL) == {*THESIS_AVERAGES, "quick_comparison"}


@pytest.mark.parametrize("name", ALL)
def test_every_run_has_an_id_of_its_own_tasks_of_its_scenario_and_checkpoints_up_to_its_end(name):
    runs = experiments()[name].runs()
    assert len({run.id for run in runs}) == len(runs)
    for run in runs:
        assert {parse_task(task).scenario.id for task in run.tasks} == {run.scenario}
        assert len(run.checkpoints) == run.num_checkpoints
        assert run.checkpoints[-1] == run.total_updates
        assert list(run.checkpoints) == sorted(set(run.checkpoints))


@pytest.mark.parametrize(("name", "averages"), THESIS_AVERAGES.items())
def test_published_numbers_average_to_the_thesis_s_last_row(name, averages):
    rows = experiments()[name].published["thesis"]
    assert tuple(rows) == SCENARIOS
    assert np.mean(list(rows.values()), axis=0) == pytest.approx(averages, abs=0.0051)


@pytest.mark.parametrize(("name", "averages"), LEVEL_AVERAGES.items())
def test_published_levels_average_to_the_thesis_s_last_column(name, averages):
    rows = list(experiments()[name].published["thesis"].values())
    assert np.mean(rows, axis=1) == pytest.approx(averages, abs=0.0061)  # 51.904 is printed as 51.91


def test_levdoom_s_scores_stand_as_percent_of_its_bounds():
    rows = experiments()["algorithm_comparison"].published["LevDoom"]
    assert rows["defend_the_center"] == (30.75, 35.02)  # 645.7 and 735.4 of 2100 frames
    assert rows["seek_and_kill"] == (56.0, 64.5)  # 11.2 and 12.9 of 20 kills


@pytest.mark.parametrize(
    ("name", "runs", "updates", "tasks"),
    [
        ("training_difficulty", 76 * 3, 500_000, 1),
        ("training_set_size", 4 * 3 * 3, 200_000, 7),
        ("algorithm_comparison", 4 * 2 * 3, 200_000, 7),
        ("rainbow_evaluation", 4 * 3, 200_000, 18),
        ("quick_comparison", 2 * 3, 20_000, 18),
    ],
)
def test_grids_are_the_thesis_s(name, runs, updates, tasks):
    experiment = experiments()[name]
    found = experiment.runs()
    assert len(found) == runs
    assert {run.total_updates for run in found} == {updates}
    assert {run.seed for run in found} == {1111, 2222, 3333}
    assert len(experiment.evaluation_tasks(found[0])) == tasks


def test_training_difficulty_evaluates_each_run_on_its_own_task():
    experiment = experiments()["training_difficulty"]
    for run in experiment.runs():
        assert experiment.evaluation_tasks(run) == run.tasks
    names = {run.training for run in experiment.runs() if run.scenario == "defend_the_center"}
    assert names == {task.name for task in named_tasks("defend_the_center")}


def test_the_table_of_a_comparison_is_over_the_test_tasks_and_that_of_levels_over_all():
    quick, levels = experiments()["quick_comparison"], experiments()["rainbow_evaluation"]
    test = tuple(task.id for task in named_tasks("defend_the_center", split="test"))
    assert set(quick.table_tasks(quick.runs()[0])) == set(test)
    assert len(levels.table_tasks(levels.runs()[0])) == 18


def test_a_run_is_named_by_config_scenario_training_and_seed():
    run = TrainingRun(
        config="rainbow_4task",
        scenario="seek_and_kill",
        training="train4",
        tasks=("seek_and_kill/default",),
        seed=2222,
        total_updates=200,
        num_checkpoints=3,
    )
    assert run.id == "rainbow_4task/seek_and_kill/train4/seed_2222"
    assert run.checkpoints == (66, 132, 200)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"seeds": ()}, r"experiment quick_comparison: seeds: got \(\), want at least one, each once"),
        ({"seeds": (1, 1)}, "want at least one, each once"),
        ({"episodes": 0}, "episodes: got 0, want at least 1"),
        ({"num_checkpoints": 4, "total_updates": 3}, "num_checkpoints 4, total_updates 3, want each at most the next"),
        ({"trainings": ("test",)}, "trainings: got 'test', want train1, train4, train8 or each"),
        ({"evaluate_on": "own"}, "evaluate_on 'own' wants trainings"),
        ({"published": {"thesis": {"seek_and_kill": (1.0,)}}}, r"seek_and_kill: got 1 numbers, want 2, one for each"),
        ({"scenarios": ("defend_the_centre",)}, "unknown scenario 'defend_the_centre'"),
    ],
)
def test_an_experiment_that_cannot_be_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make_experiment(**changes)


def test_an_unknown_name_is_answered_with_the_nearest():
    with pytest.raises(ConfigError, match=r"unknown experiment 'training_size'.*training_set_size"):
        experiment_named("training_size")


def test_the_page_lists_every_experiment_with_its_size():
    page = (Path(__file__).parents[2] / "docs" / "EXPERIMENTS.md").read_text()
    for experiment in experiments().values():
        (line,) = [line for line in page.splitlines() if line.startswith(f"| `{experiment.name}` |")]
        assert line.endswith(f"| {len(experiment.runs())} | {experiment.total_updates:,} |")
