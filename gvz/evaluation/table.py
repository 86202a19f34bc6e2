"""What an evaluation ends with: the score of each task, for a person and for a program. Imports numpy,
gvz.evaluation.metrics.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gvz.evaluation.metrics import Estimate, bootstrap, bootstrap_runs
from gvz.evaluation.play import Row
from gvz.tasks import Task


@dataclass(frozen=True, kw_only=True, slots=True)
class Score:
    """A mean with its 95% bootstrap interval."""

    task: Task | None
    """None: the mean over tasks"""
    episodes: int
    score: Estimate | None
    """in the task's metric; None of several tasks"""
    percent: Estimate
    """of the upper bound"""


def scores(rows: Sequence[Row], identity: Mapping[str, Any], tasks: Sequence[Task], episodes: int) -> list[Score]:
    """The score of each task that was played; then, of more than one, the mean over tasks.

    Args:
        rows: of a record file.
        identity: the rows that belong to the evaluation.
        tasks: in the order to list them.
        episodes: only episodes 0 .. episodes - 1.
    """
    chosen = [row for row in rows if identity.items() <= row.items() and row["episode"] < episodes]
    found, by_task = [], []
    for task in tasks:
        mine = [row for row in chosen if row["task"] == task.id]
        if mine:
            by_task.append(np.array([row["normalized_score"] for row in mine]))
            score, percent = bootstrap([np.array([row["score"] for row in mine])]), bootstrap(by_task[-1:])
            found.append(Score(task=task, episodes=len(mine), score=score, percent=percent))
    if len(found) > 1:
        together = bootstrap_runs([[by_task]], redraw=["episodes"])
        found.append(Score(task=None, episodes=sum(map(len, by_task)), score=None, percent=together))
    return found


def score_lines(found: Sequence[Score]) -> list[str]:
    """A table of scores, the head first; the names, which can be long, come last."""
    lines = [f"{'mean score [95%]':23}  {'% of the bound [95%]':20}  episodes  level  task"]
    for one in found:
        name = f"mean of {len(found) - 1} tasks" if one.task is None else one.task.id
        level = "" if one.task is None else one.task.level
        score = "" if one.score is None else one.score
        lines.append(f"{score!s:23}  {one.percent!s:20}  {one.episodes:8}  {level!s:>5}  {name}")
    return lines


def score_row(one: Score) -> dict[str, Any]:
    """A score as JSON types: task and level (None of several tasks), episodes, score and normalized_score with the ends
    of their intervals.
    """
    return {
        "task": None if one.task is None else one.task.id,
        "level": None if one.task is None else one.task.level,
        "episodes": one.episodes,
        **_with_ends("score", one.score),
        **_with_ends("normalized_score", one.percent),
    }


def _with_ends(name: str, estimate: Estimate | None) -> dict[str, float | None]:
    e = estimate
    values = (None,) * 3 if e is None else (e.value, e.low, e.high)
    return dict(zip((name, f"{name}_low", f"{name}_high"), values, strict=True))
