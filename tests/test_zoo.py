"""The policies that come with GViZDoom: small, playable, and their scores are those that the findings say."""

import re
from pathlib import Path

import numpy as np
import polars
import pytest

from gvz import cli
from gvz.evaluation.episode_log import read_rows
from gvz.evaluation.trained import find_checkpoints, read_run_config, trained_player
from gvz.evaluation.zoo import MAX_BYTES, ZOO_DIRECTORY, run_directory, zoo_names
from gvz.tasks import named_tasks, scenarios
from tests.score_tables import ROOT, WORDS, results_of


def test_every_scenario_of_the_thesis_has_a_policy():
    assert set(scenarios()) <= set(zoo_names())


def scores_of(rows: list[dict], scenario: str) -> list[float]:
    """Mean score of each test task, percent of the bound."""
    means = []
    for task in named_tasks(scenario, split="test"):
        scores = [row["normalized_score"] for row in rows if row["task"] == task.id]
        assert len(scores) == 100, task
        means.append(float(np.mean(scores)))
    return means


@pytest.mark.parametrize("name", zoo_names())
def test_a_policy_is_small_readable_and_has_its_score_card(name, tmp_path, monkeypatch):
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path))
    assert (ZOO_DIRECTORY / f"{name}.zip").stat().st_size <= MAX_BYTES
    directory = run_directory(Path(f"zoo:{name}"))
    config = read_run_config(directory)
    assert config.run_dir is None, "no path of the machine that trained it"
    (num_updates,) = find_checkpoints(directory, ["newest"])
    player = trained_player(directory, config, num_updates)
    rows = [row for row in read_rows(directory / "evaluation.jsonl") if player.identity.items() <= row.items()]
    assert len(scores_of(rows, config.table.scenarios[0].id)) == 7


def test_the_list_has_a_line_for_each_policy(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path))
    assert cli.main(["zoo"]) == 0
    head, *lines = capsys.readouterr().out.partition("\n\n")[0].splitlines()
    assert [line.split()[0] for line in lines] == [f"zoo:{name}" for name in zoo_names()]
    (line,) = [line for line in lines if line.startswith("zoo:health_gathering_compositions ")]
    name = "health_gathering"
    directory = run_directory(Path(f"zoo:{name}_compositions"))
    mean = np.mean(scores_of(read_rows(directory / "evaluation.jsonl"), name))
    said = f" segmented    91 tasks   45,500         2,707 s  {mean:.1f} ["
    assert said in line
    assert line.index(f"{mean:.1f} [") == head.index("% of the bound, test tasks")


def test_the_card_of_a_policy_has_its_tasks_and_scores(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path))
    assert cli.main(["zoo", "health_gathering", "zoo:seek_and_kill_screen"]) == 0
    first, second = capsys.readouterr().out.split("\n\n")
    assert first.startswith("zoo:health_gathering: ppo_segmented, seed 1111, 44,208 updates, 5,405 s of processor")
    assert second.startswith("zoo:seek_and_kill_screen: rainbow_general, seed 1111, 25,800 updates")
    for card, name in ((first, "health_gathering"), (second, "seek_and_kill")):
        trained_on = ", ".join(task.id for task in named_tasks(name, split="train8"))
        assert f"trained on {trained_on} mean score" in " ".join(card.split())
        for task in named_tasks(name, split="test"):
            assert f"  {task.id}\n" in card


def test_a_name_that_is_no_policy_is_told(refusal):
    assert "zoo:seek_and_kil: no such policy (did you mean 'seek_and_kill'?)" in refusal("zoo", "seek_and_kil")


def test_a_policy_is_added_by_one_name_alone(refusal):
    assert "zoo: got mine beside --add" in refusal("zoo", "mine", "--add", "runs/mine", "--name", "mine")


def test_the_policy_of_dodge_projectiles_learned_from_shifted_frames(tmp_path, monkeypatch):
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path))
    assert read_run_config(run_directory(Path("zoo:dodge_projectiles"))).agent.augmentations == ("shift",)


@pytest.mark.parametrize("suffix", ["", "_compositions", "_screen", "_train4"])
def test_the_mean_over_scenarios_is_that_of_the_score_cards(suffix, tmp_path, monkeypatch):
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path))
    means = [
        np.mean(scores_of(read_rows(run_directory(Path(f"zoo:{name}{suffix}")) / "evaluation.jsonl"), name))
        for name in scenarios()
    ]
    said = rf"`zoo:SCENARIO{suffix}` has ({np.mean(means):.1f} \[.*?\]) in the mean over scenarios"
    (score,) = re.findall(said, WORDS)
    (row,) = re.findall(rf"^\| `zoo:SCENARIO{suffix}` .*", (ROOT / "README.md").read_text(), flags=re.MULTILINE)
    assert row.endswith(f"| {score} |")


@pytest.mark.parametrize(
    ("folders", "suffix", "names"),
    [
        (("general_compositions_long",), "_compositions", tuple(scenarios())),
        (
            ("general", "general_short", "general_on_policy"),
            "",
            ("defend_the_center", "health_gathering", "seek_and_kill"),
        ),
    ],
)
def test_a_policy_is_the_best_of_its_track_on_the_gate_tasks(folders, suffix, names, tmp_path, monkeypatch):
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path))
    for name in names:
        scores: dict[tuple[str, int, int], float] = {}
        for folder in folders:
            episodes = results_of(folder).episodes.filter(scenario=name)
            on_gate = episodes.filter(
                episodes["task"].is_in([task.id for task in named_tasks(name, split="gate")]),
                episodes["agent"].str.contains("_segmented"),
            )
            means = on_gate.group_by("run", "run_seed", "num_updates").agg(polars.col("normalized_score").mean())
            scores |= {(run, seed, steps): score for run, seed, steps, score in means.rows()}
        assert len(scores) > 2
        directory = run_directory(Path(f"zoo:{name}{suffix}"))
        config = read_run_config(directory)
        assert (config.name, config.seed, *find_checkpoints(directory, ["newest"])) == max(
            scores, key=scores.__getitem__
        )
