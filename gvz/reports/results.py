"""What a report is made of: evaluation episodes, training runs and plans, read from results directories.

Reads records, never checkpoints.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import polars as pl

from gvz.core.errors import ConfigError
from gvz.core.files import files_below
from gvz.evaluation.dataset import collect_evaluations, is_in_folder_of_run
from gvz.experiments.base import Experiment
from gvz.experiments.plan import read_plan
from gvz.reports.agents import agents_of_runs, pooled_runs, with_agents
from gvz.reports.runs import Run, read_run, with_unique_ids


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
    # what two of them hold is read from the outer one, whose other parts are then named alike
    from_outside = sorted(paths, key=lambda path: (path.is_file(), len(path.resolve().parts)))
    episodes, problems = collect_evaluations(from_outside)
    episodes, of_other_seeds = _of_one_base_seed(episodes)
    problems += of_other_seeds
    runs: dict[Path, Run] = {}
    asked: dict[Path, list[PlannedExperiment]] = {}
    for path in from_outside:
        for config in files_below(path, "config.json"):
            of_group = (config.resolve().parents[1] / "config.json").exists()  # a further learner process of that run
            discarded = is_in_folder_of_run(config, path, ("discarded",))
            if config.parent.resolve() not in runs and not discarded and not of_group:
                run, found = read_run(config, path)
                problems += found
                if run is not None:
                    runs[config.parent.resolve()] = run
        for file in files_below(path, "plan.json"):
            if file.resolve() not in asked:
                asked[file.resolve()], found = _planned(file)
                problems += found
    evaluated = {path: set(rows["task"]) for (path,), rows in episodes.group_by("run_dir")}
    found_runs = list(runs.values())
    for run in found_runs:
        if str(run.path) not in evaluated:
            problems.append(f"{run.path}: no evaluation of this run yet; make one with `gvz evaluate {run.path}`")
    agents = agents_of_runs(found_runs, evaluated)
    problems += pooled_runs(found_runs, agents, evaluated)
    return Results(
        paths=tuple(paths),
        episodes=with_agents(episodes, agents),
        runs=with_unique_ids(found_runs),
        agents=agents,
        asked=tuple(itertools.chain.from_iterable(asked.values())),
        problems=tuple(problems),
    )


def _planned(file: Path) -> tuple[list[PlannedExperiment], list[str]]:
    """The experiments of a plan.json, and why it cannot be read."""
    try:
        plan = read_plan(file.parent)
    except ConfigError as error:
        return [], [f"{error}; its experiments are not in this report"]
    if plan is None:
        return [], [f"{file}: a link that leads nowhere; its experiments are not in this report"]
    return [PlannedExperiment(results=file.parent, experiment=e, scale=plan.scale) for e in plan.experiments()], []


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
