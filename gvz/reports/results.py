"""What a report is made of: evaluation episodes, training runs and plans, read from results directories.

Reads records, never checkpoints.
"""

import dataclasses
import itertools
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import polars as pl

from gvz.core import records
from gvz.core.errors import ConfigError
from gvz.evaluation.dataset import collect_evaluations, fits
from gvz.experiments.base import Experiment
from gvz.experiments.inventory import PROCESSOR_S
from gvz.experiments.plan import read_plan
from gvz.run.resume import may_change
from gvz.tasks import TrainingSet, all_scenarios, named_tasks

EACH = "each task alone"
"""training of agents each of which was trained on one task"""

TRAINING_SETS: dict[TrainingSet, str] = {
    "train1": "1 task",
    "train4": "4 tasks",
    "train8": "8 tasks",
    "pairs": "8 tasks and pairs",
    "compositions": "8 tasks and compositions",
}
"""what to call a training set: "4 tasks" for train4"""


ONE_RUN = ("run_dir", "run", "run_seed", "scenario")
"""columns of episodes that tell trained agents apart: a record file, and so its directory, may have several"""


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
    def curriculum(self) -> str:
        """How tasks were given to games; older runs had no choice."""
        lessons = self.config.get("curriculum")
        return str(lessons.get("kind", "fixed")) if isinstance(lessons, dict) else "fixed"

    @property
    def total_updates(self) -> int:
        return int(self.config["learner"]["total_updates"])

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


@dataclass(frozen=True, kw_only=True, slots=True)
class PlannedExperiment:
    """An experiment that a results directory was planned for."""

    results: Path
    experiment: Experiment
    scale: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Results:
    """Everything readable in some results directories."""

    paths: tuple[Path, ...]
    episodes: pl.DataFrame
    """`gvz.evaluation.dataset`'s columns, with `agent` (who played, without seed and checkpoint) and `final` (of one of
    the last quarter of the run's evaluated checkpoints, by which agents are compared)"""
    runs: tuple[Run, ...]
    agents: dict[str, str]
    """run directory -> the agent its rows belong to"""
    asked: tuple[PlannedExperiment, ...]
    problems: tuple[str, ...]


def read_results(paths: Sequence[Path]) -> Results:
    """Reads results directories, run directories and record files, in any mixture.

    Raises:
        ConfigError: a path does not exist.
    """
    episodes, problems = collect_evaluations(paths)
    episodes, of_other_seeds = _of_one_base_seed(episodes)
    problems += of_other_seeds
    runs: dict[Path, Run] = {}
    asked = []
    for path in paths:
        for config in sorted(path.rglob("config.json")) if path.is_dir() else []:
            of_group = (config.resolve().parents[1] / "config.json").exists()  # a further learner process of that run
            if config.parent.resolve() not in runs and "discarded" not in config.parts and not of_group:
                run, found = _read_run(config, path)
                problems += found
                if run is not None:
                    runs[config.parent.resolve()] = run
        for file in sorted(path.rglob("plan.json")) if path.is_dir() else []:
            try:
                plan = read_plan(file.parent)
            except ConfigError as error:
                problems.append(f"{error}; its experiments are not in this report")
                continue
            assert plan is not None, "the file is there"
            asked += [
                PlannedExperiment(results=file.parent, experiment=e, scale=plan.scale) for e in plan.experiments()
            ]
    evaluated = {path: set(rows["task"]) for (path,), rows in episodes.group_by("run_dir")}
    for run in runs.values():
        if str(run.path) not in evaluated:
            problems.append(f"{run.path}: no evaluation of this run yet; make one with `gvz evaluate {run.path}`")
    agents = _agents(list(runs.values()), evaluated)
    problems += _pooled(list(runs.values()), agents, evaluated)
    return Results(
        paths=tuple(paths),
        episodes=_with_agents(episodes, agents),
        runs=_with_unique_ids(list(runs.values())),
        agents=agents,
        asked=tuple(asked),
        problems=tuple(problems),
    )


def _read_run(file: Path, results: Path) -> tuple[Run | None, list[str]]:
    """The run, if it can be read, and what is wrong with it."""
    metrics, problems = _read_columns(file.parent / "metrics.jsonl", _METRICS)
    episodes, more = _read_columns(file.parent / "episodes.jsonl", _TRAINING_EPISODES)
    starts, unread = _read_starts(file.parent / "starts.jsonl")
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
            # records of older versions have scores above the bound where enemies kill each other
            training_episodes=episodes.filter(~pl.col("cut")).with_columns(
                pl.col("normalized_score").clip(upper_bound=100)
            ),
            starts=tuple(starts),
        )
        _ = run.name, run.seed, run.total_updates, run.training, run.curriculum
    except (OSError, ValueError, KeyError, TypeError, IndexError, OverflowError, RecursionError) as error:
        return None, [f"{file}: not a configuration of ours ({type(error).__name__}: {error}); the run is left out"]
    return run, [*problems, *more, *unread]


def _run_id(directory: Path, results: Path) -> str:
    inside = directory.relative_to(results).parts
    return "/".join(inside[1:] if inside[:1] == ("runs",) else inside) or directory.resolve().name


def _with_unique_ids(runs: Sequence[Run]) -> tuple[Run, ...]:
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


def _of_one_base_seed(episodes: pl.DataFrame) -> tuple[pl.DataFrame, list[str]]:
    """The episodes of the smallest base seed, by which agents are compared, and what is left out."""
    kept = episodes.filter(pl.col("base_seed") == pl.col("base_seed").min())
    if len(kept) == len(episodes):
        return episodes, []
    left_out = len(episodes) - len(kept)
    return kept, [
        f"{left_out} evaluation episodes of other base seeds than {kept['base_seed'][0]} are left out: they are other "
        "episodes, and `gvz evaluate` prints their scores"
    ]


@cache
def _task_ids(scenario: str, split: TrainingSet) -> set[str]:
    return {task.id for task in named_tasks(scenario, split=split)} if scenario in all_scenarios() else set()


def _agents(runs: Sequence[Run], evaluated: Mapping[object, set[str]]) -> dict[str, str]:
    """Run directory -> agent: the configuration's name, and what it was trained on where that tells agents apart.

    Runs that were each trained on one task, and were evaluated on no common one, are one agent (EACH).

    Args:
        runs: of any configurations.
        evaluated: run directory -> ids of the tasks that it was evaluated on.
    """
    alone: dict[tuple[str, tuple[str, ...]], dict[str, set[str]]] = {}
    for run in runs:
        if len(run.tasks) == 1:
            played = alone.setdefault((run.name, run.scenarios), {}).setdefault(run.training, set())
            if not _is_of_a_set(run):
                played |= evaluated.get(str(run.path), set())

    def training(run: Run) -> str:
        if len(run.tasks) > 1 or _is_of_a_set(run):
            return run.training
        played = alone[run.name, run.scenarios].values()
        apart = sum(map(len, played)) == len(set().union(*played))
        return EACH if apart and len(played) > 2 else run.training  # more than default and one other

    trainings = {name: {training(run) for run in runs if run.name == name} for name in {run.name for run in runs}}
    settings = _telling_settings(runs)
    words = {
        run.path: [training(run)] * (len(trainings[run.name]) > 1)
        + settings.get(run.path, []) * (not _is_of_a_set(run))
        for run in runs
    }
    return {
        str(run.path): f"{run.name} ({', '.join(words[run.path])})" if words[run.path] else run.name for run in runs
    }


def _telling_settings(runs: Sequence[Run]) -> dict[Path, list[str]]:
    """ "agent.discount 0.5": settings in which runs of one name on the same tasks differ, of each of these runs.

    Left out are settings that change nothing (`gvz.run.resume`), numbers of actors and games, and those that the other
    run lacks: it is of an older version.
    """
    alike: dict[tuple[str, tuple[str, ...]], list[Run]] = {}
    for run in runs:
        alike.setdefault((run.name, run.tasks), []).append(run)
    found: dict[Path, list[str]] = {}
    for group in alike.values():
        values = [dict(_settings(run.config, run.scenarios)) for run in group]
        for name in values[0]:
            own = [of_run.get(name) for of_run in values]
            if None not in own and len(set(own)) > 1:
                for run, value in zip(group, own, strict=True):
                    found.setdefault(run.path, []).append(f"{name} {value}")
    return found


def _settings(config: Mapping[str, Any], scenarios: Sequence[str], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Dotted names and values, in JSON, of what may tell agents of these scenarios apart."""
    for name, value in config.items():
        if isinstance(value, dict):
            yield from _settings(value, scenarios, f"{prefix}{name}.")
        elif name == "reward_weights" and isinstance(value, list):
            yield (
                prefix + name,
                json.dumps([pair for pair in value if any(f"{scenario}." in str(pair) for scenario in scenarios)]),
            )
        elif not (may_change(prefix + name) or prefix + name in _TELL_NOTHING):
            yield prefix + name, json.dumps(value)


_TELL_NOTHING = ("seed", "scenario", "training_set", "tasks", "actors.num_actors", "actors.games_per_actor")


def _pooled(runs: Sequence[Run], agents: Mapping[str, str], evaluated: Mapping[object, set[str]]) -> list[str]:
    """What a reader would not expect to be put together: an agent's runs of other settings, and of one seed."""
    settings, problems = _telling_settings(runs), []
    by_agent: dict[str, list[Run]] = {}
    for run in runs:
        by_agent.setdefault(agents[str(run.path)], []).append(run)
    for agent, of_agent in by_agent.items():
        problems += [
            f"{run.path}: put together with other runs of {agent}, which have another {', '.join(settings[run.path])}"
            for run in of_agent
            if _is_of_a_set(run) and run.path in settings
        ]
        for one, other in itertools.combinations(of_agent, 2):
            both = evaluated.get(str(one.path), set()) & evaluated.get(str(other.path), set())
            if one.seed == other.seed and one.tasks == other.tasks and both:
                problems.append(
                    f"{other.path}: the same agent and training seed as {one.path}; their episodes are put together as "
                    "if they were of one run; leave one out"
                )
    return problems


def _is_of_a_set(run: Run) -> bool:
    """An experiment has trained it on a training set, if only of one task."""
    return "/train" in run.id


def _with_agents(episodes: pl.DataFrame, agents: dict[str, str]) -> pl.DataFrame:
    """Adds the columns `agent` and `final`."""
    named = pl.col("run_dir").replace_strict(agents, default=pl.col("run"), return_dtype=pl.String)
    age = pl.col("num_updates").rank("dense", descending=True)  # 1: the newest checkpoint
    num_checkpoints = pl.col("num_updates").n_unique()
    final = (age <= (num_checkpoints / 4).ceil()).over(ONE_RUN).fill_null(value=True)
    agent = pl.coalesce(named, "player")
    return episodes.with_columns(agent=agent, final=final).with_columns(agent=pl.concat_str("agent", *_other_rules()))


def _other_rules() -> list[pl.Expr]:
    """ " (levdoom)" for rows of an agent that played by several rules, for each kind of rule; else nothing."""
    return [
        pl.when(pl.col(rule).drop_nulls().n_unique().over("agent") > 1)
        .then(pl.format(" ({})", pl.col(rule).fill_null("unknown " + rule)))
        .otherwise(pl.lit(""))
        for rule in ("profile", "action_set")
    ]


_METRICS = {
    "num_updates": pl.Int64(),
    "time_s": pl.Float64(),
    "learner/updates_per_s": pl.Float64(),
    "actors/decisions_per_s": pl.Float64(),
    "actors/frames_per_s": pl.Float64(),
    "actors/env_steps": pl.Int64(),
    "actors/restarts": pl.Int64(),
    PROCESSOR_S: pl.Float64(),
}
_TRAINING_EPISODES = {
    "num_updates": pl.Int64(),
    "task": pl.String(),
    "score": pl.Float64(),
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
