"""`gvz tasks`: the list of tasks. Imports gvz.{selection,registration,tasks}."""

import json
from dataclasses import dataclass
from typing import Annotated, Any

import tyro

from gvz.scenarios.base import Task
from gvz.selection import ALL_TASKS, TaskSelection
from gvz.tasks import named_tasks


@dataclass(frozen=True, kw_only=True)
class Tasks:
    """List the tasks: id, level, attributes, training and test sets."""

    select: Annotated[TaskSelection, tyro.conf.arg(name="")] = ALL_TASKS
    json: bool = False
    """one JSON object a line instead of a table"""

    def run(self) -> int:
        """Prints a table, or JSON lines."""
        rows = [task_row(task) for task in self.select.resolve()]
        if self.json:
            for row in rows:
                print(json.dumps(row))
            return 0
        table = [("task", "level", "attributes", "sets")]
        table += [(r["task"], str(r["level"]), "+".join(r["attributes"]), " ".join(r["sets"])) for r in rows]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        for cells in table:
            print("  ".join(cell.ljust(width) for cell, width in zip(cells, widths, strict=True)).rstrip())
        return 0


COMMAND = Tasks


def task_row(task: Task) -> dict[str, Any]:
    """What is to be said of a task, as JSON types."""
    from gvz.registration import gymnasium_id

    scenario = task.scenario
    sets = [name for name in scenario.splits if task in named_tasks(scenario.id, split=name)]
    return {
        "task": task.id,
        "scenario": scenario.id,
        "level": task.level,
        "attributes": list(task.attributes),
        "sets": sets,
        "gymnasium_id": gymnasium_id(task) if task in named_tasks(scenario.id) else None,
    }
