"""Record files of evaluations: what is there is not played again, what is half there is."""

import json

import pytest

from gvz.errors import ConfigError
from gvz.evaluation.players import PlayerSpec, player_env
from gvz.evaluation.record import RecordFile, missing_jobs, play_and_record, read_rows, row_identity
from gvz.specs import EnvConfig
from gvz.tasks import parse_task

TASK = parse_task("defend_the_center/fast_enemies")
IDENTITY = row_identity({"player": "idle"}, EnvConfig())


def row(player: str, episode: int, **fields) -> dict:
    return {**IDENTITY, "player": player, "task": TASK.id, "episode": episode, **fields}


def test_only_rows_of_the_same_player_and_rules_count():
    rows = [row("idle", 0), row("random", 1), row("idle", 2, profile="levdoom"), row("idle", 3, num_updates=5)]
    assert missing_jobs(rows, IDENTITY, [TASK], 4) == [(TASK.id, 1), (TASK.id, 2)]


def test_a_half_written_line_is_cut_off(tmp_path):
    path = tmp_path / "evaluation.jsonl"
    file = RecordFile(path)
    file.append(row("idle", 0))
    file.append(row("idle", 1))
    file.close()
    path.write_bytes(path.read_bytes()[:-7])  # as a kill would leave it
    file = RecordFile(path)
    assert [r["episode"] for r in file.rows] == [0]
    file.append(row("idle", 1))
    file.close()
    assert [r["episode"] for r in read_rows(path)] == [0, 1]


def test_a_file_with_half_a_first_line_is_empty(tmp_path):
    path = tmp_path / "evaluation.jsonl"
    path.write_text('{"schema": 1')
    assert read_rows(path) == []
    assert path.read_bytes() == b""


@pytest.mark.parametrize("line", ["nonsense", json.dumps({"schema": 99})])
def test_a_file_of_something_else_is_refused_and_left_alone(tmp_path, line):
    path = tmp_path / "evaluation.jsonl"
    path.write_text(f"{line}\n")
    with pytest.raises(ConfigError, match=r"line 1: .*move the file aside or give another with --out"):
        RecordFile(path)
    assert path.read_text() == f"{line}\n"


def test_two_processes_cannot_write_one_file(tmp_path):
    file = RecordFile(tmp_path / "evaluation.jsonl")
    with pytest.raises(ConfigError, match=r"evaluation\.jsonl is being written by another process"):
        RecordFile(tmp_path / "evaluation.jsonl")
    file.close()
    RecordFile(tmp_path / "evaluation.jsonl").close()


def test_a_place_that_cannot_be_written_is_an_error(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written: "):
        RecordFile(tmp_path / "file" / "evaluation.jsonl")


@pytest.mark.engine
def test_an_evaluation_goes_on_where_it_was_left(tmp_path):
    env = player_env("idle", EnvConfig())
    identity = row_identity({"player": "idle"}, env)
    file = RecordFile(tmp_path / "evaluation.jsonl")
    spec = PlayerSpec(kind="idle")
    rows = play_and_record(file, missing_jobs(file.rows, identity, [TASK], 2), identity, spec, env, num_workers=1)
    first = next(rows)
    rows.close()
    file.close()
    file = RecordFile(tmp_path / "evaluation.jsonl")
    jobs = missing_jobs(file.rows, identity, [TASK], 2)
    assert jobs == [(TASK.id, 1 - first["episode"])]
    list(play_and_record(file, jobs, identity, spec, env, num_workers=1))
    assert missing_jobs(file.rows, identity, [TASK], 2) == []
    assert {r["episode"] for r in read_rows(tmp_path / "evaluation.jsonl")} == {0, 1}
    file.close()
