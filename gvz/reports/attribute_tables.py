"""What each attribute of a scenario costs, and what two of them cost beyond their sum."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from gvz.evaluation.statistics import Statistic, attribute_interaction, attribute_loss
from gvz.reports.document import Cell, Figure, Table, missing, words
from gvz.reports.draw import draw_matrix
from gvz.reports.scores import Scores, estimate
from gvz.scenarios.base import Scenario, Task


def attribute_tables(scenario: Scenario, scores: Mapping[str, Scores], tasks: Sequence[Task]) -> list[Table]:
    """The losses of single attributes, and those of pairs that were played with both of their attributes alone."""
    ids = _by_attributes(tasks)
    default = ids.get(frozenset())
    names = [attribute.name for attribute in scenario.attributes]
    singles = sorted(
        (task for task in tasks if len(task.attributes) == 1 and task.maps is None),
        key=lambda task: (names.index(task.attributes[0]), task.severity(task.attributes[0])),
    )
    if default is None or not singles:
        return []
    alone = {name: ids[frozenset({name})] for name in names if frozenset({name}) in ids}
    pairs = sorted(sorted(pair, key=names.index) for pair in ids if len(pair) == 2 and pair <= alone.keys())
    tables = [
        Table(
            id=f"{scenario.id}_attributes",
            caption=f"{scenario.title}: what an attribute costs, in points of the upper bound: the score on the "
            "default task less that with this attribute alone, whole or at a severity.",
            columns=("attribute", *scores),
            rows=tuple(
                (words(task.name), *(_cell(one, [default, task.id], attribute_loss) for one in scores.values()))
                for task in singles
            ),
        )
    ]
    if pairs:
        rows = [
            (words(" + ".join(pair)), [default, *(alone[name] for name in pair), ids[frozenset(pair)]])
            for pair in pairs
        ]
        tables.append(
            Table(
                id=f"{scenario.id}_attribute_pairs",
                caption=f"{scenario.title}: what two attributes cost together beyond the sum of what each costs "
                "alone, in points of the upper bound. Below 0: together they cost less.",
                columns=("attributes", *scores),
                rows=tuple(
                    (title, *(_cell(one, four, attribute_interaction) for one in scores.values()))
                    for title, four in rows
                ),
            )
        )
    return tables


def attribute_figure(
    scenario: Scenario, agent: str, scores: Scores, tasks: Sequence[Task], out: Path, id: str
) -> Figure | None:
    """A matrix of losses: single attributes on the diagonal, pairs beside it. None if few pairs were played."""
    ids = _by_attributes(tasks)
    default, names = ids.get(frozenset()), [attribute.name for attribute in scenario.attributes]
    losses = np.full((len(names), len(names)), np.nan)
    for row, first in enumerate(names):
        for column, second in enumerate(names):
            task = ids.get(frozenset({first, second}))
            if default is not None and task is not None:
                cell = _cell(scores, [default, task], attribute_loss)
                losses[row, column] = np.nan if cell.estimate is None else cell.estimate.value
    if np.isfinite(losses).sum() <= 2 * len(names):
        return None
    caption = (
        f"{scenario.title}, {agent}: points of the upper bound that attributes cost; each alone on the diagonal, two "
        "together beside it. Empty: of one group, or not played."
    )
    return draw_matrix(out, id, agent, names, losses, caption)


def _by_attributes(tasks: Sequence[Task]) -> dict[frozenset[str], str]:
    """Ids of the tasks with whole attributes."""
    return {frozenset(task.attributes): task.id for task in tasks if task.maps is None and not task.severities}


def _cell(scores: Scores, tasks: Sequence[str], statistic: Statistic) -> Cell:
    return estimate(scores, tasks, statistic) if scores.complete_seeds(tasks) else missing()
