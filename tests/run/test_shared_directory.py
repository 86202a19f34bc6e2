"""A directory that several machines share: what its checks find, and what they find where it is not fit."""

import errno
import fcntl
import json
import os
import re
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gvz import cli
from gvz.core import records
from gvz.core.errors import ConfigError
from gvz.run import shared_directory


def test_a_local_directory_is_fit_and_nothing_is_left_in_it(tmp_path, capsys):
    assert cli.main(["doctor", "--shared", str(tmp_path), "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    found = {row["name"]: (row["state"], row["found"]) for row in rows}
    assert found["locks"] == ("ok", f"{tmp_path}: one process at a time; a killed one loses its lock")
    assert found["renames"][0] == "ok"
    assert int(re.findall(r"each of (\d+) reads", found["renames"][1])[0]) > 0
    assert found["fsync"][0] == "ok"
    assert found["machines"] == ("note", "locks between machines are not tested by one alone")
    assert f"gvz doctor --shared {tmp_path} --hold 60" in rows[-1]["remedy"]
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_another_process_holds_is_seen(tmp_path):
    command = [sys.executable, "-m", "gvz.cli", "doctor", "--shared", str(tmp_path), "--hold", "100"]
    holder = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert holder.stdout is not None
        assert f"now, on another machine: gvz doctor --shared {tmp_path}" in holder.stdout.readline()
        finding = shared_directory.check_other_machine(tmp_path)
        want = f"{socket.gethostname()} holds a lock in it, which is refused on {socket.gethostname()}"
        assert (finding.state, finding.found) == ("ok", want)
        with pytest.raises(ConfigError, match="somebody holds the lock"):
            shared_directory.hold(tmp_path, 1, print)
    finally:
        holder.kill()
        holder.communicate(timeout=30)
    finding = shared_directory.check_other_machine(tmp_path)  # a lock that does not reach this machine looks like that
    assert (finding.state, finding.remedy) == ("bad", records.MOUNT)


def test_where_locks_do_nothing_they_are_found_bad(tmp_path, monkeypatch):
    monkeypatch.setattr(fcntl, "flock", lambda *_: None)  # this process's alone, as on a mount with local locks
    finding = shared_directory.check_locks(tmp_path)
    assert (finding.state, finding.found) == ("bad", f"{tmp_path}: two processes got one lock")


def test_where_a_file_is_replaced_in_two_steps_renames_are_found_bad(tmp_path, monkeypatch):
    replaced = 'os.replace(directory / "new", directory / "file")'
    assert replaced in shared_directory._RENAMER
    slow = f'(directory / "file").unlink(); __import__("time").sleep(0.01); {replaced}'
    in_steps = shared_directory._RENAMER.replace(replaced, slow)
    monkeypatch.setattr(shared_directory, "_RENAMER", in_steps)
    finding = shared_directory.check_renames(tmp_path)
    assert (finding.state, finding.found) == ("bad", f"{tmp_path}: a file was missing while it was replaced")
    assert list(tmp_path.iterdir()) == []


def test_where_a_file_cannot_be_replaced_renames_are_found_bad(tmp_path, monkeypatch):
    fails = "def no(*_): raise OSError(95, 'Operation not supported')\nimport os\nos.replace = no\n"
    monkeypatch.setattr(shared_directory, "_RENAMER", fails + shared_directory._RENAMER)
    finding = shared_directory.check_renames(tmp_path)
    assert finding.state == "bad"
    assert finding.found.endswith("a file could not be replaced: OSError: [Errno 95] Operation not supported")
    assert list(tmp_path.iterdir()) == []


def test_a_mark_is_known_by_its_place_text_and_lock(tmp_path):
    with shared_directory.mark(tmp_path) as (path, text):
        assert shared_directory.problem(path, text) == ""
        assert "reads old contents" in shared_directory.problem(path, "other")
        assert "does not see the files of /nowhere" in shared_directory.problem("/nowhere/file", text)
    unlocked = tmp_path / "file"
    unlocked.write_text(text)
    assert "does not see locks of others" in shared_directory.problem(str(unlocked), text)


def test_a_directory_that_a_machine_cannot_write_to_is_named(tmp_path, monkeypatch):
    def refused(*_: object, **__: object) -> None:
        raise PermissionError(errno.EROFS, os.strerror(errno.EROFS))

    with shared_directory.mark(tmp_path) as (path, text):
        monkeypatch.setattr(Path, "touch", refused)
        assert shared_directory.problem(path, text) == (
            f"cannot write to {tmp_path} (Read-only file system); mount it for writing"
        )


def test_a_lock_that_does_not_reach_this_machine_is_found_bad_also_if_the_other_ones_clock_is_behind(
    tmp_path, monkeypatch
):
    found, here_s = [], time.time
    monkeypatch.setattr(records, "is_locked", lambda _: False)
    monkeypatch.setattr(time, "time", lambda: here_s() - 1000)
    monkeypatch.setattr(time, "sleep", lambda _: None)

    def look(_: str) -> None:
        monkeypatch.setattr(time, "time", here_s)
        found.append(shared_directory.check_other_machine(tmp_path))

    shared_directory.hold(tmp_path, 60, look)
    assert [finding.state for finding in found] == ["bad"]
    assert list(tmp_path.iterdir()) == []


def test_an_old_lock_file_says_nothing(tmp_path):
    file = tmp_path / shared_directory.LOCK_FILE
    file.write_text(json.dumps({"host": "gone", "seconds": 60}))
    os.utime(file, (0, time.time() - 61))
    assert shared_directory.check_other_machine(tmp_path).state == "note"
    assert not records.is_locked(tmp_path / shared_directory.LOCK_FILE)


@pytest.mark.parametrize(
    ("flags", "text"),
    [
        (["--shared", "/nowhere"], "/nowhere is no directory that you can write to"),
        (["--hold", "5"], "--hold: got 5, want more than 0 and at most 86400 seconds, and --shared DIR"),
        (["--shared", "/tmp", "--hold", "0"], "--hold: got 0, want more than 0 and at most 86400 seconds"),
        (["--shared", "/tmp", "--hold", "inf"], "--hold: got inf, want more than 0 and at most 86400 seconds"),
    ],
)
def test_what_cannot_be_is_refused(flags, text, refusal):
    assert text in refusal("doctor", *flags)
