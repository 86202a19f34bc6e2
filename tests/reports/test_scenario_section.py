"""The section of a scenario: own kills beside a score that is kills, levels, who solved a task, gaps, curves."""

import pytest

from gvz.evaluation.statistics import SOLVED_EPISODES
from gvz.experiments.plan import Plan
from gvz.reports import draw
from gvz.reports.document import Figure
from gvz.reports.results import read_results
from gvz.reports.scenario_section import scenario_sections
from gvz.tasks import named_tasks, parse_task
from tests.reports.conftest import evaluation_row, write_rows

DEFAULT, BLUE, RED = named_tasks("seek_and_kill")[:3]


@pytest.fixture
def no_files(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures are drawn, but not written as three files each, which takes most of a section's time."""
    monkeypatch.setattr(
        draw, "_written", lambda _picture, _out, id, caption, **_: Figure(id=id, caption=caption, svg=b"")
    )


def test_own_kills_stand_below_the_scores_by_task_and_by_level(tmp_path):
    own = {"idle": {DEFAULT: 0.0, BLUE: 0.0, RED: 0.0}, "scripted": {BLUE: 6.0, RED: 9.0}}
    rows = [
        {"player": player, "task": task.id, "episode": n, "seed": n, "score": 12.0, "player_kills": kills}
        for player, by_task in own.items()
        for task, kills in by_task.items()
        for n in range(2)
    ]
    write_rows(tmp_path / "rows.jsonl", rows)
    (section,) = scenario_sections(read_results([tmp_path]), tmp_path)
    levels, tasks, own_kills, _ = section.blocks[0].tables
    assert (levels.id, tasks.id) == ("seek_and_kill_levels", "seek_and_kill_tasks")
    assert own_kills.columns == ("task", "level", "idle", "scripted")
    assert [[cell.text for cell in row] for row in own_kills.rows] == [
        ["default", "0", "0.0 [0.0, 0.0]", "-"],
        ["blue", "1", "0.0 [0.0, 0.0]", "6.0 [6.0, 6.0]"],
        ["red", "1", "0.0 [0.0, 0.0]", "9.0 [9.0, 9.0]"],
        ["mean of 2 tasks", "1", "0.0 [0.0, 0.0]", "7.5 [7.5, 7.5]"],
    ]


@pytest.mark.usefixtures("no_files")
def test_levels_are_means_of_named_tasks_alone(tmp_path):
    """Drawn and graded tasks have a level, too. An agent's further tasks change nothing of another's levels."""
    named = [task.id for task in named_tasks("dodge_projectiles")]
    rows = [evaluation_row(player, task, 0, 40.0) for player in ("mine", "theirs") for task in named]
    further = ("dodge_projectiles/varied-10", "dodge_projectiles/barons=0.5")
    rows += [evaluation_row("mine", task, 0, 100.0) for task in further]
    write_rows(tmp_path / "rows.jsonl", rows)
    (section,) = scenario_sections(read_results([tmp_path]), tmp_path)
    levels, tasks, *_ = section.blocks[0].tables
    assert levels.columns[1:3] == ("level 0 (1 task)", "level 1 (7 tasks)")
    assert {cell.text.split()[0] for row in levels.rows for cell in row[1:]} == {"40.0"}
    assert [row[1].text for row in tasks.rows[-2:]] == ["1", "0"]
    write_rows(tmp_path / "rows.jsonl", rows[-2:])
    (section,) = scenario_sections(read_results([tmp_path]), tmp_path)
    assert "dodge_projectiles_levels" not in [table.id for table in section.blocks[0].tables]


def test_own_kills_by_level_are_of_named_tasks_alone(tmp_path):
    rows = [evaluation_row(who, task.id, 0, 40.0, player_kills=6.0) for who in ("a", "b") for task in (BLUE, RED)]
    rows.append(evaluation_row("a", "seek_and_kill/blue=0.5", 0, 40.0, player_kills=0.0))
    write_rows(tmp_path / "rows.jsonl", rows)
    (section,) = scenario_sections(read_results([tmp_path]), tmp_path)
    (own_kills,) = (table for table in section.blocks[0].tables if table.id == "seek_and_kill_own_kills")
    last = [cell.text for cell in own_kills.rows[-1]]
    assert last == ["mean of 2 tasks", "1", "6.0 [6.0, 6.0]", "6.0 [6.0, 6.0]"]


@pytest.mark.usefixtures("no_files")
def test_scores_are_of_the_final_checkpoints_and_a_task_is_solved_where_the_newest_of_every_seed_survived(
    tmp_path, monkeypatch
):
    """Final are the last two of five. An older one changes nothing, whether it survived or not."""
    survivors = {"gore": {(1, 5), (2, 5)}, "default": {(1, 5)}, "stone_wall": {(1, 4), (2, 4)}}
    rows = [
        evaluation_row(
            f"a/{seed}@{at}",
            f"defend_the_center/{task}",
            n,
            100.0 if (seed, at) in survivors[task] else 50.0,
            run="a",
            run_seed=seed,
            num_updates=at,
            params=f"{seed} {at}",
        )
        for task in survivors
        for seed in (1, 2)
        for at in range(1, 6)
        for n in range(SOLVED_EPISODES)
    ]
    rows += [
        {**row, "task": "defend_the_center/mossy_bricks", "episode": 2 * row["episode"] + dies, **end}
        for dies, end in ((0, {"truncated": True}), (1, {"truncated": False}))  # in the order in which they ended
        for row in rows[: 10 * SOLVED_EPISODES]
    ]
    write_rows(tmp_path / "rows.jsonl", rows)
    drawn = []
    monkeypatch.setattr("gvz.reports.scenario_section.draw_rewards", lambda *args: drawn.append(args[2]))
    (section,) = scenario_sections(read_results([tmp_path]), tmp_path)
    (tasks,) = [table for table in section.blocks[0].tables if table.id.endswith("_tasks")]
    assert {row[0].text for row in tasks.rows if row[2].note == "solved"} == {"gore"}
    scores = {row[0].text: row[2].text.split()[0] for row in tasks.rows}
    assert scores == {"default": "62.5", "gore": "75.0", "stone_wall": "75.0", "mossy_bricks": "75.0"}
    assert drawn == [{"a": {"kill": pytest.approx(7.25), "death": -1.0}}]


@pytest.mark.usefixtures("no_files")
def test_the_gap_of_an_agent_is_shown_in_each_of_its_scenarios(tmp_path, experiments_writer):
    """It has a run in each scenario, all of one name."""
    scenarios = ("defend_the_center", "seek_and_kill")
    plan = Plan.of("general_on_policy", scale=0.01, scenarios=scenarios)
    of_level = (70.0, 70.0, 40.0, 50.0, 50.0)  # of 6 tasks of level 2, 3 are test tasks, and so are the 4 above
    experiments_writer(tmp_path, plan, lambda played: of_level[parse_task(played.task).level])
    for section in scenario_sections(read_results([tmp_path]), tmp_path):
        [gap] = [table for table in section.blocks[0].tables if table.id.endswith("_gap")]
        [cells] = gap.rows  # the tasks of levels 0 and 1 are those of training
        assert [cell.text.split()[0] for cell in cells] == ["ppo_segmented", "24.3", "26.0"]


@pytest.mark.usefixtures("no_files")
def test_players_of_two_profiles_are_two_and_agents_keep_their_gap(tmp_path, experiments_writer, monkeypatch):
    plan = Plan.of("general_on_policy", scale=0.01, scenarios=("seek_and_kill",))
    experiments_writer(tmp_path, plan, lambda played: 70.0 if played.task in played.run.tasks else 50.0)
    rows = [evaluation_row("random", task, 0, 50.0, profile="levdoom") for task in plan.runs()[0].tasks]
    write_rows(tmp_path / "levdoom.jsonl", rows)
    drawn = {}
    monkeypatch.setattr("gvz.reports.scenario_section.draw_curves", lambda *args: drawn.update({args[1]: args[-1]}))
    (section,) = scenario_sections(read_results([tmp_path]), tmp_path)
    (gap,) = [table for table in section.blocks[0].tables if table.id.endswith("_gap")]
    assert [row[0].text for row in gap.rows] == ["ppo_segmented (thesis)"]
    assert drawn["learning_seek_and_kill_ppo_segmented"] == {"random (levdoom)": 50.0, "random (thesis)": 20.5}


def test_one_checkpoint_of_each_seed_is_no_curve(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr("gvz.reports.scenario_section.draw_curves", lambda *args: drawn.append(args[1]))
    rows = [
        evaluation_row(f"r/{seed}@{at}", DEFAULT.id, 0, 50.0, run="r", run_seed=seed, num_updates=at, params=str(at))
        for seed, at in ((1, 100), (2, 120), (2, 240))
    ]
    for several in (False, True):
        write_rows(tmp_path / "rows.jsonl", rows if several else rows[:2])
        scenario_sections(read_results([tmp_path]), tmp_path)
        assert drawn == ["evaluation_seek_and_kill_r"] * several


def test_agents_with_nearly_the_same_name_have_figures_of_their_own(tmp_path):
    rows = [
        evaluation_row(f"{run}/1@{updates}", BLUE.id, 0, 40.0, run=run, run_seed=1, num_updates=updates, params=run)
        for run in ("a-b", "a_b")
        for updates in (1, 2)
    ]
    write_rows(tmp_path / "rows.jsonl", rows)
    (section,) = scenario_sections(read_results([tmp_path]), tmp_path)
    curves = [figure.id for figure in section.blocks[-1].figures]
    assert len(set(curves)) == 2
    assert all((tmp_path / "figures" / f"{id}.png").is_file() for id in curves)
