"""The reference scores: records are whole, and docs/BENCHMARK.md says what they and the code say."""

import gzip
import json

import numpy as np
import pytest

from gvz.errors import ConfigError
from gvz.evaluation.play import episode_seed
from gvz.evaluation.reference import PAGE, PLAYERS, estimate, pack, read_reference, tables, with_tables
from gvz.tasks import named_tasks, scenarios

SCORES = read_reference()


@pytest.mark.parametrize("player", PLAYERS)
def test_every_task_has_its_hundred_episodes(player):
    for task in named_tasks():
        rows = SCORES[player, task.id]
        assert [row["episode"] for row in rows] == list(range(100)), task.id
        assert all(row["seed"] == episode_seed(task.id, row["episode"]) for row in rows)
        assert all(row["profile"] == "thesis" for row in rows)


def test_no_score_is_above_its_bound():
    for task in named_tasks():
        bound = task.scenario.upper_bound("thesis")
        for row in (row for player in PLAYERS for row in SCORES[player, task.id]):
            if task.scenario.metric == "kills":
                assert row["score"] == min(row["kills"], bound)
                assert row["player_kills"] <= row["kills"]
            else:
                assert 0 < row["score"] <= bound


def test_the_tables_of_the_page_are_what_the_records_give():
    page = PAGE.read_text()
    assert with_tables(page, tables(SCORES)) == page


def test_an_estimate_over_tasks_is_the_mean_of_their_episodes():
    tasks = named_tasks("dodge_projectiles", level=1)
    scores = np.array([row["score"] for task in tasks for row in SCORES["scripted", task.id]])
    found = estimate(SCORES, "scripted", tasks, scale=100 / 2100)
    assert found.value == pytest.approx(scores.mean() / 21)
    assert found.low < found.value < found.high


@pytest.mark.parametrize("scenario", scenarios().values(), ids=lambda s: s.id)
def test_the_page_tells_each_scenario_as_it_is(scenario):
    page = PAGE.read_text()
    for attribute in scenario.attributes:
        assert f"`{attribute.name}`" in page
    for name, reward in scenario.rewards.items():
        assert f"| {scenario.title} | {name} | {reward.weight:g} | {reward.levdoom:g} |" in page
    sets = {name: ", ".join(tasks) for name, tasks in scenario.splits.items()}
    level_1 = {task.name for task in named_tasks(scenario.id, level=1)}
    if {task.name for task in named_tasks(scenario.id, split="train8")} == {"default", *level_1}:
        sets["train8"] = "default and all of level 1"
    assert f"| {scenario.title} | {sets['train4']} | {sets['train8']} | {sets['test']} |" in page
    assert f"(images/gallery_{scenario.id}.png)" in page


def record(**fields) -> str:
    row = {
        "schema": 1,
        "player": "idle",
        "profile": "thesis",
        "action_set": "combinations",
        "frame_skip": 4,
        "task": "t",
        "episode": 0,
        "seed": 1,
        "score": 1.0,
        "player_kills": 0.0,
        "reward": 0.5,
        "length_frames": 4,
        "terminated": True,
        "length_steps": 1,
    }
    return json.dumps({**row, **fields}) + "\n"


def test_packing_sorts_drops_columns_and_gives_the_same_bytes(tmp_path):
    (tmp_path / "a.jsonl").write_text(record(episode=1) + record(episode=0))
    (tmp_path / "b.jsonl").write_text(record(episode=0) + record(episode=1))
    packed = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (file,) = pack(tmp_path / f"{name}.jsonl", tmp_path / name)
        assert file.name == "idle.jsonl.gz"
        packed.append(file.read_bytes())
    assert packed[0] == packed[1]
    rows = [json.loads(line) for line in gzip.decompress(packed[0]).decode().splitlines()]
    assert [row["episode"] for row in rows] == [0, 1]
    assert "length_steps" not in rows[0]


def test_what_is_no_reference_record_is_refused(tmp_path):
    file = tmp_path / "rows.jsonl"
    file.write_text(record(player="rainbow"))
    with pytest.raises(ConfigError, match="rows of rainbow; want only random, idle, scripted"):
        pack(file, tmp_path)
    file.write_text("half a li")
    with pytest.raises(ConfigError, match="line 1: not JSON"):
        pack(file, tmp_path)
    with pytest.raises(ConfigError, match="there are no records of this player"):
        read_reference(tmp_path)
    (tmp_path / "random.jsonl.gz").write_bytes(gzip.compress(record(schema=2).encode()))
    with pytest.raises(ConfigError, match="schema 2, want 1"):
        read_reference(tmp_path)


def test_a_page_without_its_markers_is_an_error():
    with pytest.raises(ConfigError, match="are missing; the tables go between them"):
        with_tables("# The benchmark", "tables")
