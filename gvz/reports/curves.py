"""Curves over gradient steps, as numbers: scores of training episodes and of evaluated checkpoints."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import polars as pl

from gvz.evaluation.statistics import bootstrap_runs
from gvz.reports.agents import ONE_RUN
from gvz.reports.runs import Run
from gvz.reports.scores import Scores, pick, redraw
from gvz.tasks import LEVELS, parse_task

WINDOW_EPISODES = 30
"""training episodes in a running mean, as in the trainer's own KPI"""

SHARE_EPISODES = 200
"""training episodes of which a curriculum's shares are shown"""

GRID_POINTS = 100
"""gradient steps at which learning curves of several runs are averaged"""

_NTH = pl.col("num_updates").rank("dense").over(ONE_RUN)
"""which of its run's evaluated checkpoints, the oldest first"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Curve:
    """A line with its band and, if it is of one run, the episodes behind it. All float64 of one length each."""

    label: str
    updates: np.ndarray
    values: np.ndarray
    """percent, of the upper bound or of episodes"""
    low: np.ndarray
    high: np.ndarray
    points: tuple[np.ndarray, np.ndarray] | None = None
    """gradient steps and scores of single episodes"""


def running_mean(values: np.ndarray, window: int) -> np.ndarray:
    """Mean of each value and up to `window - 1` before it, float64[N]."""
    return pl.Series(values).rolling_mean(window, min_samples=1).to_numpy()


def learning_curve(label: str, runs: Sequence[Run], tasks: Sequence[str]) -> Curve | None:
    """Running mean of the scores of training episodes, mean over the tasks and then over the training seeds.

    Args:
        runs: of one agent; several of one seed if every task has a run of its own.
        tasks: only episodes of these; a seed without an episode of one of them is left out.

    Returns: the curve with the band of redrawn seeds, or None without any episodes.
    """
    found: dict[int, dict[str, tuple[np.ndarray, np.ndarray]]] = {}
    for run in runs:
        for task in tasks:
            rows = run.training_episodes.filter(task=task).drop_nulls("normalized_score").sort("num_updates")
            if len(rows):
                found.setdefault(run.seed, {})[task] = (
                    rows["num_updates"].to_numpy().astype(np.float64),
                    rows["normalized_score"].to_numpy(),
                )
    complete = [by_task for by_task in found.values() if len(by_task) == len(tasks)]
    if not complete:
        return None
    series = [one for by_task in complete for one in by_task.values()]
    begin, end = max(updates[0] for updates, _ in series), min(updates[-1] for updates, _ in series)
    if begin > end:
        return None
    grid = np.linspace(begin, end, GRID_POINTS)
    lines = np.array([np.mean([_held(one, grid) for one in by_task.values()], axis=0) for by_task in complete])
    drawn = np.random.default_rng(0).integers(len(lines), size=(500, len(lines)))
    low, high = np.quantile(lines[drawn].mean(axis=1), [0.025, 0.975], axis=0)
    points = None
    if len(complete) == 1:
        points = (np.concatenate([updates for updates, _ in series]), np.concatenate([scores for _, scores in series]))
    return Curve(label=label, updates=grid, values=lines.mean(axis=0), low=low, high=high, points=points)


def share_curve(run: Run, task: str) -> Curve | None:
    """The task's share of the run's episodes, in percent of the last SHARE_EPISODES; None without any episode."""
    rows = run.training_episodes.sort("num_updates")
    if rows.is_empty():
        return None
    shares = running_mean(100.0 * (rows["task"] == task).to_numpy(), SHARE_EPISODES)
    updates = rows["num_updates"].to_numpy().astype(np.float64)
    return Curve(label=task, updates=updates, values=shares, low=shares, high=shares)


def _held(series: tuple[np.ndarray, np.ndarray], grid: np.ndarray) -> np.ndarray:
    """The running mean as it stood at each point of the grid."""
    updates, scores = series
    return running_mean(scores, WINDOW_EPISODES)[np.searchsorted(updates, grid, side="right") - 1]


def evaluation_curve(label: str, episodes: pl.DataFrame, tasks: Sequence[str]) -> Curve | None:
    """Mean evaluation score of each checkpoint over tasks and training seeds, with its interval.

    Args:
        episodes: rows of one agent. If its runs have equally many evaluated checkpoints, the n-th ones are taken
            together, else those of equally many gradient steps.
        tasks: only these; a seed that lacks one of them at a checkpoint is left out there.

    Returns: the curve, or None if no checkpoint has all tasks.
    """
    rows = episodes.filter(pl.col("task").is_in(tasks)).drop_nulls("num_updates")
    alike = checkpoints_of_runs(rows).n_unique() == 1
    updates, estimates = [], []
    for (_,), checkpoint in sorted(rows.group_by(_NTH if alike else "num_updates")):
        runs = pick(checkpoint)
        scores = Scores(runs=runs, wanted_seeds=tuple(runs))
        if cells := scores.cells(tasks):
            estimates.append(bootstrap_runs([cells], redraw=[redraw(scores, tasks)], num_resamples=300))
            updates.append(float(checkpoint["num_updates"].median()))  # pyright: ignore[reportArgumentType]  # not empty
    if not estimates:
        return None
    return Curve(
        label=label,
        updates=np.array(updates),
        values=np.array([e.value for e in estimates]),
        low=np.array([e.low for e in estimates]),
        high=np.array([e.high for e in estimates]),
    )


def checkpoints_of_runs(episodes: pl.DataFrame) -> pl.Series:
    """How many evaluated checkpoints each run has."""
    return episodes.group_by(ONE_RUN).agg(pl.col("num_updates").n_unique())["num_updates"]


def usual_tasks(episodes: pl.DataFrame) -> list[str]:
    """Of each level the tasks that the most of an agent's checkpoints have, if they have any of it.

    A checkpoint that was evaluated on more tasks than the others does not make these incomplete.
    """
    by_checkpoint = episodes.group_by("level", "run_seed", nth=_NTH).agg(pl.col("task").unique().sort())
    counts = Counter((level, tuple(tasks)) for level, tasks in by_checkpoint.select("level", "task").iter_rows())
    usual = {level: tasks for (level, tasks), _ in sorted(counts.items(), key=lambda one: (one[1], len(one[0][1])))}
    return [task for tasks in usual.values() for task in tasks]


def level_curves(episodes: pl.DataFrame, tasks: Sequence[str]) -> list[Curve | None]:
    """`evaluation_curve` of the tasks of each level."""
    by_level = [[task for task in tasks if parse_task(task).level == level] for level in LEVELS]
    return [evaluation_curve(f"level {level}", episodes, of_level) for level, of_level in enumerate(by_level)]
