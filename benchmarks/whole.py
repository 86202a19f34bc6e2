"""`rainbow_4task` as a whole: learner and actors together against each alone, first gradient step, memory, staleness.

The run is the real command with fewer gradient steps. It alternates with the learner alone (full replay, no actors) and
the actors alone (full network acting, drained, no learner). The run's gradient steps and decisions are divided by the
rates of each alone; goal: the two shares add up to 0.9 or more. The processor times of a gradient step and a decision,
together and alone, explain the difference. The memory of all processes has its peak at the last checkpoint; goal: it is
within 10% of the bill that the run prints.
"""

import contextlib
import json
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import psutil

from actors.placement import give_back
from benchmarks import workload
from benchmarks.rounds import Budget, Row, goal, measured, rates

_RUN_TIMEOUT_S = 800.0
_MEASURED_UPDATES, _LOG_PERIOD_UPDATES = 260, 20
"""gradient steps of a run, and between two rows of its metrics; rates count from the first row on"""
_MEMORY_PERIOD_S, _PROCESSOR_PERIOD_S, _QUICK_PERIOD_S = 0.25, 2.0, 0.05
"""seconds between two samples of a run's processes; a quick run takes less than a second"""


def measure(budget: Budget) -> list[Row]:
    """Alternates the run, the learner alone and the actors alone."""
    import jax

    config = workload.four_task_config(budget)
    num_runs, updates, period = (1, 400, 100) if budget.quick else (3, _MEASURED_UPDATES, _LOG_PERIOD_UPDATES)
    memory_period_s, processor_period_s = (
        (_QUICK_PERIOD_S, _QUICK_PERIOD_S) if budget.quick else (_MEMORY_PERIOD_S, _PROCESSOR_PERIOD_S)
    )
    body_s = 4 * budget.body_s
    with tempfile.TemporaryDirectory(prefix="gvz-benchmark-") as directory, workload.assembled(config) as parts:
        firsts, runs, learner_alone, actors_alone = [], [], [], []
        costs: defaultdict[str, list[float]] = defaultdict(list)
        for number in range(num_runs):
            firsts.append(run_command(Path(directory) / f"first_{number}", budget, 1, 1, memory_period_s, tree_bytes))
            runs.append(
                run_command(Path(directory) / f"run_{number}", budget, updates, period, processor_period_s, _processor)
            )
            learner = workload.Learner(config, parts)
            learn = partial(learner.updates_per_s, learner.sizes.num_updates_per_call)
            learn(0.0)  # compiles
            updates_per_s, cost = workload.processor_costs(partial(learn, body_s))
            learner_alone.append(updates_per_s)
            costs["gradient step, learner alone"].append(cost["learner's side"])
            params = learner.acting_params()
            del learner, learn  # frees its replay, so that the next run has the whole machine
            with workload.playing(parts.pool_config, params) as pool:
                play = partial(workload.decisions_per_s, pool, body_s)
                decisions_per_s, cost = workload.processor_costs(play)
            actors_alone.append(decisions_per_s)
            costs["decision, actors alone"].append(cost["Python"] + cost["engines"])
    together = [run_rates(run["rows"]) for run in runs]
    updates_per_s, decisions_per_s = [u for u, _ in together], [d for _, d in together]
    shares = [
        u / alone_u + d / alone_d
        for (u, d), alone_u, alone_d in zip(together, learner_alone, actors_alone, strict=True)
    ]
    ages = {
        name: [
            summed([row[f"actors/staleness_{name}_versions"] for row in run["rows"][1:]])
            * config.learner.publish_period_updates
            for run in runs
        ]
        for name, summed in (("mean", statistics.fmean), ("p95", statistics.median), ("max", max))
    }
    bill, batch_size = parts.footprint.memory_bytes, parts.learner.batch_size
    peaks = [max(run["seen"]) for run in firsts]
    cores = [_cores(run) for run in runs]
    for found, (u, d) in zip(cores, together, strict=True):
        costs["gradient step, the run"].append(found["learner's side"] / u)
        costs["decision, the run"].append((found["Python"] + found["engines"]) / d)
    on = "" if jax.default_backend() == "cpu" else f" on a {jax.default_backend()}"
    return [
        rates(
            f"the run, both together{on}",
            decisions_per_s=decisions_per_s,
            updates_per_s=updates_per_s,
            batch_size=batch_size,
        ),
        rates(f"learner alone{on}", updates_per_s=learner_alone, batch_size=batch_size),
        rates("actors alone, full network", decisions_per_s=actors_alone),
        goal(6, "useful work of both together, against each alone", shares, at_least=0.9, unit="x"),
        measured("from the command to the first gradient step", "s", [run["first_row_s"] for run in firsts]),
        measured("peak of the memory of all processes", "GB", [peak / 1e9 for peak in peaks]),
        measured("memory on the bill", "GB", [bill / 1e9]),
        goal(6, "peak memory off the bill", [abs(p / bill - 1) for p in peaks], at_most=0.1, unit="x"),
        *(measured(f"processor time a {name}", "ms", [1e3 * cost for cost in found]) for name, found in costs.items()),
        measured("cores at work in the run", "cores", [sum(found.values()) for found in cores]),
        *(measured(f"age of the acting parameters, {name}", "gradient steps", found) for name, found in ages.items()),
    ]


def run_command(
    directory: Path,
    budget: Budget,
    updates: int,
    log_period: int,
    look_period_s: float,
    look: Callable[[int], Any],
    *further: str,
) -> dict[str, Any]:
    """One run of the real command: its rows of metrics, seconds from the command to the first, and `look`'s samples.

    `further` are flags. `look` is called with the process's id, only from the first row on, because sampling slows the
    process down.
    """
    give_back()  # the cores of this process's own parts: the run has the machine to itself
    flags = ["--learner.total-updates", str(updates), "--log.period-updates", str(log_period)]
    flags += [*workload.quick_flags(budget), *further]
    command = [sys.executable, "-m", "gvz.launch", "--config", "rainbow_4task.py", "--run-dir", str(directory), *flags]
    records, seen, start = directory / "metrics.jsonl", [], time.time()
    with tempfile.TemporaryFile() as output:
        process = subprocess.Popen(command, stdout=output, stderr=output)
        try:
            while process.poll() is None:
                if time.time() - start > _RUN_TIMEOUT_S:
                    raise TimeoutError(f"{' '.join(command)}: no end within {_RUN_TIMEOUT_S:.0f} s")
                if records.exists():
                    with contextlib.suppress(psutil.NoSuchProcess):
                        seen.append(look(process.pid))
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(look_period_s)
        finally:
            end_run(process)
        output.seek(0)
        if process.returncode != 0:
            raise RuntimeError(f"{' '.join(command)}: exit code {process.returncode}: {output.read().decode()[-2000:]}")
    rows = [json.loads(line) for line in records.read_text().splitlines()]
    shutil.rmtree(directory)  # its checkpoint is as large as its replay
    return {"rows": rows, "seen": seen, "first_row_s": rows[0]["time_s"] - start}


def _processor(pid: int) -> tuple[float, dict[str, float]]:
    """The present time, as in records, and the processor seconds of a run so far."""
    return time.time(), workload.processor_s(pid)


def _cores(run: dict[str, Any]) -> dict[str, float]:
    """Processor seconds per second between the first and the last row of a run, by kind of process."""
    looks = [look for look in run["seen"] if look[0] <= run["rows"][-1]["time_s"]]
    (begin_s, before), (end_s, after) = looks[0], looks[-1]
    return {where: (after[where] - before[where]) / (end_s - begin_s) for where in before}


def end_run(process: "subprocess.Popen[bytes]") -> None:
    """Ends an unfinished run: Ctrl-C twice stops it at once with its actors and engines."""
    for _ in range(2):
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(5.0)
    if process.poll() is None:
        process.kill()
        process.wait()


def run_rates(rows: list[dict[str, Any]]) -> tuple[float, float]:
    """Gradient steps and decisions a second, from the first row to the last."""
    first, last = rows[0], rows[-1]
    seconds = last["time_s"] - first["time_s"]
    updates, decisions = (last[name] - first[name] for name in ("num_updates", "actors/env_steps"))
    return updates / seconds, decisions / seconds


def tree_bytes(pid: int) -> int:
    """Sum of the proportional set sizes of a process and its descendants, bytes."""
    total = 0
    with contextlib.suppress(psutil.NoSuchProcess):
        process = psutil.Process(pid)
        for each in (process, *process.children(recursive=True)):
            with contextlib.suppress(psutil.NoSuchProcess, psutil.AccessDenied, OSError):
                smaps = Path(f"/proc/{each.pid}/smaps_rollup").read_text()
                total += sum(int(line.split()[1]) for line in smaps.splitlines() if line.startswith("Pss:")) * 1024
    return total
