"""Reading records: all that can be read is read, and the rest is told by name."""

import gzip
import json

import polars as pl
import pytest

from gvz.core.errors import ConfigError
from gvz.evaluation.dataset import DERIVED, OPTIONAL, REQUIRED, RecordWarning, collect_evaluations, read_evaluations

GORE = "defend_the_center/gore"


def line(**fields) -> str:
    row = {"schema": 1, "player": "random", "profile": "thesis", "task": GORE, "episode": 0, "seed": 7, "score": 550.0}
    return json.dumps({**row, **fields}) + "\n"


def test_files_and_directories_compressed_or_not(tmp_path):
    (tmp_path / "players").mkdir()
    (tmp_path / "players" / "random.jsonl").write_text(line())
    (tmp_path / "more.jsonl.gz").write_bytes(gzip.compress(line(episode=1).encode()))
    whole = read_evaluations(tmp_path)
    assert sorted(whole["episode"]) == [0, 1]
    one = read_evaluations(str(tmp_path / "more.jsonl.gz"))
    assert one["episode"].to_list() == [1]
    assert set(one.columns) == {*REQUIRED, *OPTIONAL, *DERIVED}


def test_episodes_of_several_versions_of_the_engine_are_told_of(tmp_path):
    file = tmp_path / "random.jsonl"
    played = [line(episode=n, vizdoom=version) for n, version in enumerate(("1.3.2", "1.3.2+gvz.1"))]
    file.write_text("".join([*played, line(episode=2)]))
    frame, problems = collect_evaluations([file])
    assert frame["vizdoom"].to_list() == ["1.3.2", "1.3.2+gvz.1", None]
    assert problems == [], "a tuned engine plays the same games, and older rows do not say"
    file.write_text("".join([*played, line(episode=2, vizdoom="1.4.0")]))
    assert collect_evaluations([file])[1] == [
        "episodes were played with several versions of ViZDoom (1.3.2, 1.4.0), whose games may differ; play them again "
        "with one of these"
    ]


def test_what_follows_from_the_task_is_in_the_row(tmp_path):
    file = tmp_path / "random.jsonl"
    file.write_text(line(task="defend_the_center/gore+mossy_bricks", terminated=True, reward_components={"kill": 2}))
    (row,) = read_evaluations(file).iter_rows(named=True)
    assert (row["scenario"], row["level"]) == ("defend_the_center", 2)
    assert row["attributes"] == ["gore", "mossy_bricks"]
    assert row["normalized_score"] == 50.0  # of 1100
    assert row["truncated"] is False
    assert row["reward/kill"] == 2.0
    assert row["run_dir"] is None


def test_the_bound_is_the_profiles(tmp_path):
    file = tmp_path / "random.jsonl"
    file.write_text(line(profile="levdoom", score=2100.0) + line(normalized_score=12.5, episode=1))
    assert read_evaluations(file)["normalized_score"].to_list() == [100.0, 12.5]
    file.write_text(line(profile=None))  # of an earlier version
    assert read_evaluations(file).select("level", "normalized_score").rows() == [(1, 50.0)]


def test_rows_of_a_run_say_what_it_was_trained_on(tmp_path):
    (tmp_path / "evaluation.jsonl").write_text(line(player="r/seed_1@9", run="r", run_seed=1, num_updates=9))
    (tmp_path / "config.json").write_text(json.dumps({"resolved": {"tasks": [GORE]}}))
    (tmp_path / "random.jsonl").write_text(line())
    frame = read_evaluations(tmp_path).sort("player")
    assert frame["trained_on"].to_list() == [[GORE], None]
    assert frame["run_dir"].to_list() == [str(tmp_path), None]


def test_an_episode_found_twice_is_there_once(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "random.jsonl").write_text(line())
        (tmp_path / name / "evaluation.jsonl").write_text(line(player="r/seed_1@9", run="r", num_updates=9))
    frame = read_evaluations(tmp_path, tmp_path / "a", tmp_path / "a" / "random.jsonl")
    # chance is chance wherever its record lies; two runs of one name and seed are two runs
    assert sorted(frame["player"]) == ["r/seed_1@9", "r/seed_1@9", "random"]


def test_an_episode_by_other_rules_is_another_one(tmp_path):
    rules = {"profile": "levdoom", "action_set": "unified_v1", "frame_skip": 7, "observes": "labels", "seed": 8}
    plain = {"action_set": "buttons", "frame_skip": 4}
    lines = [line(**plain), *(line(**{**plain, name: value}) for name, value in rules.items())]
    (tmp_path / "random.jsonl").write_text("".join(lines))
    assert len(read_evaluations(tmp_path)) == 6


def test_episodes_of_a_run_are_there_once_with_those_of_a_file_elsewhere(tmp_path):
    policy = {"player": "r/seed_1@9", "run": "r", "run_seed": 1, "num_updates": 9, "params": "abc"}
    run_dir = tmp_path / "z"
    run_dir.mkdir()
    (run_dir / "config.json").write_text(json.dumps({"resolved": {"tasks": [GORE]}}))
    (run_dir / "evaluation.jsonl").write_text(line(**policy))
    (tmp_path / "mine.jsonl").write_text(line(**policy) + line(**policy, episode=1))
    frame = read_evaluations(tmp_path / "mine.jsonl", run_dir).sort("episode")
    assert frame.select("episode", "run_dir", "trained_on").rows() == [(n, str(run_dir), [GORE]) for n in range(2)]


def test_episodes_of_a_file_elsewhere_of_which_there_are_several_runs_are_told_of(tmp_path):
    policy = {"player": "r/seed_1@9", "run": "r", "run_seed": 1, "num_updates": 9}
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text(json.dumps({"resolved": {"tasks": [GORE]}}))
        (tmp_path / name / "evaluation.jsonl").write_text(line(**policy, params=name))
    (tmp_path / "Z.jsonl").write_text(line(**policy, params="a") + line(**policy, params="a", episode=1))  # found first
    frame, (problem,) = collect_evaluations([tmp_path])
    assert frame.select("episode", "run_dir").rows() == [
        (0, str(tmp_path / "a")),
        (0, str(tmp_path / "b")),
        (1, str(tmp_path)),
    ], "what a run holds is not taken for another run's"
    assert problem.startswith(f"{tmp_path}: has episodes of r, training seed 1, of which there are 2 run directories")


def test_two_players_of_one_name_are_told_of(tmp_path):
    (tmp_path / "mine.jsonl").write_text(line(player="human") + line(player="human", episode=1, length_frames=9))
    (tmp_path / "yours.jsonl").write_text(line(player="human", score=5.0) + line(player="human", episode=1))
    frame, (problem,) = collect_evaluations([tmp_path])
    assert problem.startswith("human: 1 of its episodes were found with several results, of which the first is kept")
    assert frame["score"].to_list() == [550.0, 550.0]
    (tmp_path / "yours.jsonl").write_text(line(player="human", episode=1, length_frames=8))
    _, (problem,) = collect_evaluations([tmp_path])
    assert problem.startswith("human: 1 of its episodes were found with several results"), "the score is at its bound"


@pytest.mark.parametrize("second", ["a", "b"])
def test_two_policies_of_one_name_are_told_of_unless_they_are_of_two_scenarios(tmp_path, second):
    policy = {"player": "r/seed_1@9", "run": "r", "run_seed": 1, "num_updates": 9}
    one, other = tmp_path / "a" / "one.jsonl", tmp_path / second / "other.jsonl"
    for file in (one, other):
        file.parent.mkdir(exist_ok=True)
    one.write_text(line(**policy, params="abc"))
    other.write_text(line(**policy, params="def"))
    frame, (problem,) = collect_evaluations([tmp_path])
    assert problem.startswith(
        f"{tmp_path / 'a'}: r/seed_1@9 has episodes of 2 policies (`params`) in defend_the_center"
    )
    assert set(frame["run_dir"]) == {str(tmp_path / "a")}
    other.write_text(line(**policy, params="def", task="seek_and_kill/default"))
    assert collect_evaluations([tmp_path])[1] == []


def test_records_of_training_and_discarded_ones_are_left_alone(tmp_path):
    (tmp_path / "config.json").write_text(json.dumps({"resolved": {"tasks": [GORE]}}))
    kept = ("discarded/evaluation.jsonl", "policies/10/rows.jsonl", "work/actor_0/log.jsonl")
    for name in ("episodes.jsonl", "starts.jsonl", "metrics.jsonl.gz", "faults.jsonl", *kept):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("not read")
    frame, problems = collect_evaluations([tmp_path])
    assert frame.is_empty()
    assert not problems


@pytest.mark.parametrize("name", ["discarded", "work", "checkpoints", "policies", "tensorboard"])
def test_runs_in_a_folder_that_is_called_as_one_of_a_run_are_read(tmp_path, name):
    run_dir = tmp_path / "runs" / name / "seed_1"
    (run_dir / name).mkdir(parents=True)
    (run_dir / "config.json").write_text(json.dumps({"resolved": {"tasks": [GORE]}}))
    (run_dir / "evaluation.jsonl").write_text(line(player="r/seed_1@9", run="r", run_seed=1, num_updates=9))
    (run_dir / name / "evaluation.jsonl").write_text("not read")
    (run_dir.parent / "random.jsonl").write_text(line())
    for path in (tmp_path, tmp_path / "runs", run_dir.parent):
        frame, problems = collect_evaluations([path])
        assert sorted(frame["player"]) == ["r/seed_1@9", "random"]
        assert not problems


def test_a_half_written_line_is_named_and_the_rest_is_read(tmp_path):
    file = tmp_path / "random.jsonl"
    file.write_text(line() + line(episode=1)[:30])
    with pytest.warns(RecordWarning, match=r"random\.jsonl, line 2: not JSON \(half-written\?\)"):
        frame = read_evaluations(file)
    assert len(frame) == 1


def test_rows_of_another_schema_are_named_once_for_all(tmp_path):
    file = tmp_path / "random.jsonl"
    file.write_text("".join(line(episode=n, schema=2) for n in range(5)) + line(episode=9))
    frame, (problem,) = collect_evaluations([file])
    assert problem == f"{file}, line 1: schema 2, want 1; and 4 more such lines"
    assert frame["episode"].to_list() == [9]


@pytest.mark.parametrize(
    ("fields", "complaint"),
    [
        ({"player": None}, "row 2: no player, not a row of an evaluation"),
        ({"score": "many"}, "row 2: score is 'many', want Float64"),
        ({"score": float("nan")}, "row 2: score is nan, want Float64"),
        ({"episode": True}, "row 2: episode is True, want Int64"),
        ({"reward_components": {"kill": "x"}}, "row 2: reward_components is {'kill': 'x'}, want name -> number"),
        ({"reward_components": [1]}, "row 2: reward_components is [1], want name -> number"),
        ({"reward_components": {"\ud800": 1}}, "row 2: reward_components is {'\\ud800': 1}, want name -> number"),
        ({"episode": 2**63}, f"row 2: episode is {2**63}, want Int64"),
        ({"score": 10**400}, f"row 2: score is {10**400}, want Float64"),
        ({"run": "\udfff"}, "row 2: run is '\\udfff', want String"),
    ],
)
def test_a_damaged_row_is_named_and_the_rest_is_read(tmp_path, fields, complaint):
    file = tmp_path / "random.jsonl"
    file.write_text(line() + line(**{"episode": 1, **fields}))
    frame, (problem,) = collect_evaluations([file])
    assert problem == f"{file}, {complaint}"
    assert len(frame) == 1


def test_a_cut_archive_is_named_and_read_up_to_the_cut(tmp_path):
    file = tmp_path / "random.jsonl.gz"
    lines = "".join(line(episode=n, seed=n * 7919) for n in range(5000))
    file.write_bytes(gzip.compress(lines.encode())[:-2000])
    frame, (problem,) = collect_evaluations([file])
    assert 0 < len(frame) < 5000
    assert f"after {len(frame)} rows: cannot be read on (Compressed file ended" in problem
    file.write_bytes(b"no archive")
    assert "after 0 rows: cannot be read on (Not a gzipped file" in collect_evaluations([file])[1][0]


def test_an_unknown_task_is_named_and_its_rows_are_kept(tmp_path):
    file = tmp_path / "random.jsonl"
    file.write_text(line(task="defend_the_center/gor") + line(normalized_score=3.0, task="my_scenario/default"))
    frame, problems = collect_evaluations([file])
    assert "unknown attribute 'gor' (did you mean 'gore'?)" in problems[0]
    assert problems[0].endswith("its 1 rows have no level")
    assert "unknown scenario 'my_scenario'" in problems[1]
    assert frame.select("scenario", "level", "normalized_score").rows() == [
        ("defend_the_center", None, None),
        ("my_scenario", None, 3.0),
    ]


@pytest.mark.parametrize("text", ["{", '{"resolved": 3}', "[]"])
def test_a_damaged_config_is_named_and_its_rows_are_kept(tmp_path, text):
    (tmp_path / "config.json").write_text(text)
    (tmp_path / "evaluation.jsonl").write_text(line(run="r"))
    frame, (problem,) = collect_evaluations([tmp_path])
    assert "its config.json cannot be read" in problem
    assert frame["trained_on"].to_list() == [None]


def test_nothing_to_read_is_an_empty_frame_and_a_missing_path_an_error(tmp_path):
    frame = read_evaluations(tmp_path)
    assert frame.is_empty()
    assert frame.schema == pl.Schema(REQUIRED | OPTIONAL | DERIVED)
    with pytest.raises(ConfigError, match=r"nowhere: no such file or directory; want record files"):
        read_evaluations(tmp_path / "nowhere")
