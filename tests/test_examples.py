"""The examples that need nothing but GViZDoom run as they stand; those with other libraries are in tests/interop."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from gvz.evaluation.play import episode_seed

EXAMPLES = Path(__file__).parent.parent / "examples"


def run(name: str, *arguments: str, where: Path) -> str:
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    done = subprocess.run(command, cwd=where, capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.engine
def test_own_agent_loop_plays_its_episodes(tmp_path):
    lines = run("own_agent_loop.py", "--episodes", "2", where=tmp_path).splitlines()
    assert [line.split(":")[0] for line in lines] == ["episode 0", "episode 1"]
    assert all("of 1100, reward" in line for line in lines)


@pytest.mark.engine
@pytest.mark.parametrize("mode", ["sync", "async"])
def test_vector_environments_finish_episodes(tmp_path, mode):
    task = "GViZDoom/DefendTheCenter-Gore-v0"
    out = run("vector_envs.py", "--mode", mode, "--steps", "120", "--task", task, where=tmp_path)
    assert "observations (2, 4, 84, 84, 3) uint8" in out
    assert "game 0: score" in out
    assert "game 1: score" in out


@pytest.mark.engine
def test_own_agent_is_evaluated_on_the_episodes_of_everybody(tmp_path):
    out = run("evaluate_own_agent.py", "--episodes", "2", where=tmp_path)
    assert out.startswith("defend_the_center/default: ")
    rows = [json.loads(line) for line in (tmp_path / "own_agent.jsonl").read_text().splitlines()]
    assert [row["seed"] for row in rows] == [episode_seed("defend_the_center/default", n) for n in range(2)]
    assert {row["player"] for row in rows} == {"motion"}
    run("evaluate_own_agent.py", "--episodes", "1", "--name", "changed", where=tmp_path)
    rows = [json.loads(line) for line in (tmp_path / "own_agent.jsonl").read_text().splitlines()]
    assert [row["player"] for row in rows] == ["motion", "motion", "changed"]


EXECUTE = """
import sys, nbclient, nbformat
notebook = nbformat.read(sys.argv[1], as_version=4)
nbclient.NotebookClient(notebook, timeout=240, resources={"metadata": {"path": sys.argv[2]}}).execute()
nbformat.write(notebook, sys.argv[3])
"""


def outputs(notebook: Path, kind: str) -> list:
    """What the cells print (`text`), or show (`data`)."""
    cells = json.loads(notebook.read_text())["cells"]
    return [output[kind] for cell in cells for output in cell.get("outputs", ()) if kind in output]


@pytest.mark.engine
@pytest.mark.timeout(600)
def test_the_notebook_runs_and_prints_what_is_committed(tmp_path):
    committed, executed = EXAMPLES / "tour.ipynb", tmp_path / "tour.ipynb"
    command = [sys.executable, "-c", EXECUTE, committed, EXAMPLES, executed]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, check=False)
    assert done.returncode == 0, done.stderr
    assert outputs(executed, "text") == outputs(committed, "text")
    assert [set(shown) for shown in outputs(committed, "data")] == [{"image/png", "text/plain"}] * 3
    assert committed.stat().st_size < 500_000


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda file: file.name)
def test_an_example_is_short_and_says_how_it_is_run(file):
    text = file.read_text()
    assert len(text.splitlines()) < 60
    assert f"python examples/{file.name}" in text
