"""Seconds to the help page and from the command to the first episode's row of `rainbow_4task`, with warm caches, and
the processor time of an actor's start, which is the cost of each replacement.

The first run fills the caches (bytecode, compiled maps, compiled programs) and is discarded. Goals: `--help` under
0.5 s without importing jax, the first row within 15 s.
"""

import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from benchmarks import workload
from benchmarks.rounds import Budget, Row, alternate, goal, measured
from benchmarks.whole import end_run

_LAUNCH = [sys.executable, "-m", "gvz.launch"]
_GVZ = str(Path(sys.executable).with_name("gvz"))
_TIMEOUT_S = 600.0
_POLL_S = 0.05


def measure(budget: Budget) -> list[Row]:
    """Alternates all measurements."""
    with tempfile.TemporaryDirectory(prefix="gvz-benchmark-") as directory:
        counter = iter(range(1000))
        values = alternate(
            min(budget.rounds, 3),
            {
                "launch": partial(_help_s, *_LAUNCH),
                "gvz": partial(_help_s, _GVZ),
                "episode": lambda: _first_episode_s(Path(directory) / f"run_{next(counter)}", budget),
                "actor": lambda: _actor_start_s(budget),
            },
            warm_up=not budget.quick,
        )
    return [
        goal(8, "`python -m gvz.launch --help`", values["launch"], at_most=0.5, unit="s"),
        goal(8, "`gvz --help`", values["gvz"], at_most=0.5, unit="s"),
        measured("modules of jax that `python -m gvz.launch --help` imports", "modules", [_jax_modules_of_help()]),
        goal(8, "from the command to the first episode's row", values["episode"], at_most=15.0, unit="s"),
        measured("processor time until an actor with four games plays, its engines' included", "s", values["actor"]),
    ]


def _help_s(*command: str) -> float:
    start = time.perf_counter()
    subprocess.run([*command, "--help"], stdout=subprocess.DEVNULL, check=True)
    return time.perf_counter() - start


def _jax_modules_of_help() -> int:
    done = subprocess.run(
        [sys.executable, "-X", "importtime", "-m", "gvz.launch", "--help"], capture_output=True, text=True, check=True
    )
    names = [line.rpartition("|")[2].strip() for line in done.stderr.splitlines()]
    return sum(name == "jax" or name.startswith("jax.") for name in names)


def _first_episode_s(directory: Path, budget: Budget) -> float:
    """Runs the real command until episodes.jsonl holds a line, then ends it."""
    records = directory / "episodes.jsonl"
    start = time.perf_counter()
    process = subprocess.Popen(
        [*_LAUNCH, "--config", "rainbow_4task.py", "--run-dir", str(directory), *workload.quick_flags(budget)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        while not (records.exists() and b"\n" in records.read_bytes()):
            if process.poll() is not None or time.perf_counter() - start > _TIMEOUT_S:
                raise RuntimeError(f"{directory}: no episode within {_TIMEOUT_S:.0f} s, exit code {process.returncode}")
            time.sleep(_POLL_S)
        return time.perf_counter() - start
    finally:
        end_run(process)


def _actor_start_s(budget: Budget) -> float:
    """Processor seconds of one actor and its engines until it is ready to play."""
    with workload.assembled(workload.run_config(budget)) as parts:
        alone = msgspec.structs.replace(parts.pool_config, num_actors=1, cores=())
        before = workload.processor_s()
        with workload.playing(alone, np.zeros(alone.num_params, np.float32)):
            after = workload.processor_s()
    return sum(after[where] - before[where] for where in ("Python", "engines"))
