"""Run directories of the trainer as a report sees them: configuration, tasks and records; never checkpoints."""

import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import polars as pl

from gvz.core import records
from gvz.evaluation.dataset import fits
from gvz.experiments.base import budget_text
from gvz.experiments.inventory import PROCESSOR_S
from gvz.run.rundir import START_RECORDS
from gvz.tasks import TrainingSet, all_scenarios, named_tasks

TRAINING_SETS: dict[TrainingSet, str] = {
    "train1": "1 task",
    "train4": "4 tasks",
    "train8": "8 tasks",
    "pairs": "8 tasks and pairs",
    "compositions": "8 tasks and compositions",
    "train8_varied": "8 tasks, also on varied maps",
}
"""what to call a training set: "4 tasks" for train4"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Run:
    """A run directory of the trainer."""

    path: Path
    id: str
    """its path under runs/, else its directory's name; with more of its path where two would be the same"""
    config: dict[str, Any]
    """the configuration, as saved"""
    tasks: tuple[str, ...]
    """ids of the tasks trained on"""
    metrics: pl.DataFrame
    """rates by gradient steps"""
    training_episodes: pl.DataFrame
    """task, score and gradient steps of every finished training episode"""
    starts: tuple[dict[str, Any], ...]
    """rows of starts.jsonl: the machine, versions and commit of each start; none in a run of an older version"""

    @property
    def name(self) -> str:
        return str(self.config["name"])

    @property
    def seed(self) -> int:
        return int(self.config["seed"])

    @property
    def settings(self) -> dict[str, Any]:
        """Dotted name of each field of the configuration -> its value."""
        return dict(_leaves(self.config))

    @property
    def curriculum(self) -> str:
        """How tasks were given to games; older runs had no choice."""
        lessons = self.config.get("curriculum")
        return str(lessons.get("kind", "fixed")) if isinstance(lessons, dict) else "fixed"

    @property
    def total_updates(self) -> int:
        return int(self.config["learner"]["total_updates"])

    @property
    def budget(self) -> str:
        """In words; older runs have no limit of processor time."""
        limit_s = self.config.get("max_processor_s")
        return budget_text(self.total_updates, limit_s if isinstance(limit_s, int | float) else None)

    @property
    def processor_s(self) -> float | None:
        """Processor time of the run, seconds; None in records of older versions."""
        return None if self.metrics.is_empty() else self.metrics[PROCESSOR_S][-1]

    @property
    def ended(self) -> bool:
        """It has had all its gradient steps, or all its processor time."""
        if self.metrics.is_empty():
            return False
        limit_s, used_s = self.config.get("max_processor_s"), self.processor_s
        used_up = isinstance(limit_s, int | float) and used_s is not None and used_s >= limit_s
        return used_up or self.metrics["num_updates"][-1] >= self.total_updates

    @property
    def scenarios(self) -> tuple[str, ...]:
        """Ids of the scenarios of its tasks."""
        return tuple(dict.fromkeys(task.partition("/")[0] for task in self.tasks))

    @property
    def training(self) -> str:
        """ "4 tasks", "gore alone": what it was trained on, in words."""
        for split, words in TRAINING_SETS.items():
            if set(self.tasks) == set().union(*(_task_ids(one, split) for one in self.scenarios)):
                return words if len(self.scenarios) == 1 else f"{words} of each scenario"
        names = [task.partition("/")[2] for task in self.tasks]
        return f"{names[0]} alone" if len(names) == 1 else f"{len(names)} chosen tasks: {', '.join(names)}"


def _leaves(config: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in config.items():
        if isinstance(value, dict):
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def read_run(file: Path, results: Path) -> tuple[Run | None, list[str]]:
    """The run, if it can be read, and what is wrong with it."""
    metrics, problems = _read_columns(file.parent / "metrics.jsonl", _METRICS)
    episodes, more = _read_columns(file.parent / "episodes.jsonl", _TRAINING_EPISODES)
    starts, unread = _read_starts(file.parent / START_RECORDS)
    try:
        saved = json.loads(file.read_text())
        json.dumps(saved, ensure_ascii=False).encode()  # text that no file can hold has no place in a report
        if not isinstance(saved["resolved"]["tasks"], list):
            raise TypeError("resolved.tasks: want a list")
        run = Run(
            path=file.parent,
            id=_run_id(file.parent, results),
            config=saved["config"],
            tasks=tuple(map(str, saved["resolved"]["tasks"])),
            metrics=metrics,
            training_episodes=episodes.filter(~pl.col("cut")),
            starts=tuple(starts),
        )
        _ = run.name, run.seed, run.total_updates, run.training, run.curriculum
    except (OSError, ValueError, KeyError, TypeError, IndexError, OverflowError, RecursionError) as error:
        return None, [f"{file}: not a configuration of ours ({type(error).__name__}: {error}); the run is left out"]
    return run, [*problems, *more, *unread]


def _run_id(directory: Path, results: Path) -> str:
    inside = directory.relative_to(results).parts
    return "/".join(inside[1:] if inside[:1] == ("runs",) else inside) or directory.resolve().name


def with_unique_ids(runs: Sequence[Run]) -> tuple[Run, ...]:
    """Runs whose ids are the same get as much more of their paths as tells them apart."""
    parts = {run.path: run.path.resolve().parts for run in runs}
    unique = []
    for run in runs:
        others = [parts[other.path] for other in runs if other.id == run.id and other.path != run.path]
        mine, length = parts[run.path], run.id.count("/") + 1
        while others and any(other[-length:] == mine[-length:] for other in others):
            length += 1
        unique.append(dataclasses.replace(run, id="/".join(mine[-length:])) if others else run)
    return tuple(unique)


@cache
def _task_ids(scenario: str, split: TrainingSet) -> set[str]:
    return {task.id for task in named_tasks(scenario, split=split)} if scenario in all_scenarios() else set()


_METRICS = {
    "num_updates": pl.Int64(),
    "learner/updates_per_s": pl.Float64(),
    "actors/decisions_per_s": pl.Float64(),
    "actors/frames_per_s": pl.Float64(),
    "actors/env_steps": pl.Int64(),
    PROCESSOR_S: pl.Float64(),
}
_TRAINING_EPISODES = {
    "num_updates": pl.Int64(),
    "task": pl.String(),
    "normalized_score": pl.Float64(),
    "cut": pl.Boolean(),
}


def _read_columns(file: Path, columns: Mapping[str, pl.DataType]) -> tuple[pl.DataFrame, list[str]]:
    """These columns of a run's record file; rows without `num_updates` are left out, and values of other types."""
    rows, problems = records.read_stored(file)
    values = {c: [v if fits(v := row.get(c), dtype) else None for row in rows] for c, dtype in columns.items()}
    return pl.DataFrame(values, columns).drop_nulls("num_updates"), problems


_START_TYPES = {
    "cpu": str,
    "system": str,
    "commit": str,
    "cores": int,
    "memory_bytes": int,
    "devices": list,
    "versions": dict,
}


def _read_starts(file: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """What a run was started on, and what is wrong with it."""
    rows, problems = records.read_stored(file)
    good = []
    for number, row in enumerate(rows, 1):
        try:
            json.dumps(row, ensure_ascii=False).encode()
            for name, kind in _START_TYPES.items():
                value = row.get(name)
                if not isinstance(value, kind | None) or (isinstance(value, int) and not fits(value, pl.Int64())):
                    raise TypeError(f"{name} is {value!r:.80}")
        except (ValueError, TypeError, RecursionError) as error:
            problems.append(f"{file}, row {number}: not the start of a run ({error})")
        else:
            good.append(row)
    return good, problems


def training_time_s(metrics: pl.DataFrame) -> float:
    """Seconds a run spent training, by the rates in its metrics: pauses between its processes do not count."""
    rates = metrics.filter(pl.col("learner/updates_per_s") > 0)
    steps = pl.col("num_updates").diff(null_behavior="ignore").fill_null(pl.col("num_updates"))
    return rates.select((steps / pl.col("learner/updates_per_s")).sum()).item()
