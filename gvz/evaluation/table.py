"""Scores of an evaluation as lines of text. Imports numpy, gvz.evaluation.metrics."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from gvz.evaluation.metrics import bootstrap, bootstrap_runs
from gvz.evaluation.play import Row
from gvz.tasks import Task


def score_lines(rows: Sequence[Row], identity: Mapping[str, Any], tasks: Sequence[Task], episodes: int) -> list[str]:
    """A table: each task's mean score with its 95% bootstrap interval, in the metric and in percent of its bound; then
    the mean over tasks.

    Args:
        rows: of a record file.
        identity: the rows that belong to the evaluation.
        tasks: in the order to list them.
        episodes: only episodes 0 .. episodes - 1.
    """
    chosen = [row for row in rows if identity.items() <= row.items() and row["episode"] < episodes]
    width = max(len(task.id) for task in tasks)
    lines = [f"{'task':{width}}  level  episodes  {'mean score [95%]':24}  percent of the upper bound [95%]"]
    by_task = []
    for task in tasks:
        mine = [row for row in chosen if row["task"] == task.id]
        if mine:
            by_task.append(np.array([row["normalized_score"] for row in mine]))
            score, percent = bootstrap([np.array([row["score"] for row in mine])]), bootstrap(by_task[-1:])
            lines.append(f"{task.id:{width}}  {task.level:5}  {len(mine):8}  {score!s:24}  {percent}")
    if len(by_task) > 1:
        together = bootstrap_runs([[by_task]], redraw=["episodes"])
        lines.append(f"{f'mean of {len(by_task)} tasks':{width}}  {'':5}  {len(chosen):8}  {'':24}  {together}")
    return lines
