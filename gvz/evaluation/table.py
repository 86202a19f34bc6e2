"""What an evaluation ends with: the score of each task, as rows for a program and as a table for a person."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gvz.evaluation.play import Row
from gvz.evaluation.statistics import bootstrap, normalize
from gvz.tasks import Task


def score_rows(rows: Sequence[Row], tasks: Sequence[Task]) -> list[dict[str, Any]]:
    """The score of each task that was played; then, of more than one, the mean over tasks.

    Args:
        rows: of one player, each episode once.
        tasks: in the order to list them.

    Returns:
        JSON types: task, level and score (None of several tasks), episodes, normalized_score, and player_kills (None
        where the score is not kills); each estimate with the ends of its 95% interval, as score_low and score_high.
    """
    by_task = {task: [row for row in rows if row["task"] == task.id] for task in tasks}
    played = {task: mine for task, mine in by_task.items() if mine}
    found = [_score_row({task: mine}) for task, mine in played.items()]
    return [*found, _score_row(played)] if len(played) > 1 else found


def _score_row(played: Mapping[Task, Sequence[Row]]) -> dict[str, Any]:
    [task, *others] = played
    row: dict[str, Any] = {
        "task": None if others else task.id,
        "level": None if others else task.level,
        "episodes": sum(map(len, played.values())),
    }
    known = {
        "score": not others,
        "normalized_score": True,
        "player_kills": all(
            task.scenario.metric == "kills" and all("player_kills" in row for row in mine)
            for task, mine in played.items()
        ),
    }
    for name, is_known in known.items():
        columns = [np.array([_value(name, one, t) for one in mine]) for t, mine in played.items()] if is_known else []
        e = bootstrap(columns) if is_known else None
        row |= {name: e and e.value, f"{name}_low": e and e.low, f"{name}_high": e and e.high}
    return row


def _value(name: str, row: Row, task: Task) -> float:
    """Rows of earlier versions have no normalized score."""
    if name in row:
        return row[name]
    return normalize(row["score"], task.scenario.upper_bound(row.get("profile", "thesis")))


def score_lines(found: Sequence[Mapping[str, Any]]) -> list[str]:
    """A table of `score_rows`, the head first; the names, which can be long, come last.

    Where the score of a task is kills, a column has those by the player itself.
    """

    kills = any(row["player_kills"] is not None for row in found)
    own = f"{'own kills [95%]':20}  " if kills else ""
    lines = [f"{'mean score [95%]':23}  {'% of the bound [95%]':20}  {own}episodes  level  task"]
    for row in found:
        name = row["task"] or f"mean of {len(found) - 1} tasks"
        level = "" if row["level"] is None else row["level"]
        own = f"{interval_text(row, 'player_kills'):20}  " if kills else ""
        means = f"{interval_text(row, 'score'):23}  {interval_text(row, 'normalized_score'):20}"
        lines.append(f"{means}  {own}{row['episodes']:8}  {level!s:>5}  {name}")
    return lines


def interval_text(row: Mapping[str, Any], name: str) -> str:
    """An estimate of a row of `score_rows`, with its interval; empty where it is not known."""
    value, low, high = row[name], row[f"{name}_low"], row[f"{name}_high"]
    return "" if value is None else f"{value:.1f} [{low:.1f}, {high:.1f}]"
