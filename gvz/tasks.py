"""Tasks by name: ids, levels, the named tasks, training and test sets."""

from functools import cache
from typing import get_args

from gvz.core.errors import TaskError
from gvz.core.registry import discover
from gvz.scenarios.base import Scenario, Split, Task, nearest

__all__ = ["Scenario", "Split", "Task", "named_tasks", "parse_task", "scenario_named", "scenarios"]


@cache
def scenarios() -> dict[str, Scenario]:
    """Every scenario there is, by id: the modules of gvz.scenarios that have a SCENARIO."""
    found = {n: m.SCENARIO for n, m in discover("gvz.scenarios").items() if hasattr(m, "SCENARIO")}
    assert all(name == scenario.id for name, scenario in found.items()), "a scenario's id is its file name"
    return found


def scenario_named(name: str) -> Scenario:
    """The scenario with this id.

    Raises:
        TaskError: there is none; lists those there are, and the nearest.
    """
    known = scenarios()
    if name not in known:
        raise TaskError(f"unknown scenario {name!r}{nearest(name, list(known))}; want one of {', '.join(known)}")
    return known[name]


def parse_task(text: str) -> Task:
    """The task with this id.

    Args:
        text: `<scenario>/default`, `<scenario>/complete` or `<scenario>/<attribute>+<attribute>...`, attributes
            in any order.

    Raises:
        TaskError: not of that form, an unknown name, or two attributes of one group; says what is possible.
    """
    scenario_id, slash, name = str(text).partition("/")  # whatever it is, the error below names it
    if not slash or not name:
        raise TaskError(
            f"task: got {text!r}, want '<scenario>/<task>', for example 'defend_the_center/gore+mossy_bricks'; "
            f"scenarios: {', '.join(scenarios())}"
        )
    scenario = scenario_named(scenario_id)
    whole_sets = {"default": (), "complete": scenario.complete}
    names = tuple(name.split("+"))
    for whole in whole_sets:
        if whole in names and len(names) > 1:
            raise TaskError(f"task: got {text!r}, but {whole!r} is a task and no attribute; want {scenario.choices()}")
    return Task(scenario, whole_sets.get(name, names))


def named_tasks(scenario: str | None = None, level: int | None = None, split: Split | None = None) -> tuple[Task, ...]:
    """The thesis's tasks, by scenario in alphabetical order, within a scenario in the thesis's order.

    Args:
        scenario: only this one's.
        level: only this level's, 0..4.
        split: only the training or test set of this name.

    Raises:
        TaskError: an unknown scenario, level or split.
    """
    if level is not None and level not in range(5):
        raise TaskError(f"level: got {level!r}, want 0..4")
    if split is not None and split not in get_args(Split):
        raise TaskError(f"split: got {split!r}, want one of {', '.join(get_args(Split))}")
    chosen = scenarios().values() if scenario is None else (scenario_named(scenario),)
    tasks = (
        parse_task(f"{one.id}/{name}") for one in chosen for name in (one.tasks if split is None else one.splits[split])
    )
    return tuple(task for task in tasks if level is None or task.level == level)
