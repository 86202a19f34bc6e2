"""The learning curve: what is drawn is the records, and a missing record is an error a person understands."""

import json
import subprocess
import sys

import numpy as np

from gvz.reports.curve import running_mean


def curve(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "gvz.reports.curve", *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_the_running_mean_by_hand():
    assert running_mean(np.array([1.0, 2.0, 6.0, 7.0]), 2).tolist() == [1.0, 1.5, 4.0, 6.5]


def test_a_picture_is_drawn_and_damage_named(tmp_path):
    rows = [{"schema": 1, "task": "t", "cut": False, "num_updates": i, "score": float(i)} for i in range(40)]
    (tmp_path / "episodes.jsonl").write_text("\n".join(map(json.dumps, rows)) + '\n{"half')
    done = curve(str(tmp_path), "--out", str(tmp_path / "c.png"), "--random", "3")
    assert done.returncode == 0, done.stderr
    assert "line 41: not JSON" in done.stderr
    assert (tmp_path / "c.png").read_bytes().startswith(b"\x89PNG")


def test_a_directory_without_records_is_an_error(tmp_path):
    done = curve(str(tmp_path), "--out", "c.png")
    assert done.returncode == 2
    assert "no such record file" in done.stderr
