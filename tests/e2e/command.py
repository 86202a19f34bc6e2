"""The real command as a process, and what can be seen of it: records, processes, shared memory, checkpoints."""

import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import orbax.checkpoint as ocp
import psutil

from gvz.core import records
from tests.processes import arguments

ENV_STEPS_PER_UPDATE = 4
"""a quarter of the default: engines take most of a small run's time"""
SMALL = (
    "--actors.num-actors 2 --actors.games-per-actor 2 --env.frame-height 36 "
    "--env.frame-width 44 --env.grayscale --agent.conv-channels 8 8 --agent.conv-kernels 8 4 --agent.conv-strides 4 2 "
    "--agent.hidden-units 32 --replay.capacity 4000 --learner.warmup-steps 300 --learner.batch-size 8 "
    f"--learner.env-steps-per-update {ENV_STEPS_PER_UPDATE} --log.period-updates 20 "
    "--checkpoint.period-updates 100 --learner.target-period-updates 50"
).split()


TIMEOUT_S = 600.0
"""how long a test waits for something that a run does"""
STARTED: list[subprocess.Popen[str]] = []
"""the runs of a test"""

_PATCHED = "import sys, gvz.run.train, gvz.run.saver; {patch}; from gvz.launch import main; sys.exit(main())"


def launch(
    run: Path,
    *extra: str,
    config: str = "rainbow_4task",
    environment: Mapping[str, str] | None = None,
    patch: str | None = None,
) -> subprocess.Popen[str]:
    """Starts `python -m gvz.launch`; with a `patch` (such as gvz.run.saver.SAVE_RETRY_S = 0) that is done before it."""
    program = ["-m", "gvz.launch"] if patch is None else ["-c", _PATCHED.format(patch=patch)]
    process = subprocess.Popen(
        [sys.executable, *program, "--config", config, *SMALL, "--run-dir", str(run), *extra],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **(environment or {})},
        start_new_session=True,
    )
    STARTED.append(process)
    return process


def finish(process: subprocess.Popen[str], timeout_s: float = 900) -> tuple[int, str]:
    """Exit code and standard error."""
    _, err = process.communicate(timeout=timeout_s)
    return process.returncode, err


def rows(run: Path, name: str) -> list[dict[str, Any]]:
    """The rows of a record file, which must all be readable."""
    found, problems = records.read(run / name)
    assert problems == []
    return found


def faults(run: Path) -> list[dict[str, Any]]:
    """The rows of faults.jsonl while a run goes on, without one that is being written."""
    file = run / "faults.jsonl"
    return [json.loads(line) for line in file.read_text().splitlines()] if file.exists() else []


def num_updates(run: Path) -> int:
    file = run / "metrics.jsonl"
    lines = file.read_text().splitlines() if file.exists() else []
    return json.loads(lines[-1])["num_updates"] if lines else 0


def descendants(process: subprocess.Popen[str]) -> list[psutil.Process]:
    return psutil.Process(process.pid).children(recursive=True)


def engines(process: psutil.Process | subprocess.Popen[str]) -> list[psutil.Process]:
    """The engines of an actor or of a whole run, those too that are still starting."""
    return [p for p in psutil.Process(process.pid).children(recursive=True) if "+viz_instance_id" in arguments(p)]


def alive(processes: list[psutil.Process]) -> list[psutil.Process]:
    """Those with a thread that lives. The first thread of a killed process can be a zombie while another one still
    frees the memory; until that is done, the process holds its locks.
    """
    return [p for p in processes if p.is_running() and any(map(_lives, Path(f"/proc/{p.pid}/task").glob("*/stat")))]


def _lives(stat: Path) -> bool:
    try:
        state = stat.read_text().rpartition(")")[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state not in "ZX"


def arrays_of(checkpoint: Path) -> dict[str, np.ndarray]:
    """The arrays of a checkpoint by their place in its tree, as "['replay'].store.action"."""
    leaves = list(json.loads((checkpoint / "manifest.json").read_text())["leaves"])
    stored = ocp.PyTreeCheckpointer().restore((checkpoint / "arrays").absolute())
    blocks: dict[int, dict[int, np.ndarray]] = {}
    for name, block in stored.items():  # "LEAF.FIRST_ROW"
        leaf, _, row = name.partition(".")
        blocks.setdefault(int(leaf), {})[int(row)] = np.asarray(block)
    joined = {leaf: [parts[row] for row in sorted(parts)] for leaf, parts in blocks.items()}
    return {leaves[leaf]: np.concatenate(parts) if parts[0].ndim else parts[0] for leaf, parts in joined.items()}
