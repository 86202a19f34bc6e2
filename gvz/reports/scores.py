"""Scores of agents, picked from the evaluation episodes, and estimates of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from gvz.evaluation.statistics import Cells, Redraw, Statistic, bootstrap_runs, mean
from gvz.reports.document import Cell, missing, ours

Seed = int | None
"""of training; None is a player that was not trained"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Scores:
    """Normalized scores (percent of the upper bound), or another column, of an agent's evaluation episodes, by training
    seed and task.
    """

    runs: dict[Seed, dict[str, np.ndarray]]
    wanted_seeds: tuple[Seed, ...]
    """the required ones; those that are not in `runs` are missing"""
    agents_of_tasks: bool = False
    """every task has agents of its own: a seed stands for different agents on different tasks"""
    policies: tuple[tuple[Seed, str, str], ...] = ()
    """(seed, run directory, hash of the parameters) of what played, by which the runs of two scenarios are seen to be
    the same; empty if that is not known"""

    def complete_seeds(self, tasks: Sequence[str]) -> tuple[Seed, ...]:
        """Seeds with an episode at least of each task."""
        return tuple(s for s in self.wanted_seeds if all(task in self.runs.get(s, {}) for task in tasks))

    def played(self, tasks: Sequence[str]) -> bool:
        """There is an episode of one of these tasks at least."""
        return any(task in by_task for by_task in self.runs.values() for task in tasks)

    def cells(self, tasks: Sequence[str]) -> Cells:
        """The episodes of every complete seed on each of the tasks."""
        return [[self.runs[seed][task] for task in tasks] for seed in self.complete_seeds(tasks)]

    def coverage(self, tasks: Sequence[str]) -> str:
        """ "2 of 3 seeds", if not all are complete."""
        there, wanted = len(self.complete_seeds(tasks)), len(self.wanted_seeds)
        return "" if there == wanted else f"{there} of {wanted} seeds"


def pick(episodes: pl.DataFrame, *, column: str = "normalized_score") -> dict[Seed, dict[str, np.ndarray]]:
    """One agent's scores, or another column, by training seed and task; rows without the column are left out."""
    found: dict[Seed, dict[str, np.ndarray]] = {}
    grouped = episodes.drop_nulls(column).group_by("run_seed", "task", maintain_order=True).agg(column)
    for seed, task, values in grouped.iter_rows():
        found.setdefault(seed, {})[task] = np.array(values)
    return found


def agent_scores(episodes: pl.DataFrame, agent: str, *, column: str = "normalized_score") -> Scores:
    """An agent's final scores, or another column of its rows: of the last quarter of its evaluated checkpoints.

    The episodes are of one scenario. There, more runs than seeds are agents of single tasks.
    """
    rows = episodes.filter(pl.col("final"), agent=agent)
    runs = pick(rows, column=column)
    policies = rows.select("run_seed", "run_dir", "params").drop_nulls().unique().sort(pl.all())
    one_task_each = rows.group_by("run_dir").agg(pl.col("trained_on").list.len().max()).drop_nulls()
    return Scores(
        runs=runs,
        wanted_seeds=tuple(sorted(runs, key=lambda seed: -1 if seed is None else seed)),
        agents_of_tasks=len(one_task_each) > len(runs),
        policies=tuple(policies.rows()),
    )


def redraw(scores: Scores, tasks: Sequence[str]) -> Redraw:
    """What a bootstrap can resample: runs, if there are several, else episodes."""
    if len(scores.complete_seeds(tasks)) < 2:
        return "episodes"
    return "runs_by_task" if scores.agents_of_tasks else "runs"


def estimate(scores: Scores, tasks: Sequence[str], statistic: Statistic = mean) -> Cell:
    """A statistic over tasks and seeds as a cell; missing if no seed has all of the tasks."""
    return estimate_groups([(scores, tasks)], statistic)


def estimate_groups(groups: Sequence[tuple[Scores, Sequence[str]]], statistic: Statistic, *, digits: int = 1) -> Cell:
    """A statistic of several groups of runs; missing if one of them is."""
    notes = [note for scores, tasks in groups if (note := scores.coverage(tasks))]
    note = "; ".join(dict.fromkeys(notes))
    cells = [scores.cells(tasks) for scores, tasks in groups]
    if not groups or not all(tasks and runs for (_, tasks), runs in zip(groups, cells, strict=True)):
        return missing(note)
    how: list[Redraw] = [redraw(scores, tasks) for scores, tasks in groups]
    together = set(how) == {"runs"} and _of_same_runs(groups)
    return ours(bootstrap_runs(cells, statistic, redraw=how, together=together), note, digits)


def _of_same_runs(groups: Sequence[tuple[Scores, Sequence[str]]]) -> bool:
    """Every seed has a policy that played in all groups; one of them may have further checkpoints of the run."""
    common = set.intersection(*(set(scores.policies) for scores, _ in groups))
    seeds = {scores.complete_seeds(tasks) for scores, tasks in groups}
    return len(seeds) == 1 and {seed for seed, _, _ in common} >= set(*seeds)
