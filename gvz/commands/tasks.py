"""`gvz tasks`: the list of tasks."""

import json
from dataclasses import dataclass
from typing import Annotated, Any, get_args

import tyro

from gvz.evaluation.selection import ALL_TASKS, TaskSelection
from gvz.scenarios.base import Task
from gvz.tasks import TaskSet, named_tasks


@dataclass(frozen=True, kw_only=True)
class Tasks:
    """List the tasks: level, training, test and gate sets, scenario and attributes."""

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
        width = max(len(" ".join(row["sets"])) for row in [*rows, {"sets": ["sets"]}])
        print(f"level  {'sets':{width}}  task")
        for row in rows:
            spelled_out = " = " + "+".join(row["attributes"]) if row["task"].endswith("/complete") else ""
            print(f"{row['level']:5}  {' '.join(row['sets']):{width}}  {row['task']}{spelled_out}")
        return 0


COMMAND = Tasks


def task_row(task: Task) -> dict[str, Any]:
    """The row of a task, as JSON types."""
    from gvz.registration import gymnasium_id

    scenario = task.scenario
    possible = [name for name in get_args(TaskSet) if scenario.variety is not None or name != "train8_varied"]
    sets = [name for name in possible if task in named_tasks(scenario.id, split=name)]
    return {
        "task": task.id,
        "scenario": scenario.id,
        "level": task.level,
        "attributes": list(task.attributes),
        "sets": sets,
        "gymnasium_id": gymnasium_id(task) if task in named_tasks(scenario.id) else None,
    }
