"""The head of a report says who has more points, and only where it can be told."""

import json
import re
from pathlib import Path

import pytest

from gvz.experiments.inventory import run_directory
from gvz.experiments.plan import Plan
from gvz.reports.abstract import caveats, what_was_run, who_has_more
from gvz.reports.results import read_results
from gvz.tasks import named_tasks
from tests.reports.conftest import evaluation_row, write_rows

ROOT = Path(__file__).parents[2]
OFFSETS = {1111: 0.0, 2222: 1.0, 3333: 2.0}


def test_trained_agents_first_then_the_best_beside_players(tmp_path, experiments_writer):
    def score(played) -> float:
        return (60.0 if played.run.config == "rainbow_quick" else 20.0) + OFFSETS[played.run.seed] + played.episode

    experiments_writer(tmp_path, Plan.of("quick_comparison", scale=0.2), score)  # 5 episodes; players: 22
    scripted = tmp_path / "players" / "scripted.jsonl"
    rows = [json.loads(line) for line in scripted.read_text().splitlines()]
    scripted.write_text("".join(json.dumps({**row, "normalized_score": 90.0 + row["episode"]}) + "\n" for row in rows))
    results = read_results([tmp_path])
    (sentence,) = who_has_more(results)
    assert sentence.startswith("Defend the Center, mean of the 7 test tasks: rainbow_quick has 40.0 [")
    assert re.search(r"; rainbow_quick has 41\.0 \[.*\] points more than random[;.]", sentence)
    assert re.search(r"; rainbow_quick has 29\.0 \[2\d\.\d, 3\d\.\d\] points fewer than scripted[;.]", sentence)
    scale, few_seeds, few_episodes = caveats(results)
    assert scale == "Scale 0.2: budgets and episodes are shrunk; not comparable with published numbers."
    assert few_seeds.startswith("Fewer than 10 training seeds of dqn_quick, rainbow_quick: intervals over so few are ")
    assert few_episodes.startswith("Fewer than 10 evaluation episodes of some task by dqn_quick, idle, rainbow_quick, ")
    assert "6 training runs of 2 agents (dqn_quick, rainbow_quick), 3 training seeds" in " ".join(what_was_run(results))


def test_runs_that_lack_evaluation_episodes_are_named(tmp_path, experiments_writer):
    plan = Plan.of("quick_comparison", scale=0.2)
    experiments_writer(tmp_path, plan, lambda _: 50.0)
    evaluations, cut = plan.evaluations(), [run for run in plan.runs() if run.config == "rainbow_quick"]
    each = len(evaluations[cut[0].id].tasks) * evaluations[cut[0].id].episodes
    for run in cut:
        file = run_directory(tmp_path, run) / "evaluation.jsonl"
        rows = [json.loads(line) for line in file.read_text().splitlines()]
        write_rows(file, [row for row in rows if row["num_updates"] == run.checkpoints[0] and row["episode"] == 0])
    lacking, wanted = 3 * (2 * each - len(evaluations[cut[0].id].tasks)), 3 * 2 * each
    said = f"{plan.experiments()[0].title}: 3 of 6 runs lack {lacking} of their {wanted} evaluation episodes: "
    assert caveats(read_results([tmp_path]))[-1] == said + ", ".join(run.id for run in cut) + "."
    for run in plan.runs():
        (run_directory(tmp_path, run) / "evaluation.jsonl").unlink()
    (few, last) = caveats(read_results([tmp_path]))[-2:]
    assert few.startswith("Fewer than 10 evaluation episodes of some task by idle, random, scripted"), "no other caveat"
    assert f"6 of 6 runs lack {2 * wanted:,} of their {2 * wanted:,} evaluation episodes" in last
    assert last.endswith(f"{plan.runs()[2].id} and 3 more.")


def test_committed_results_lack_no_evaluation_episodes():
    for name in ("general_compositions", "general_on_policy", "quick_comparison"):
        results = read_results([ROOT / "results" / name])
        assert results.asked
        assert not [one for one in caveats(results) if "lack" in one]


def test_an_agent_whose_seeds_played_other_tasks_each_is_left_out(tmp_path):
    gore, wall = "defend_the_center/gore", "defend_the_center/stone_wall"
    trained = [("r", 1, gore), ("r", 2, wall)]
    rows = [
        evaluation_row(f"{run}/{seed}", task, 0, 50.0, run=run, run_seed=seed, num_updates=9)
        for run, seed, task in trained
    ]
    rows += [evaluation_row("random", task, n, 20.0) for task in (gore, wall) for n in range(2)]
    write_rows(tmp_path / "rows.jsonl", rows)
    assert who_has_more(read_results([tmp_path])) == []
    rows = [evaluation_row("idle", task, n, 10.0) for task in (gore, wall) for n in range(2)]
    write_rows(tmp_path / "more.jsonl", rows)
    (sentence,) = who_has_more(read_results([tmp_path]))
    assert "random has 10.0" in sentence
    assert sentence.endswith(" Left out, because they lack some of these tasks: r.")
    write_rows(tmp_path / "more.jsonl", rows[::2])
    (sentence,) = who_has_more(read_results([tmp_path]))
    assert "random and idle cannot be compared (idle: one episode of a task)" in sentence


@pytest.mark.parametrize("stray", ["gore", "gore+mossy_bricks"])
def test_a_stray_episode_leaves_the_comparison_on_the_test_tasks(tmp_path, stray):
    test = [task.id for task in named_tasks("defend_the_center", split="test")]
    rows = [
        evaluation_row(player, task, n, score)
        for player, score in (("a", 30.0), ("b", 20.0))
        for task in test
        for n in (0, 1)
    ]
    write_rows(tmp_path / "rows.jsonl", [*rows, evaluation_row("human", f"defend_the_center/{stray}", 0, 90.0)])
    (sentence,) = who_has_more(read_results([tmp_path]))
    assert sentence.startswith(
        "Defend the Center, mean of the 7 test tasks: a has 10.0 [10.0, 10.0] points more than b."
    )
    assert sentence.endswith(" Left out, because they lack some of these tasks: human.")


def test_trained_agents_without_the_test_tasks_are_compared_on_those_that_all_have(tmp_path):
    test = [task.id for task in named_tasks("defend_the_center", split="test")]
    gate = named_tasks("defend_the_center", split="gate")[0].id
    rows = [evaluation_row(player, task, n, 20.0) for player in ("a", "b") for task in (*test, gate) for n in (0, 1)]
    rows += [evaluation_row("r/1", gate, n, 50.0, run="r", run_seed=1, num_updates=9) for n in (0, 1)]
    write_rows(tmp_path / "rows.jsonl", rows)
    (sentence,) = who_has_more(read_results([tmp_path]))
    assert sentence.startswith(
        f"Defend the Center, {gate.partition('/')[2]}: r has 30.0 [30.0, 30.0] points more than "
    )


def test_what_cannot_be_told_apart_is_said(tmp_path):
    task = named_tasks("seek_and_kill")[0].id
    for player in ("random", "idle"):
        rows = [{"player": player, "task": task, "episode": n, "seed": n, "score": float(n)} for n in range(9)]
        (tmp_path / f"{player}.jsonl").write_text("".join(json.dumps({"schema": 1, **row}) + "\n" for row in rows))
    (sentence,) = who_has_more(read_results([tmp_path]))
    assert sentence.startswith("Seek and Kill, default: no difference shown between idle and random (0.0 [")
    for player in ("random", "idle"):
        write_rows(tmp_path / f"{player}.jsonl", [evaluation_row(player, task, n, 30.0) for n in range(9)])
    (sentence,) = who_has_more(read_results([tmp_path]))
    assert "no difference shown between idle and random (0.0 [0.0, 0.0] points)" in sentence


def test_few_seeds_are_a_caveat_of_records_without_run_directories_too(tmp_path):
    gore = "defend_the_center/gore"

    def rows(seeds: range) -> list[dict]:
        trained = [(seed, n) for seed in seeds for n in range(10)]
        return [evaluation_row(f"r/{s}", gore, n, 50.0, run="r", run_seed=s, num_updates=9) for s, n in trained]

    write_rows(tmp_path / "rows.jsonl", rows(range(9)))
    (few,) = caveats(read_results([tmp_path]))
    assert few.startswith("Fewer than 10 training seeds of r: ")
    write_rows(tmp_path / "rows.jsonl", rows(range(10)))
    assert caveats(read_results([tmp_path])) == []


def test_a_player_of_ones_own_is_not_called_one_that_does_not_learn(tmp_path):
    gore = "defend_the_center/gore"
    write_rows(tmp_path / "rows.jsonl", [evaluation_row(player, gore, 0, 50.0) for player in ("my PPO", "random")])
    (sentence,) = what_was_run(read_results([tmp_path]))
    beside = "among them players that do not learn: random; players that no run here has trained: my PPO."
    assert sentence == f"2 evaluation episodes on 1 task, {beside}"


def test_a_player_that_has_the_name_of_a_run_is_no_further_seed_of_it(tmp_path):
    task = "defend_the_center/default"
    trained = evaluation_row("ppo/seed_1@9", task, 0, 10.0, run="ppo", run_seed=1, num_updates=9)
    write_rows(tmp_path / "rows.jsonl", [trained, evaluation_row("ppo", task, 0, 90.0)])
    shown = read_results([tmp_path]).episodes.select("agent", "normalized_score").rows()
    assert shown == [("ppo", 10.0), ("ppo (player)", 90.0)]


def test_few_episodes_are_a_caveat_however_many_checkpoints_played_them(tmp_path):
    rows = [
        evaluation_row(f"r/1@{updates}", "defend_the_center/gore", n, 50.0, run="r", run_seed=1, num_updates=updates)
        for updates in range(20)
        for n in range(10)
    ]
    write_rows(tmp_path / "rows.jsonl", [row for row in rows if row["episode"] < 9])
    _, few = caveats(read_results([tmp_path]))
    assert few.startswith("Fewer than 10 evaluation episodes of some task by r: ")
    write_rows(tmp_path / "rows.jsonl", rows)
    assert len(caveats(read_results([tmp_path]))) == 1
