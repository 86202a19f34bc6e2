"""gvz doctor, as it is called."""

import json
import subprocess
import sys
import tempfile

from gvz import cli
from gvz.run import doctor


def test_json_has_a_line_for_every_check(capsys, monkeypatch):
    slow = (doctor.check_engine, doctor.check_learner)  # tests/run/test_doctor.py runs all of them
    monkeypatch.setattr(doctor, "CHECKS", tuple(check for check in doctor.CHECKS if check not in slow))
    assert cli.main(["doctor", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(rows) == len(doctor.CHECKS)
    assert all(set(row) == {"name", "state", "found", "remedy"} for row in rows)


def test_a_bad_finding_gives_exit_code_1_and_its_remedy(capsys, monkeypatch, tmp_path):
    (tmp_path / "file").touch()
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path / "file" / "below"))
    monkeypatch.setattr(doctor, "CHECKS", (doctor.check_cache,))
    assert cli.main(["doctor"]) == 1
    out = capsys.readouterr().out
    assert out.startswith("bad   cache")
    assert "-> set GVZ_CACHE_DIR" in out


def test_a_check_that_cannot_be_made_is_bad_and_the_next_ones_are_made(capsys, monkeypatch, tmp_path):
    """Every place for temporary files is full or read-only: a line for each check, and no traceback."""
    monkeypatch.delenv("GVZ_RUNTIME_DIR")
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setattr(tempfile, "_candidate_tempdir_list", lambda: [str(tmp_path / "gone")])
    checks = (doctor.check_temporary_directory, doctor.check_leftovers, doctor.check_python)
    monkeypatch.setattr(doctor, "CHECKS", checks)
    assert cli.main(["doctor"]) == 1
    temporary, leftovers, python = capsys.readouterr().out.splitlines()
    assert temporary.startswith("bad   temporary_directory ")
    assert leftovers.startswith("bad   leftovers  No usable temporary directory found in ")
    assert leftovers.endswith("; make room in one, or set TMPDIR to a writable directory")
    assert python.startswith(("ok    python ", "note  python "))


def test_a_shared_directory_that_nothing_can_be_made_in_is_bad(capsys):
    assert cli.main(["doctor", "--shared", "/proc"]) == 1
    assert [line.split()[:2] for line in capsys.readouterr().out.splitlines() if line.startswith("bad")] == [
        ["bad", "locks"],
        ["bad", "renames"],
        ["bad", "fsync"],
    ]


def test_clean_removes_what_a_dead_run_left(capsys, monkeypatch, tmp_path):
    tmp_path.chmod(0o700)
    monkeypatch.setenv("GVZ_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(doctor, "CHECKS", (doctor.check_leftovers,))
    left = tmp_path / "gvz-engine-0123456789abcdef"
    left.mkdir()
    code = f"from pathlib import Path; from gvz.core import janitor; janitor.record(Path({str(left)!r}))"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
    assert cli.main(["doctor"]) == 0
    assert f"1: {left}" in capsys.readouterr().out
    assert left.exists()
    assert cli.main(["doctor", "--clean", "--json"]) == 0
    out, err = capsys.readouterr()
    assert f"removed directory {left}" in err
    assert json.loads(out)["found"] == "none"
    assert not left.exists()
