"""gvz evaluate, as it is called: bad input, several checkpoints, interruption and going on."""

import json
import os
import signal
import subprocess
import sys

import pytest

from gvz import cli
from gvz.core.errors import ConfigError
from gvz.evaluation.episode_log import RecordFile, read_rows
from gvz.evaluation.selection import TaskSelection
from gvz.tasks import named_tasks, scenarios
from tests.waiting import wait_until


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "evaluate: want --player or run directories (before --tasks, which takes what follows)"),
        ("{run} --player idle", "evaluate: got --player idle and also "),
        ("{run} --checkpoints", "--checkpoints: got none, want newest, all, last5"),
        ("--player idle --checkpoints all", "--checkpoints: got it beside --player idle, want it with run directories"),
        ("--player idle --agent mine.py", "--agent: got it beside --player idle, want it with run directories alone"),
        ("--player idle --seeds 0 0", "--seeds: got [0, 0], want different numbers"),
        ("--player idle --seeds 9223372036854775808", "--seeds: got [9223372036854775808], want different numbers"),
        ("{above}", "did you mean {run}?"),
        ("--player idle --episodes 0", "--episodes: got 0, want at least 1"),
        ("--player idle --workers 0", "--workers: got 0, want at least 1"),
        ("--player idle --seeds -1", "--seeds: got [-1], want different numbers from 0 to 2^63 - 1"),
        ("--player idle --out {file}/below/rows.jsonl", "cannot be written: Not a directory"),
        ("--player idle --out {file}", "line 1: not JSON (half-written?); move the file aside"),
        ("--player idle --level 5", "level: got 5, want 0..4"),
        ("--player idle --level 0 --split test", "--level, --split: no task of test has level 0"),
        ("{file}", "is not a run directory"),
        ("{run} --checkpoints last3", "--checkpoints: got last3, want last1 to last2: "),
        ("{run} --tasks", "--tasks: got none, want at least one id"),
        ("{run} --profile levdoom", "--profile: got levdoom, but small keeps the rules that it was trained by, "),
        ("{run} --agent none.py", "--agent: no file none.py here ("),
        ("{run} --checkpoints last", "--checkpoints: got 'last', want newest, all, last5"),
        ("{run} --checkpoints 30", "10, 20"),
        ("{run} --scenario seek_and_kill", "the run was trained on defend_the_center, which has other buttons"),
        ("{run} --tasks defend_the_center/gor", "unknown attribute 'gor' (did you mean 'gore'?)"),
    ],
)
def test_bad_input_gives_one_message_and_exit_code_2(arguments, message, refusal, tmp_path, small_run):
    (tmp_path / "file").write_text("nonsense\n")
    places = {"file": tmp_path / "file", "run": small_run, "above": small_run.parent}
    said = refusal("evaluate", *(word.format(**places) for word in arguments.split()))
    assert message.format(**places) in said
    assert not (small_run / "evaluation.jsonl").exists()


def test_a_damaged_policy_is_told_of_before_anything_is_played(capsys, small_run):
    (small_run / "policies" / "10" / "host.msgpack").unlink()
    assert cli.main(["evaluate", str(small_run), "--checkpoints", "all"]) == 1
    err = capsys.readouterr().err
    assert "policies/10: files missing or unknown: ['host.msgpack']; evaluate another with --checkpoints" in err
    assert not (small_run / "evaluation.jsonl").exists()


def test_a_run_is_evaluated_on_the_test_tasks_of_its_scenario_unless_told_otherwise():
    scenario = "dodge_projectiles"
    assert TaskSelection().of_run([scenario]) == named_tasks(scenario, split="test")
    assert TaskSelection(level=2).of_run([scenario]) == named_tasks(scenario, level=2)
    assert TaskSelection(split="train4").of_run([scenario]) == named_tasks(scenario, split="train4")
    assert TaskSelection(scenario="seek_and_kill").of_run([scenario]) == named_tasks("seek_and_kill")
    later = next(iter(scenarios("extended")))
    assert TaskSelection(suite="extended").of_run([later]) == TaskSelection().of_run([later])
    with pytest.raises(ConfigError, match="--suite: got extended, but the run was trained on dodge_projectiles, which"):
        TaskSelection(suite="extended").of_run([scenario])
    with pytest.raises(ConfigError, match="--tasks: got ids and also --scenario, --split, --suite or --level"):
        TaskSelection(tasks=("dodge_projectiles/default",), suite="extended").resolve()


@pytest.mark.engine
def test_all_checkpoints_meet_the_same_episodes_and_none_twice(small_run, capsys):
    command = (
        f"evaluate {small_run} --checkpoints all --tasks defend_the_center/default --seeds 0 4 --workers 2".split()
    )
    assert cli.main([*command, "--episodes", "1"]) == 0
    out, err = capsys.readouterr()
    assert [line for line in out.splitlines() if line.startswith("small")] == [
        *("small/seed_7@10", "small/seed_7@10, base seed 4", "small/seed_7@20", "small/seed_7@20, base seed 4")
    ]
    assert err.splitlines()[-1].startswith("4/4  ")
    rows = read_rows(small_run / "evaluation.jsonl")
    first = {(row["num_updates"], row["base_seed"]): row for row in rows}
    assert len(rows) == len(first) == 4
    assert first[10, 0]["seed"] == first[20, 0]["seed"] != first[10, 4]["seed"]
    assert cli.main([*command, "--episodes", "1"]) == 0
    assert read_rows(small_run / "evaluation.jsonl") == rows
    assert capsys.readouterr().out == out
    assert cli.main([*command, "--episodes", "1", "--json"]) == 0
    scores = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(score["player"], score["base_seed"]) for score in scores] == [
        *(("small/seed_7@10", 0), ("small/seed_7@10", 4), ("small/seed_7@20", 0), ("small/seed_7@20", 4))
    ]
    assert [score["score"] for score in scores] == [
        first[updates, seed]["score"] for updates, seed in ((10, 0), (10, 4), (20, 0), (20, 4))
    ]


@pytest.mark.engine
def test_a_signal_inside_a_destructor_is_not_lost(tmp_path, monkeypatch, capsys):
    class Interrupted:
        def __del__(self):
            signal.raise_signal(signal.SIGINT)

    append = RecordFile.append

    def append_and_interrupt(file, row):
        append(file, row)
        Interrupted()

    monkeypatch.setattr(RecordFile, "append", append_and_interrupt)
    command = ["evaluate", "--player", "idle", "--episodes", "9", "--workers", "1"]
    assert cli.main([*command, "--tasks", "defend_the_center/default", "--out", str(tmp_path / "rows.jsonl")]) == 130
    assert "interrupted; the same command goes on from here" in capsys.readouterr().err
    assert len(read_rows(tmp_path / "rows.jsonl")) == 1


@pytest.mark.engine
def test_an_interrupted_evaluation_goes_on_and_ends_with_a_table(tmp_path):
    out = tmp_path / "rows.jsonl"
    command = [
        *(sys.executable, "-m", "gvz.cli", "evaluate", "--player", "idle", "--episodes", "30", "--workers", "1"),
        *("--tasks", "defend_the_center/default", "--out", str(out)),
    ]
    num_rows = 0
    for signal_number in (signal.SIGINT, signal.SIGTERM):
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path, start_new_session=True
        )
        wait_until(lambda n=num_rows: out.exists() and out.read_text().count("\n") > n, "a row", 120, process=process)
        os.killpg(process.pid, signal_number)  # the whole group, as a shell and a batch system do
        _, err = process.communicate(timeout=120)
        assert process.returncode == 128 + signal_number, err
        assert "interrupted; the same command goes on from here" in err
        assert "Traceback" not in err
        assert num_rows < len(read_rows(out)) < 30
        num_rows = len(read_rows(out))
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
    assert sorted(row["episode"] for row in read_rows(out)) == list(range(30))
    assert "defend_the_center/default" in done.stdout
    assert list(tmp_path.iterdir()) == [out]
