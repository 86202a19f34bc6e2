"""Measurements of running games, shared by the tests of all scenarios."""

import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import pytest

BAD_LOG_LINES = re.compile(r".*(?:unknown|tried to register|script error|error|unable|not found|missing).*", re.I)

Job = tuple[str, str]
"""task id, profile"""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of maps of the test's own."""
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path / "maps"))
    return tmp_path / "maps"


@pytest.fixture(scope="session")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Callable[[tuple[Job, ...], Job], dict[str, Any]]:
    """f(jobs, job) -> what measure.py found for `job`; plays all `jobs` in one sub-process at the first call."""
    cache = str(tmp_path_factory.mktemp("maps"))
    batches: dict[tuple[Job, ...], dict[Job, dict[str, Any]]] = {}

    def play(jobs: tuple[Job, ...]) -> dict[Job, dict[str, Any]]:
        with subprocess.Popen(
            [sys.executable, str(Path(__file__).with_name("measure.py"))],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "GVZ_CACHE_DIR": cache},
            start_new_session=True,
        ) as process:
            try:
                out, err = process.communicate(json.dumps(jobs), timeout=60 + 10 * len(jobs))
            except BaseException:
                os.killpg(process.pid, signal.SIGKILL)  # the bare engine would outlive its client
                raise
        answers = [json.loads(line) for line in out.splitlines()]
        if len(answers) < len(jobs):
            answers.append({"died": f"{jobs[len(answers)]}: exit {process.returncode}\n{err[-2000:]}"})
        return dict(zip(jobs, answers, strict=False))

    def measurements(jobs: tuple[Job, ...], job: Job) -> dict[str, Any]:
        if jobs not in batches:
            batches[jobs] = play(jobs)
        found = batches[jobs].get(job, {"died": "an earlier map ended the process"})
        assert "died" not in found, found["died"]
        return found

    return measurements


@pytest.fixture
def start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest
) -> Generator[Callable[[str], Any]]:
    """f(task's name) -> a running game of the test module's SCENARIO, a tic at a time; its log has to be clean."""
    from tests.scenarios.measure import Player

    monkeypatch.chdir(tmp_path)
    games: list[Player] = []

    def started(name: str) -> Player:
        games.append(Player(f"{request.module.SCENARIO}/{name}", "thesis"))
        return games[-1]

    yield started
    for player in games:
        player.game.close()
        assert bad_lines(player.log.read_text(errors="replace")) == []


def bad_lines(log: str) -> list[str]:
    """What the engine complains of in its log, by our words and by those of the probe."""
    from gvz.engine.probe import _faults

    return [line for line in (*BAD_LOG_LINES.findall(log), *_faults(log)) if "bots read" not in line]
