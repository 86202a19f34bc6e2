"""What an evaluation ends with: the score of each task, for a person and for a program."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from gvz.evaluation.play import Row
from gvz.evaluation.statistics import Estimate, bootstrap, bootstrap_runs
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
    own_kills: Estimate | None = None
    """where the score is kills: those by the player itself"""


def scores(rows: Sequence[Row], identity: Mapping[str, Any], tasks: Sequence[Task], episodes: int) -> list[Score]:
    """The score of each task that was played; then, of more than one, the mean over tasks.

    Args:
        rows: of a record file.
        identity: the rows that belong to the evaluation.
        tasks: in the order to list them.
        episodes: only episodes 0 .. episodes - 1.
    """
    chosen = [row for row in rows if identity.items() <= row.items() and row["episode"] < episodes]
    found, percents, own = [], [], []
    for task in tasks:
        mine = [row for row in chosen if row["task"] == task.id]
        if mine:
            percents.append(np.array([row["normalized_score"] for row in mine]))
            if task.scenario.metric == "kills":
                own.append(np.array([row["player_kills"] for row in mine]))
            found.append(
                Score(
                    task=task,
                    episodes=len(mine),
                    score=bootstrap([np.array([row["score"] for row in mine])]),
                    percent=bootstrap(percents[-1:]),
                    own_kills=bootstrap(own[-1:]) if task.scenario.metric == "kills" else None,
                )
            )
    if len(found) > 1:
        found.append(
            Score(
                task=None,
                episodes=sum(map(len, percents)),
                score=None,
                percent=bootstrap_runs([[percents]], redraw=["episodes"]),
                own_kills=bootstrap_runs([[own]], redraw=["episodes"]) if len(own) == len(percents) else None,
            )
        )
    return found


def score_lines(found: Sequence[Score]) -> list[str]:
    """A table of scores, the head first; the names, which can be long, come last.

    Where the score of a task is kills, a column has those by the player itself.
    """
    kills = any(one.own_kills is not None for one in found)
    own = f"{'own kills [95%]':20}  " if kills else ""
    lines = [f"{'mean score [95%]':23}  {'% of the bound [95%]':20}  {own}episodes  level  task"]
    for one in found:
        name = f"mean of {len(found) - 1} tasks" if one.task is None else one.task.id
        level = "" if one.task is None else one.task.level
        score = "" if one.score is None else one.score
        own = f"{'' if one.own_kills is None else one.own_kills!s:20}  " if kills else ""
        lines.append(f"{score!s:23}  {one.percent!s:20}  {own}{one.episodes:8}  {level!s:>5}  {name}")
    return lines


def score_row(one: Score) -> dict[str, Any]:
    """A score as JSON types: task and level (None of several tasks), episodes, and score, normalized_score and
    player_kills (None where the score is not kills) with the ends of their intervals.
    """
    return {
        "task": None if one.task is None else one.task.id,
        "level": None if one.task is None else one.task.level,
        "episodes": one.episodes,
        **_with_ends("score", one.score),
        **_with_ends("normalized_score", one.percent),
        **_with_ends("player_kills", one.own_kills),
    }


def _with_ends(name: str, estimate: Estimate | None) -> dict[str, float | None]:
    e = estimate
    values = (None,) * 3 if e is None else (e.value, e.low, e.high)
    return dict(zip((name, f"{name}_low", f"{name}_high"), values, strict=True))
