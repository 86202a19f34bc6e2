"""What attributes cost, by hand: default 80, mossy_bricks 60, gore 70, half of it 77, both 45."""

import numpy as np

from gvz.reports.attribute_tables import attribute_figure, attribute_tables
from gvz.reports.results import read_results
from gvz.reports.scores import agent_scores
from gvz.tasks import attribute_tasks, parse_task, scenario_named
from tests.reports.conftest import evaluation_row, write_rows

SCENARIO = scenario_named("defend_the_center")
PERCENT = {
    "default": 80.0,
    "mossy_bricks": 60.0,
    "gore": 70.0,
    "gore=0.5": 77.0,
    "gore+mossy_bricks": 45.0,
    "varied": 5.0,
    "varied+gore": 4.0,
    "fast_enemies+gore": 3.0,
}
"""drawn maps, and a pair of which one was not played alone, stand in no table"""


def scores_of(tmp_path, percent):
    rows = [evaluation_row("random", task, n, value) for task, value in percent.items() for n in range(2)]
    write_rows(tmp_path / "rows.jsonl", rows)
    return {"random": agent_scores(read_results([tmp_path]).episodes, "random")}


def test_the_loss_of_an_attribute_and_what_two_cost_beyond_their_sum(tmp_path):
    tasks = [parse_task(f"defend_the_center/{name}") for name in PERCENT]
    scores = scores_of(tmp_path, {task.id: PERCENT[task.name] for task in tasks})
    single, pairs = attribute_tables(SCENARIO, scores, tasks)
    assert {row[0].text: row[1].text for row in single.rows} == {
        "gore=0.5": "3.0 [3.0, 3.0]",
        "gore": "10.0 [10.0, 10.0]",
        "mossy_bricks": "20.0 [20.0, 20.0]",
    }
    assert [[cell.text for cell in row] for row in pairs.rows] == [["gore + mossy_bricks", "5.0 [5.0, 5.0]"]]
    assert attribute_figure(SCENARIO, "random", scores["random"], tasks, tmp_path, "few") is None


def test_all_pairs_are_a_picture(tmp_path):
    tasks = attribute_tasks("defend_the_center")
    names = [attribute.name for attribute in SCENARIO.attributes]
    singles = [name for one in names for name in (f"{one}=0.5", one)]
    assert [task.name for task in tasks[: 1 + 2 * len(names)]] == ["default", *singles]
    assert len({task.id for task in tasks}) == len(tasks)
    assert parse_task("defend_the_center/gore+mossy_bricks") in tasks
    assert all(len(task.attributes) == 2 for task in tasks[1 + 2 * len(names) :])
    scores = scores_of(tmp_path, {task.id: 90.0 - 20 * len(task.attributes) for task in tasks})
    (tmp_path / "figures").mkdir()
    figure = attribute_figure(SCENARIO, "random", scores["random"], tasks, tmp_path, "pairs")
    assert figure is not None
    assert (tmp_path / "figures" / "pairs.png").stat().st_size > 1000
    _, pairs = attribute_tables(SCENARIO, scores, tasks)
    assert {cell.estimate.value for _, cell in pairs.rows} == {0.0}
    assert np.isfinite([cell.estimate.low for _, cell in pairs.rows]).all()
