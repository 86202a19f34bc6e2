"""Tables of experiments: hand-worked numbers, published ones beside them and apart, missing cells missing."""

import dataclasses
import json

import numpy as np
import pytest

from gvz.evaluation.statistics import Estimate
from gvz.experiments.base import experiment_named
from gvz.experiments.inventory import run_directory
from gvz.experiments.plan import Plan
from gvz.reports.experiment_section import aggregate_table, comparison_table, experiment_section, result_table
from gvz.reports.results import PlannedExperiment, read_results
from gvz.reports.scores import Scores, estimate
from gvz.tasks import parse_task
from tests.reports.conftest import write_rows

SEEDS = {1111: 0.0, 2222: 3.0, 3333: 6.0}


def by_config(played) -> float:
    """30 + seed for Rainbow, 20 + seed for DQN, at the last checkpoint; nothing before."""
    if played.updates < played.run.total_updates:
        return 0.0
    return (30.0 if played.run.config == "rainbow_quick" else 20.0) + SEEDS[played.run.seed]


@pytest.fixture(scope="module")
def compared(tmp_path_factory, experiments_writer):
    results = tmp_path_factory.mktemp("compared")
    missing = ("rainbow_quick/defend_the_center/train4/seed_3333",)
    experiments_writer(results, Plan.of("quick_comparison", scale=0.2), by_config, without=missing)
    return read_results([results])


def test_the_table_is_the_mean_over_test_tasks_and_seeds_of_the_last_checkpoints(compared):
    (asked,) = compared.asked
    assert asked.experiment.table_checkpoints == 1
    table = result_table(compared, asked)
    assert table.columns == ("scenario", "numbers", "dqn_quick", "rainbow_quick")
    assert "percent of the upper bound on the test tasks (" in table.caption
    ((scenario, whose, dqn, rainbow),) = table.rows
    assert (scenario.text, whose.text) == ("Defend the Center", "ours")
    assert (dqn.text, dqn.note) == ("23.0 [20.0, 26.0]", "")  # 20, 23, 26
    assert rainbow.estimate is not None
    assert (rainbow.estimate.value, rainbow.note) == (31.5, "2 of 3 seeds")  # 30, 33


def test_the_difference_and_its_probability(compared):
    table = comparison_table(compared, compared.asked[0])
    assert table.caption.startswith("Difference of the means on the test tasks in points, ")
    ((_, which, gain, probability),) = table.rows
    assert which.text == "rainbow_quick against dqn_quick"
    assert gain.estimate is not None
    assert gain.estimate.value == 8.5
    assert probability.text == "1.00 [1.00, 1.00]"


def test_an_experiment_of_one_column_has_no_table_of_comparisons(compared, tmp_path):
    (asked,) = compared.asked
    alone = dataclasses.replace(asked, experiment=experiment_named("general_segmented_train4_long"))
    titles = [table.id for block in experiment_section(compared, alone, tmp_path).blocks for table in block.tables]
    assert titles == ["general_segmented_train4_long", "general_segmented_train4_long_aggregates"]


def test_aggregates_have_mean_iqm_and_median(compared):
    table = aggregate_table(compared, compared.asked[0])
    assert table.caption.startswith("The table's tasks of all scenarios together, ")
    dqn, _ = table.rows
    assert [cell.estimate.value for cell in dqn[1:] if cell.estimate] == [23.0, 23.0, 23.0]


def test_aggregates_over_scenarios_that_have_other_seeds_are_missing(tmp_path, monkeypatch):
    def column_scores(_results, _asked, scenario: str, _column):
        seeds = (1, 2) if scenario == "seek_and_kill" else (1, 2, 3)
        return Scores(runs={seed: {"one": np.ones(2)} for seed in seeds}, wanted_seeds=(1, 2, 3)), ("one",)

    monkeypatch.setattr("gvz.reports.experiment_section.column_scores", column_scores)
    asked = PlannedExperiment(results=tmp_path, experiment=experiment_named("training_set_size"), scale=1.0)
    table = aggregate_table(read_results([tmp_path]), asked)
    assert {(cell.kind, cell.note) for row in table.rows for cell in row[1:]} == {
        ("missing", "scenarios differ in seeds")
    }


def test_published_numbers_stand_below_ours_and_in_no_mean_of_ours(tmp_path, experiments_writer):
    plan = Plan.of("training_set_size", scale=0.01, scenarios=("health_gathering", "seek_and_kill"))
    experiments_writer(tmp_path, plan, lambda one: len(one.run.tasks) + 10.0 * (one.run.scenario == "seek_and_kill"))
    results = read_results([tmp_path])
    rows = result_table(results, results.asked[0]).rows  # P_norm is of all scenarios
    assert [(row[0].text, row[1].text) for row in rows] == [
        ("Health Gathering", "ours"),
        ("Health Gathering", "thesis"),
        ("Seek and Kill", "ours"),
        ("Seek and Kill", "thesis"),
        ("mean over scenarios", "ours"),
        ("mean over scenarios", "thesis"),
    ]
    assert [cell.text for cell in rows[1][2:]] == ["27.92", "35.75", "32.91"]
    assert {cell.kind for row in rows for cell in row[2:] if row[1].text == "thesis"} == {"theirs"}
    assert [cell.estimate.value for cell in rows[4][2:] if cell.estimate] == [6.0, 9.0, 13.0]
    assert [cell.text for cell in rows[5][2:]] == ["27.63", "34.50", "28.41"]  # (27.92 + 27.34) / 2, ...


def test_a_gate_has_a_table_over_its_gate_tasks_and_one_over_the_tasks_of_training(tmp_path, experiments_writer):
    def score(played) -> float:
        decisions = float(played.run.agent.rpartition("_")[2])
        return decisions + (50.0 if played.task in played.run.tasks else 0.0) + SEEDS[played.run.seed]

    experiments_writer(tmp_path, Plan.of("gate_reuse", scale=0.2), score)
    results = read_results([tmp_path])
    (asked,) = results.asked
    gate, training = result_table(results, asked), result_table(results, asked, trained=True)
    names = tuple(f"rainbow_4task+decisions_{n}" for n in (4, 16, 64))
    assert gate.columns == training.columns == ("scenario", "numbers", *names)
    assert [[cell.estimate.value for cell in row[2:] if cell.estimate] for row in gate.rows] == [
        [5.5, 17.5, 65.5]  # mean of seeds 0 and 3
    ] * 3
    assert [cell.estimate.value for cell in training.rows[0][2:] if cell.estimate] == [55.5, 67.5, 115.5]
    assert "on the gate tasks" in gate.caption
    assert "on the tasks of training" in training.caption
    section = experiment_section(results, asked, tmp_path)
    assert "240 seconds of processor time, at most 12,000 gradient steps" in section.blocks[0].text[1]
    assert section.blocks[1].text == (
        "Such runs are evaluated once. Curves of their training are in the sections of the scenarios.",
    )
    assert all(run.ended for run in results.runs), "the records have 240 seconds"
    assert {run.processor_s for run in results.runs} == {240.0}


def test_a_level_is_the_mean_of_its_tasks_each_trained_alone(tmp_path, experiments_writer):
    def score(played) -> float:
        return 80.0 - 10 * parse_task(played.task).level + (4.0 if "gore" in played.task else 0.0)

    plan = Plan.of("training_difficulty", scale=0.01, scenarios=("defend_the_center",))
    alone = "rainbow_4task/defend_the_center/complete/seed_1111"
    experiments_writer(tmp_path, plan, score, without=(alone,))
    results = read_results([tmp_path])
    table = result_table(results, results.asked[0])
    assert "percent of the upper bound (" in table.caption
    ours, published = table.rows
    values = [round(cell.estimate.value, 2) for cell in ours[2:6] if cell.estimate]
    assert values == [80.0, round(70 + 4 / 7, 2), round(60 + 8 / 6, 2), round(50 + 8 / 3, 2)]
    assert (ours[6].kind, ours[6].text, ours[6].note) == ("missing", "-", "0 of 1 seeds")
    assert published[2].text == "87.48"


@pytest.mark.parametrize(("agents_of_tasks", "ends"), [(False, (5.0, 5.0)), (True, (0.0, 10.0))])
def test_seeds_of_agents_of_single_tasks_are_redrawn_for_each_task(agents_of_tasks: bool, ends: tuple[float, float]):
    """Each seed is good on one of two tasks. Of one agent, the mean is always 5. Of two, both drawn may be bad."""
    zero, ten = np.zeros(1), np.full(1, 10.0)
    runs = {1: {"one": zero, "other": ten}, 2: {"one": ten, "other": zero}}
    scores = Scores(runs=runs, wanted_seeds=(1, 2), agents_of_tasks=agents_of_tasks)
    assert estimate(scores, ("one", "other")).estimate == Estimate(value=5.0, low=ends[0], high=ends[1])


def test_the_only_seed_that_has_all_tasks_has_an_interval_over_its_episodes():
    cell = estimate(Scores(runs={1: {"one": np.array([0.0, 10.0] * 9)}, 2: {}}, wanted_seeds=(1, 2)), ["one"])
    assert cell.estimate is not None
    assert cell.estimate.low < cell.estimate.value == 5.0 < cell.estimate.high
    assert cell.note == "1 of 2 seeds"


def test_an_experiment_without_any_results_is_a_table_of_missing_cells(tmp_path):
    experiment = experiment_named("algorithm_comparison")
    (tmp_path / "random.jsonl").touch()
    results = read_results([tmp_path])
    asked = PlannedExperiment(results=tmp_path, experiment=dataclasses.replace(experiment, published={}), scale=1.0)
    rows = result_table(results, asked).rows
    assert len(rows) == 5
    assert rows[-1][0].text == "P_norm: mean over scenarios"
    assert {cell.text for row in rows for cell in row[2:]} == {"-"}
    assert {cell.note for row in rows for cell in row[2:]} == {"0 of 3 seeds"}


def test_a_table_is_of_the_planned_checkpoints_whatever_others_were_evaluated(tmp_path, experiments_writer):
    plan = Plan.of("rainbow_evaluation", scale=0.05, scenarios=("defend_the_center",))
    experiments_writer(tmp_path, plan, lambda played: 100.0 * played.updates / played.run.total_updates)
    ((run, *_), (asked, *_)) = plan.runs(), plan.experiments()
    assert (len(run.checkpoints), asked.table_checkpoints) == (10, 2)
    file = run_directory(tmp_path, run) / "evaluation.jsonl"
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    newest = [row for row in lines if row["num_updates"] == run.checkpoints[-1]]
    another = {"player": "stopped and resumed", "num_updates": run.checkpoints[-2] + 7, "normalized_score": 0.0}

    def table() -> list[str]:
        results = read_results([tmp_path])
        return [cell.text for cell in result_table(results, results.asked[0]).rows[0]]

    before = table()
    assert before[2].startswith("95.0 [")  # of 90 and 100
    write_rows(file, [*lines, *({**row, **another} for row in newest)])
    assert table() == before
