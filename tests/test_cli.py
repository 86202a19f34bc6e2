"""The gvz command: quick to start, resumable, one clear message for bad input."""

import errno
import json
import os
import signal
import subprocess
import sys
from importlib.metadata import version

import pytest

from gvz import cli, launch
from gvz.core.registry import discover
from gvz.tasks import scenarios


def test_help_loads_neither_jax_nor_vizdoom_nor_anything_heavy():
    code = (
        "import sys; from gvz import cli\n"
        "try: cli.main(['--help'])\n"
        "except SystemExit as end: assert end.code == 0\n"
        "heavy = ('numpy', 'jax', 'vizdoom', 'cv2', 'PIL', 'gymnasium', 'orbax', 'polars', 'matplotlib')\n"
        "print([m for m in heavy if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stderr.strip() == "[]"
    for command in discover("gvz.commands"):
        assert f"• {command} " in done.stdout


@pytest.mark.parametrize("arguments", ["cli tasks", "launch --help"])
def test_a_reader_that_has_enough_is_no_error(arguments):
    read, write = os.pipe()
    os.close(read)
    module, *flags = arguments.split()
    command = [sys.executable, "-m", f"gvz.{module}", *flags]
    done = subprocess.run(command, stdout=write, stderr=subprocess.PIPE, timeout=120, check=False)
    os.close(write)
    assert (done.returncode, done.stderr) == (141, b"")


@pytest.mark.parametrize(
    "arguments", ["cli tasks", "cli tasks --help", "cli tasks --scenario rockets", "launch --help"]
)
def test_output_that_has_no_room_is_one_line(arguments):
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    module, *flags = arguments.split()
    command = ["bash", "-c", 'exec "$@" > /dev/full', "bash", sys.executable, "-m", f"gvz.{module}", *flags]
    done = subprocess.run(command, stderr=subprocess.PIPE, env=environment, timeout=120, check=False, text=True)
    assert done.returncode == 1
    assert done.stderr == "error: No space left on device; make room or give a place that you can write to\n"


def test_a_current_directory_that_is_gone_is_one_line(tmp_path, monkeypatch, refusal):
    monkeypatch.chdir(tmp_path)
    tmp_path.rmdir()
    said = refusal("train", "--config", "./mine.py")
    assert said == "error: the current directory is not there any more; change to another\n"


def test_closed_output_is_no_error():
    command = ["bash", "-c", 'exec "$@" >&-', "bash", sys.executable, "-m", "gvz.cli", "--help"]
    done = subprocess.run(command, stderr=subprocess.PIPE, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (0, b"")


def test_help_of_a_command_says_all_that_the_overview_leaves_out(capsys):
    told = []
    for arguments in (["--help"], ["evaluate", "--help"]):
        with pytest.raises(SystemExit, match=r"^(0|None)$"):
            cli.main(arguments)
        told.append(" ".join(capsys.readouterr().out.split()))
    overview, evaluate = told
    assert "Play evaluation episodes and append a row" in overview
    assert "Episode n of a task has the same seed" not in overview
    assert "Episode n of a task has the same seed" in evaluate
    assert "RUN_DIR" in evaluate
    assert "None" not in evaluate.replace("(default: None)", "")


@pytest.mark.parametrize(
    ("command", "arguments", "text"),
    [
        (cli.main, ["evaluate", "--help"], "noise off; by default the test tasks of their scenarios"),
        (launch.main, ["--help"], "pairs adds to 8 each two of their attributes"),
    ],
)
def test_help_of_a_flag_breaks_lines_only_where_the_terminal_ends(command, arguments, text, capsys, monkeypatch):
    """And not where the docstring does."""
    monkeypatch.setenv("COLUMNS", "1000")
    with pytest.raises(SystemExit):
        command(arguments)
    assert text in capsys.readouterr().out


def test_it_says_its_version(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"gvizdoom {version('gvizdoom')}\n"


def test_tasks_lists_all_named_tasks(capsys):
    assert cli.main(["tasks", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(rows) == 76
    assert len({row["gymnasium_id"] for row in rows}) == 76
    gore = next(row for row in rows if row["task"] == "defend_the_center/gore")
    assert (gore["level"], gore["attributes"], gore["sets"]) == (
        1,
        ["gore"],
        ["train4", "train8", "pairs", "compositions", "train8_varied"],
    )


def test_tasks_prints_a_table(capsys):
    assert cli.main(["tasks", "--scenario", "seek_and_kill", "--split", "test"]) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.split() == ["level", "sets", "task"]
    assert len(lines) == 7
    assert lines[0].split() == ["2", "test", "seek_and_kill/blue+shadows"]
    assert lines[-1].split() == [
        *("4", "test", "seek_and_kill/complete", "=", "mixed_enemies+obstacles+red+resized_enemies+shadows")
    ]
    assert {len(line) > 80 for line in lines[:-1]} == {False}
    others = ["seek_and_kill/blue=0.5+shadows", "seek_and_kill/varied-10+shadows"]
    assert cli.main(["tasks", "--tasks", *others]) == 0
    assert [line.split()[1:] for line in capsys.readouterr().out.splitlines()[1:]] == [[task] for task in others]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("tasks --scenario seek_and_kil", "unknown scenario 'seek_and_kil' (did you mean 'seek_and_kill'?)"),
        ("tasks --tasks seek_and_kill/blu", "unknown attribute 'blu' (did you mean 'blue'?)"),
        ("tasks --tasks seek_and_kill/blue --split test", "got ids and also --scenario, --split, --suite or --level"),
        ("tasks --tasks", "--tasks: got none, want at least one id"),
        ("zoo --checkpoint 10", "got --replace or --checkpoint, want them with --add alone"),
        ("gallery --scenario nowhere", "unknown scenario 'nowhere'"),
        ("gallery --out {file}/below", "cannot be made: Not a directory"),
        ("train --config no_such", "no config 'no_such'"),
    ],
)
def test_bad_input_gives_one_message_and_exit_code_2(arguments, message, refusal, tmp_path):
    (tmp_path / "file").touch()
    assert message in refusal(*arguments.format(file=tmp_path / "file").split())


def test_tasks_of_later_scenarios_are_listed_by_their_suite(capsys, refusal):
    said = refusal("tasks", "--suite", "extended", "--scenario", "defend_the_center")
    assert "--scenario defend_the_center, which is of another suite" in said
    assert cli.main(["tasks", "--suite", "extended", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {row["scenario"] for row in rows} == set(scenarios("extended"))
    assert len([row for row in rows if row["scenario"] == "find_the_key"]) == 22
    assert "GViZDoom/FindTheKey-Default-v0" in [row["gymnasium_id"] for row in rows]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_gives_one_line_and_the_exit_code_that_shells_expect(number, capsys, monkeypatch):
    monkeypatch.setattr(cli, "run", lambda _: signal.raise_signal(number))
    assert cli.main(["gallery"]) == 128 + number
    assert capsys.readouterr() == ("", "interrupted\n")


@pytest.mark.parametrize(("waits", "code"), [(True, 7), (False, 3)])
def test_a_thread_that_waits_without_end_does_not_keep_the_command_nor_change_its_exit_code(waits, code):
    script = f"""
import atexit, os, threading
from gvz import cli
from gvz.core import stop
def run(_):
    thread = threading.Thread(target=threading.Event().wait if {waits} else int, daemon=True)
    thread.start()
    stop.stuck.add(thread)
    if not {waits}:
        thread.join()
    return 7
cli.run = run
atexit.register(os._exit, 3)  # what the interpreter's end does
cli.main([])
"""
    assert subprocess.run([sys.executable, "-c", script], timeout=60, check=False).returncode == code


def test_an_interrupted_import_is_an_interruption(capsys, monkeypatch):
    def run(_: list[str]) -> int:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            raise ImportError("initialization failed") from None  # as vizdoom's
        return 0

    monkeypatch.setattr(cli, "run", run)
    assert cli.main(["gallery"]) == 143
    assert capsys.readouterr() == ("", "interrupted\n")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (PermissionError(errno.EACCES, "Permission denied", "out/a.svg"), "error: out/a.svg: Permission denied; make "),
        (OSError(errno.ENAMETOOLONG, "File name too long", "a.gif"), "error: a.gif: File name too long; make room or "),
        (OSError(errno.ENOSPC, "No space left on device"), "error: No space left on device; make room or give "),
    ],
)
def test_a_place_that_cannot_be_written_is_one_line(error, said, monkeypatch, capsys):
    def fail(_):
        raise error

    monkeypatch.setattr(cli, "run", fail)
    assert cli.main(["report"]) == 1
    assert capsys.readouterr().err.startswith(said)


def test_errors_that_are_no_matter_of_the_disk_keep_their_traceback(monkeypatch):
    def fail(_):
        raise TimeoutError(errno.ETIMEDOUT, "timed out")

    monkeypatch.setattr(cli, "run", fail)
    with pytest.raises(TimeoutError):
        cli.main(["report"])


def test_the_cache_of_policies_must_be_writable(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path / "file" / "cache"))
    assert cli.main(["zoo", "seek_and_kill"]) != 0
    assert "make it writable, or set GVZ_CACHE_DIR to a directory that is" in capsys.readouterr().err
