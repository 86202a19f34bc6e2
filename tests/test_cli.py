"""The gvz command: quick to start, resumable, one clear message for bad input."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gvz import cli
from gvz.registry import discover
from gvz.rundir import read_records


def test_help_loads_neither_jax_nor_vizdoom_nor_anything_heavy():
    code = (
        "import sys; from gvz import cli\n"
        "try: cli.main(['--help'])\n"
        "except SystemExit as end: assert end.code == 0\n"
        "heavy = ('jax', 'vizdoom', 'cv2', 'PIL', 'gymnasium', 'orbax')\n"
        "print([m for m in heavy if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stderr.strip() == "[]"
    for command in discover("gvz.commands"):
        assert f"• {command} " in done.stdout


def test_tasks_lists_all_named_tasks(capsys):
    assert cli.main(["tasks", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(rows) == 76
    assert len({row["gymnasium_id"] for row in rows}) == 76
    gore = next(row for row in rows if row["task"] == "defend_the_center/gore")
    assert (gore["level"], gore["attributes"], gore["sets"]) == (1, ["gore"], ["train4", "train8"])


def test_tasks_prints_a_table(capsys):
    assert cli.main(["tasks", "--scenario", "seek_and_kill", "--split", "test"]) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.split() == ["task", "level", "attributes", "sets"]
    assert len(lines) == 7
    assert lines[-1].split() == [
        *("seek_and_kill/complete", "4", "blue+mixed_enemies+obstacles+resized_enemies+shadows", "test")
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("tasks --scenario seek_and_kil", "unknown scenario 'seek_and_kil' (did you mean 'seek_and_kill'?)"),
        ("tasks --tasks seek_and_kill/blu", "unknown attribute 'blu' (did you mean 'blue'?)"),
        ("tasks --tasks seek_and_kill/blue --split test", "--tasks: got ids and also --scenario or --split"),
        ("gallery --scenario nowhere", "unknown scenario 'nowhere'"),
        ("gallery --out {file}/below", "cannot be made: Not a directory"),
        ("evaluate", "evaluate: want a run directory or --player"),
        ("evaluate {file} --player idle", "evaluate: want a run directory or --player"),
        ("evaluate --player idle --episodes 0", "--episodes: got 0, want at least 1"),
        ("evaluate --player idle --workers 0", "--workers: got 0, want at least 1"),
        ("evaluate --player idle --out {file}/below/rows.jsonl", "cannot be written: Not a directory"),
        ("evaluate {file}", "is not a run directory"),
        ("train --config no_such", "no config 'no_such'"),
    ],
)
def test_bad_input_gives_one_message_and_exit_code_2(arguments, message, capsys, tmp_path):
    (tmp_path / "file").touch()
    assert cli.main(arguments.format(file=tmp_path / "file").split()) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert message in err
    assert "Traceback" not in err


def test_a_checkpoint_that_is_no_number_is_bad_input(capsys, tmp_path):
    from gvz.config import RunConfig
    from gvz.rundir import RunDir

    with RunDir(tmp_path / "run") as run:
        run.write_config(RunConfig(name="small"))
    assert cli.main(["evaluate", str(tmp_path / "run"), "--checkpoint", "last"]) == 2
    assert "--checkpoint: got 'last', want newest or a number of gradient steps" in capsys.readouterr().err


@pytest.mark.engine
def test_an_interrupted_evaluation_goes_on_and_ends_with_a_table(tmp_path):
    out = tmp_path / "rows.jsonl"
    command = [
        *(sys.executable, "-m", "gvz.cli", "evaluate", "--player", "idle", "--episodes", "9", "--workers", "1"),
        *("--tasks", "defend_the_center/default", "--out", str(out)),
    ]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    deadline = time.monotonic() + 120
    while num_rows(out) == 0:
        assert time.monotonic() < deadline, "waited 120 s for the first row"
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert "interrupted; the same command goes on from here" in err
    assert "Traceback" not in err
    before = num_rows(out)
    assert 0 < before < 9
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, cwd=tmp_path, check=False)
    assert done.returncode == 0, done.stderr
    rows, problems = read_records(out)
    assert problems == []
    assert sorted(row["episode"] for row in rows) == list(range(9))
    assert "defend_the_center/default" in done.stdout
    assert list(tmp_path.iterdir()) == [out]


def num_rows(file: Path) -> int:
    return len(file.read_text().splitlines()) if file.exists() else 0
