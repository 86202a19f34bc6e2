"""The command, as a person types it."""

import gzip
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.e2e
def test_a_run_and_chance_beside_it_damaged_and_all(tmp_path):
    run = tmp_path / "run"
    shutil.copytree(ROOT / "results" / "rainbow_quick" / "seed_3333", run)
    chance = gzip.decompress((ROOT / "results" / "rainbow_quick" / "evaluation_random.jsonl.gz").read_bytes())
    (tmp_path / "random.jsonl").write_bytes(chance[:-40])
    command = [sys.executable, "-m", "gvz.cli", "report", "run", "random.jsonl", "--out", "out"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == ["out/report.html", "out/report.md"]
    assert done.stderr == "note: random.jsonl, line 100: not JSON (half-written?)\n"
    text = (tmp_path / "out" / "report.md").read_text()
    assert re.search(r"rainbow_quick has \d+\.\d \[.*\] points more than random", text)
    assert "| rainbow_quick | 65.5 [61.7, 69.2] |" in text  # by results/rainbow_quick/README.md
    assert (tmp_path / "out" / "figures" / "learning_defend_the_center_rainbow_quick.png").exists()


def test_bad_input_is_a_line_and_exit_code_2(tmp_path, refusal):
    said = refusal("report", str(tmp_path / "nowhere"), "--out", str(tmp_path / "out"))
    assert "nowhere: no such file or directory" in said
    assert "report: got nothing to report on" in refusal("report", "--out", str(tmp_path / "out"))
    assert not (tmp_path / "out").exists()
