"""What runs take: gradient steps, environment steps, episodes, and hours by the records of runs on this machine."""

import statistics
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gvz.core import records
from gvz.core.files import files_below
from gvz.experiments import inventory
from gvz.experiments.base import TrainingRun
from gvz.experiments.plan import Evaluation
from gvz.experiments.scale import CHECK_BELOW, scaled_settings
from gvz.run.config_files import load_config
from gvz.run.machine import cpu_model
from gvz.run.rundir import EVALUATION_RECORDS, START_RECORDS
from gvz.tasks import scenario_named

NEWEST_RUNS = 3
"""whose rates are read; older ones say little more"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Rates:
    """What one job did a second on this machine; None where there is no record of it."""

    updates_per_s: float | None
    """gradient steps, with the decisions they need"""
    evaluation_steps_per_s: float | None
    """decisions of evaluation episodes, the start of the command included"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Cost:
    """Of a run or of several."""

    updates: int = 0
    env_steps: int = 0
    """decisions in training"""
    episodes: int = 0
    """of evaluation"""
    training_hours: float | None = 0.0
    """of one job at a time; None: a rate is not known"""
    evaluation_hours: float | None = 0.0
    """at most: every episode goes on to its time-out"""

    def __add__(self, other: "Cost") -> "Cost":
        both: dict[str, Any] = {}
        for name in Cost.__dataclass_fields__:
            one, two = getattr(self, name), getattr(other, name)
            both[name] = None if one is None or two is None else one + two
        return Cost(**both)


def read_rates(results: Path, agent: str, scale: float, num_cores: int) -> Rates:
    """The rates of a config or of its variant (`TrainingRun.agent`), by jobs with this number of cores at this scale.

    They are of the newest runs of a results directory and of the trainer's own default directory. Only runs that were
    started on a processor like this machine's, with as many cores, count.
    """
    planned = results / "runs"
    folders = [planned / agent]
    if scale >= CHECK_BELOW and "+" not in agent:  # a check has other networks; the trainer has no runs of variants
        folders.append(load_config(agent).resolved_run_dir.parent)
    starts = [file for folder in folders for file in files_below(folder, f"{START_RECORDS}*")]
    runs = [file.parent for file in starts if _is_of_this_machine(file, num_cores)]
    runs = sorted(runs, key=lambda run: run.stat().st_mtime)[-NEWEST_RUNS:]
    updates = [rate for run in runs for rate in _numbers(run / "metrics.jsonl", "learner/updates_per_s") if rate > 0]
    logs = {run: inventory.log_file(results, str(run.relative_to(planned))) for run in runs if planned in run.parents}
    seconds = {run: inventory.seconds_of(log, "evaluate") for run, log in logs.items()}
    evaluated = [run for run in runs if seconds.get(run)]
    steps = sum(sum(_numbers(run / EVALUATION_RECORDS, "length_steps")) for run in evaluated)
    return Rates(
        updates_per_s=statistics.median(updates) if updates else None,
        evaluation_steps_per_s=steps / sum(seconds.values()) if steps else None,
    )


def _is_of_this_machine(starts: Path, num_cores: int) -> bool:
    rows, _ = records.read(starts)
    return bool(rows) and (rows[-1].get("cpu"), rows[-1].get("cores")) == (cpu_model(), num_cores)


def _numbers(file: Path, field: str) -> list[float]:
    rows, _ = records.read_stored(file)
    return [row[field] for row in rows if isinstance(row.get(field), int | float)]


def run_cost(run: TrainingRun, evaluation: Evaluation, scale: float, rates: Rates, num_cores: int) -> Cost:
    """What training and evaluating a run takes, with jobs of so many cores.

    Of a run that ends by its processor time the gradient steps are the most that it may do, and the hours those in
    which it keeps all its cores busy.
    """
    config = run.run_config
    warmup = scaled_settings(config, run.total_updates, scale).get("learner.warmup_steps", config.learner.warmup_steps)
    per_update = config.env_steps_per_update
    episodes = len(evaluation.tasks) * evaluation.episodes * run.num_checkpoints
    timeout_steps = scenario_named(run.scenario).timeout_frames(config.env.profile) // config.env.frame_skip
    # warm-up has no updates, so its decisions come no slower than those beside updates
    updates = run.total_updates + warmup / per_update
    return Cost(
        updates=run.total_updates,
        env_steps=warmup + round(per_update * run.total_updates),
        episodes=episodes,
        training_hours=_hours(updates, rates.updates_per_s)
        if run.max_processor_s is None
        else run.max_processor_s / num_cores / 3600,
        evaluation_hours=_hours(episodes * timeout_steps, rates.evaluation_steps_per_s),
    )


def _hours(count: float, per_s: float | None) -> float | None:
    return None if per_s is None else count / per_s / 3600
