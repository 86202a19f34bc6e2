"""Scores of an evaluation as lines of text. Imports numpy, gvz.evaluation.metrics."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gvz.evaluation.metrics import bootstrap
from gvz.evaluation.play import Row
from gvz.tasks import Task


def score_lines(rows: Sequence[Row], identity: Mapping[str, Any], tasks: Sequence[Task], episodes: int) -> list[str]:
    """A table: each task's mean score with its 95% bootstrap interval, in the metric and in percent of its bound.

    Args:
        rows: of a record file.
        identity: the rows that belong to the evaluation.
        tasks: in the order to list them.
        episodes: only episodes 0 .. episodes - 1.
    """
    chosen = [row for row in rows if identity.items() <= row.items() and row["episode"] < episodes]
    width = max(len(task.id) for task in tasks)
    lines = [f"{'task':{width}}  level  episodes  {'mean score [95%]':24}  percent of the upper bound [95%]"]
    for task in tasks:
        mine = [row for row in chosen if row["task"] == task.id]
        if mine:
            score = bootstrap([np.array([row["score"] for row in mine])])
            percent = bootstrap([np.array([row["normalized_score"] for row in mine])])
            lines.append(f"{task.id:{width}}  {task.level:5}  {len(mine):8}  {score!s:24}  {percent}")
    return lines
