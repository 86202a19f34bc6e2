"""How fast this machine trains and evaluates: measured by really doing it for a short while, and remembered."""

import dataclasses
import hashlib
import json
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from gvz.core import janitor
from gvz.core.cache import cache_directory
from gvz.core.errors import GvzError
from gvz.experiments import inventory as progress
from gvz.experiments.base import TrainingRun
from gvz.experiments.jobs import Command, RunJob, RunningJob, Slot
from gvz.experiments.plan import Evaluation
from gvz.experiments.scale import CHECK_BELOW, CHECK_SETTINGS
from gvz.run.config import config_to_dict, load_config
from gvz.run.machine import cpu_model
from gvz.run.rundir import read_records

MEASURE_S = 20.0
"""of updates, and again of evaluation"""
START_TIMEOUT_S = 600.0
"""longest wait for a run's first updates, or for the first evaluation episode"""
POLL_S = 0.25

Show = Callable[[str, float], None]
"""told what is being measured, and for how many of MEASURE_S it has been"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Rates:
    """What one job in one slot does a second while the others rest."""

    updates_per_s: float
    """gradient steps, with the decisions they need"""
    evaluation_steps_per_s: float
    """decisions of evaluation episodes"""
    measured: str
    """when"""


def rates_file(config: str, scale: float, slot: Slot) -> Path:
    """Where the rates of a config on such a share of this machine are remembered."""
    sizes = CHECK_SETTINGS if scale < CHECK_BELOW else {}
    what = [config_to_dict(load_config(config))["config"], sizes, _machine(), len(slot.cores), slot.environment]
    digest = hashlib.blake2b(json.dumps(what, sort_keys=True).encode(), digest_size=8).hexdigest()
    return cache_directory() / "rates" / f"{config}-{digest}.json"


def read_rates(file: Path) -> Rates | None:
    """Rates measured before; None if there are none."""
    try:
        return Rates(**json.loads(file.read_text()))
    except (OSError, ValueError, TypeError):  # none, or not as this version writes them: measured anew
        return None


def measure(run: TrainingRun, scale: float, slot: Slot, show: Show) -> Rates:
    """Trains the run's config for MEASURE_S in a directory of its own, evaluates it as long, and remembers the rates.

    Args:
        run: whose config and tasks are measured.
        scale: of the plan.
        slot: the share of the machine a job will have.
        show: told how far it is.

    Raises:
        GvzError: it did not start, or did too little; has the end of its log.
    """
    with janitor.temporary_directory("rates") as folder:
        endless = dataclasses.replace(run, total_updates=10**9, num_checkpoints=1)
        many = Evaluation(tasks=run.tasks, episodes=1000)
        job = RunJob(results=folder, run=endless, evaluation=many, scale=scale)
        directory = progress.run_directory(job.results, endless)
        # a full warm-up and replay would take minutes, and change no rate
        small = ("--learner.warmup-steps", "2048", "--replay.capacity", "16384", "--log.period-updates", "2")
        train = Command(step="train", arguments=(*job.train_arguments(), *small), total=0)
        updates_per_s = _rate(job, train, slot, lambda: progress.last_update(directory), show)
        evaluate = Command(
            step="evaluate", arguments=job.evaluate_arguments(progress.policies(directory)[-1:]), total=0
        )
        steps_per_s = _rate(job, evaluate, slot, lambda: _steps_played(directory / "evaluation.jsonl"), show)
    rates = Rates(
        updates_per_s=updates_per_s,
        evaluation_steps_per_s=steps_per_s,
        measured=time.strftime("%Y-%m-%d %H:%M"),
    )
    file = rates_file(run.config, scale, slot)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(dataclasses.asdict(rates)) + "\n")
    return rates


def _rate(job: RunJob, command: Command, slot: Slot, count: Callable[[], int], show: Show) -> float:
    """Counts a second while a command is at work, from the first count on; the command is then stopped.

    Raises:
        GvzError: it ended, or stood still for START_TIMEOUT_S, before there was anything to measure.
    """
    running = RunningJob.start(job, command, slot)
    assert running is not None, "nobody else knows this directory"
    seen: list[tuple[float, int]] = []  # (time, count) of every change
    now = started_s = time.monotonic()
    try:
        while running.poll() is None:
            now, counted = time.monotonic(), count()
            if counted > (seen[-1][1] if seen else 0):
                seen.append((now, counted))
            if len(seen) > 2 and now - seen[0][0] > MEASURE_S:
                break
            if now - (seen[-1][0] if seen else started_s) > START_TIMEOUT_S:
                break
            show(f"{job.run.config}: {command.step}", now - seen[0][0] if seen else 0.0)
            time.sleep(POLL_S)
        running.stop()
        while running.poll() is None and time.monotonic() < now + START_TIMEOUT_S:
            time.sleep(POLL_S)
    finally:
        running.kill()
    if len(seen) < 3:
        words = "\n".join(progress.last_words(progress.log_file(job.results, job.id), 10))
        raise GvzError(f"measuring {job.run.config}: {command.step} did too little to be measured; it said:\n{words}")
    (first_s, first), (last_s, last) = seen[0], seen[-1]
    return (last - first) / (last_s - first_s)


def _steps_played(file: Path) -> int:
    """Decisions of the episodes in a record file."""
    if not file.exists():
        return 0
    rows, _ = read_records(file)
    return sum(row["length_steps"] for row in rows)


def _machine() -> list[str]:
    """What the rates of this machine depend on."""
    return [platform.node(), cpu_model()]
