"""Finds the benchmarks and runs each in its own process, so that none can stop, slow down or outlive the others.

A benchmark is a file of this package with a docstring and a function `measure(budget) -> list of rows`; its file name
is its name.
"""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
import traceback
from dataclasses import asdict, replace
from pathlib import Path
from types import ModuleType

from benchmarks import record, rounds
from benchmarks.rounds import Budget
from gvz.core import janitor
from gvz.core.cache import xla_cache_directory
from gvz.core.errors import ConfigError
from gvz.core.registry import discover
from gvz.run.machine import versions
from learner.memory import keep_freed_memory

TIMEOUT_S = 900.0
"""a benchmark that takes longer is ended"""
_GRACE_S = 20.0


def benchmarks() -> dict[str, ModuleType]:
    """Name -> module of every benchmark."""
    return {name: module for name, module in discover("benchmarks").items() if hasattr(module, "measure")}


def chosen(names: tuple[str, ...]) -> list[str]:
    """The names to run, `all` standing for every one.

    Raises:
        ConfigError: no name, or an unknown one.
    """
    known = list(benchmarks())
    if unknown := sorted(set(names) - {*known, "all"}):
        raise ConfigError(f"benchmarks: there is no {', '.join(unknown)}; there are all, {', '.join(known)}")
    if not names:
        raise ConfigError(f"benchmarks: got no name, want some of all, {', '.join(known)}")
    return known if "all" in names else list(dict.fromkeys(names))


def run_in_process(name: str, budget: Budget, command: str) -> record.Record:
    """Measures one benchmark here and now. Nothing in this process has used jax before."""
    keep_freed_memory()  # as gvz/run/train.py does, and as early: threads that have allocated keep their arenas
    import jax

    jax.config.update("jax_compilation_cache_dir", str(xla_cache_directory()))
    machine, commit = record.describe_machine(), record.describe_commit()
    date, start = time.strftime("%Y-%m-%d %H:%M", time.gmtime()), time.monotonic()
    rows = benchmarks()[name].measure(budget)
    return record.Record(
        schema=record.SCHEMA,
        benchmark=name,
        device=jax.default_backend(),
        commit=commit,
        date=date,
        command=command,
        quick=budget.quick,
        seconds=round(time.monotonic() - start, 1),
        machine=machine,
        versions=versions(),
        rows=rows,
    )


def run(name: str, budget: Budget, command: str, out: Path, *, timeout_s: float = TIMEOUT_S) -> str:
    """Measures one benchmark in a process of its own and writes its record.

    Returns:
        What went wrong, or nothing.
    """
    arguments = {"budget": asdict(budget), "command": command, "out": out.absolute()}
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.runner", name, json.dumps(arguments, default=str)],
        cwd=record.ROOT,
        # a run that a benchmark starts needs room on the GPU beside it
        env={"XLA_PYTHON_CLIENT_PREALLOCATE": "false", **record.environment()},
        start_new_session=True,  # Ctrl-C reaches us alone, and what it starts can be ended as one group
    )
    try:
        code = process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        return f"{name}: it had not ended after {timeout_s:.0f} s"
    finally:
        _end(process)
    return "" if code == 0 else f"{name}: its process ended with code {code}"


def _end(process: "subprocess.Popen[bytes]") -> None:
    """Ends a benchmark's process in good order if it still runs, then whatever is left of its group and its memory."""
    process.terminate()
    try:
        process.wait(_GRACE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    janitor.clean_dead_instances()


def main() -> int:
    """The process of one benchmark: `python -m benchmarks.runner NAME ARGUMENTS`."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that every context manager closes what it opened
    name, arguments = sys.argv[1], json.loads(sys.argv[2])
    budget = replace(Budget(**arguments["budget"]), peers=Path(arguments["budget"]["peers"]))
    try:
        made = run_in_process(name, budget, arguments["command"])
    except KeyboardInterrupt:
        return 130
    except Exception:  # the process boundary: the runner goes on with the next benchmark
        traceback.print_exc()
        return 1
    for row in made.rows:
        print("  " + line(row))
    print(f"  -> {record.write(made, Path(arguments['out']))}", flush=True)
    return 0


def line(row: rounds.Row) -> str:
    """A row as a person reads it."""
    if row["kind"] == "absent":
        return f"{row['name']}: not measured ({row['why']})"
    if row["kind"] == "rates":
        named = [(unit, row[f"{unit}_per_s"]) for unit in ("decisions", "frames", "updates", "samples")]
        return f"{row['name']}: " + ", ".join(f"{rate['median']:,.4g} {unit}/s" for unit, rate in named if rate)
    text = f"{row['name']}: {row['median']:,.4g} [{row['min']:,.4g}, {row['max']:,.4g}] {row['unit']}".rstrip()
    if row["kind"] == "goal":
        bound = f">= {row['at_least']:g}" if row["at_least"] is not None else f"<= {row['at_most']:g}"
        return f"goal {row['number']}, {text}; want {bound}: {'met' if rounds.met(row) else 'missed'}"
    return text if row["x"] is None else f"{text} at {row['x']:,.0f} {row['x_unit']}"


if __name__ == "__main__":
    sys.exit(main())
