"""The section over all scenarios."""

import pytest

from gvz.reports.joint_section import joint_sections
from gvz.reports.results import read_results
from gvz.tasks import named_tasks
from tests.reports.conftest import evaluation_row, write_rows

PERCENT = {"health_gathering": 40.0, "seek_and_kill": 10.0}


def test_an_agent_of_two_scenarios_has_the_mean_of_their_means(tmp_path):
    rows = [
        evaluation_row(player, task.id, n, percent)
        for scenario, percent in PERCENT.items()
        for player in ("random", "idle")
        for task in named_tasks(scenario, split="test")
        for n in range(2)
        if player == "random" or scenario == "seek_and_kill"
    ]
    write_rows(tmp_path / "rows.jsonl", rows)
    (section,) = joint_sections(read_results([tmp_path]), tmp_path)
    (table,) = section.blocks[0].tables
    assert "P_norm" not in table.caption, "it is of all scenarios"
    assert table.columns == ("agent", "Health Gathering", "Seek and Kill", "mean")
    assert [[cell.text for cell in row] for row in table.rows] == [
        ["random", "40.0 [40.0, 40.0]", "10.0 [10.0, 10.0]", "25.0 [25.0, 25.0]"]
    ]
    rows += [evaluation_row("idle", task.id, 0, 0.0) for task in named_tasks(split="test")]
    write_rows(tmp_path / "rows.jsonl", rows)
    (section,) = joint_sections(read_results([tmp_path]), tmp_path)
    assert section.blocks[0].tables[0].columns[-1] == "P_norm"


def test_levels_are_means_over_the_scenarios_and_have_a_figure(tmp_path):
    percent = {"health_gathering": (90.0, 80.0, 60.0, 50.0, 20.0), "seek_and_kill": (30.0, 20.0, 20.0, 10.0, 0.0)}
    rows = [
        evaluation_row(player, task.id, n, by_level[task.level])
        for scenario, by_level in percent.items()
        for player, split in (("random", None), ("idle", "test"))
        for task in named_tasks(scenario, split=split)
        for n in range(2)
    ]
    write_rows(tmp_path / "rows.jsonl", rows)
    (section,) = joint_sections(read_results([tmp_path]), tmp_path)
    _, table = section.blocks[0].tables
    assert table.columns == ("agent", "level 0", "level 1", "level 2", "level 3", "level 4")
    assert [[cell.text.split()[0] for cell in row] for row in table.rows] == [
        ["idle", "-", "-", "-", "30.0", "10.0"],  # and is not in the figure
        ["random", "60.0", "50.0", "40.0", "30.0", "10.0"],
    ]
    (figure,) = section.blocks[0].figures
    assert (tmp_path / "figures" / f"{figure.id}.png").exists()


def test_one_scenario_needs_no_such_section(tmp_path):
    tasks = named_tasks("health_gathering", split="test")
    write_rows(tmp_path / "rows.jsonl", [evaluation_row("random", task.id, 0, 40.0) for task in tasks])
    assert joint_sections(read_results([tmp_path]), tmp_path) == []


def test_a_seed_that_is_missing_in_one_scenario_is_told_of(tmp_path):
    rows = [
        evaluation_row(f"{scenario}/{seed}", task.id, 0, 50.0, run="r", run_seed=seed, num_updates=9, params=scenario)
        for scenario, seeds in (("health_gathering", (1, 2)), ("seek_and_kill", (2,)))
        for seed in seeds
        for task in named_tasks(scenario, split="test")
    ]
    write_rows(tmp_path / "rows.jsonl", rows)
    (section,) = joint_sections(read_results([tmp_path]), tmp_path)
    ((_, *cells),) = section.blocks[0].tables[0].rows
    assert [cell.note for cell in cells] == ["", "1 of 2 seeds", "1 of 2 seeds"]


@pytest.mark.parametrize("one_run_plays_all", [True, False])
@pytest.mark.parametrize("num_earlier", [0, 7])
def test_a_run_that_plays_all_scenarios_is_redrawn_with_all_its_scores(tmp_path, one_run_plays_all, num_earlier):
    """Then the mean over scenarios varies as much as each scenario; independent runs even out. More checkpoints of it
    may have been evaluated in one of them.
    """
    rows = [
        evaluation_row(
            f"all/{seed}@{9 - age}", task.id, 0, percent, run="all", run_seed=seed, num_updates=9 - age,
            params=f"{seed} {age}",
        )
        for seed, percent in enumerate((40.0, 50.0, 60.0))
        for task in named_tasks("seek_and_kill", split="test")
        for age in range(1, num_earlier + 1)
    ]  # fmt: skip
    rows += [
        evaluation_row(
            f"all/{seed}", task.id, 0, percent, run="all", run_seed=seed, num_updates=9,
            params=str(seed) if one_run_plays_all else f"{seed} {scenario}",
        )
        for seed, percent in enumerate((40.0, 50.0, 60.0))
        for scenario in PERCENT
        for task in named_tasks(scenario, split="test")
    ]  # fmt: skip
    write_rows(tmp_path / "rows.jsonl", rows)
    (section,) = joint_sections(read_results([tmp_path]), tmp_path)
    *of_scenarios, of_all = [cell.estimate for cell in section.blocks[0].tables[0].rows[0][1:]]
    assert of_all.value == 50.0
    assert all((of_one.low, of_one.high) == (40.0, 60.0) for of_one in of_scenarios)
    assert ((of_all.low, of_all.high) == (40.0, 60.0)) == one_run_plays_all
    assert one_run_plays_all or 40.0 < of_all.low < of_all.high < 60.0
