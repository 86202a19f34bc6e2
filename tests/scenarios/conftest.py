"""Measurements of running games, shared by the tests of all scenarios."""

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

Job = tuple[str, str]
"""task id, profile"""


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
