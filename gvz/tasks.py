"""Tasks by name: ids, levels, the named tasks, training and test sets."""

import itertools
import re
from collections.abc import Container
from functools import cache
from typing import Literal, get_args

from gvz.core.errors import TaskError, nearest
from gvz.core.registry import named
from gvz.scenarios.base import MAX_LEVEL, Scenario, Suite, Task
from gvz.scenarios.map_set import VARIED, names_map_set, parse_map_set

LEVELS = range(MAX_LEVEL + 1)
"""levels of tasks, the easiest first"""
TrainingSet = Literal["train1", "train4", "train8", "pairs", "compositions", "train8_varied"]
"""tasks to train on; pairs: the eight of train8, and each two of their attributes that go together and are no named
task; compositions: likewise any number of their attributes; train8_varied: the eight, and on varied maps those of them
that change no texture"""
TaskSet = Literal[TrainingSet, "test", "gate"]
"""a training set, the test set, or the gate set: the named tasks of GATE_LEVEL that are in neither"""
GATE_LEVEL = 2
"""of the tasks on which choices about training are made, so that the test tasks stay unseen (docs/EXPERIMENTS.md)"""


@cache
def all_scenarios() -> dict[str, Scenario]:
    """The scenarios of every suite by id: the modules of gvz.scenarios that have a SCENARIO.

    Raises:
        ConfigError: the id of one is not its file's name.
    """
    return named("gvz.scenarios", "SCENARIO", "id")


@cache
def scenarios(suite: Suite = "core") -> dict[str, Scenario]:
    """The scenarios of a suite by id."""
    return {name: scenario for name, scenario in all_scenarios().items() if scenario.suite == suite}


def scenario_named(name: str) -> Scenario:
    """The scenario with this id.

    Raises:
        TaskError: there is none; the message lists all and names the nearest.
    """
    known = all_scenarios()
    if name not in known:
        raise TaskError(f"unknown scenario {name!r}{nearest(name, list(known))}; want one of {', '.join(known)}")
    return known[name]


def parse_task(text: str) -> Task:
    """The task with this id.

    Args:
        text: `<scenario>/default`, `<scenario>/complete` or `<scenario>/<attribute>+<attribute>...`, attributes
            in any order and by any of their names (`fast` is `fast_enemies`), each perhaps with a severity from 0 to
            1, such as `fast_enemies=0.5` (also `complete=0.5`); or a set of drawn maps (gvz.scenarios.map_set), such as
            `<scenario>/varied-10`, which may have attributes, too (`<scenario>/varied+fast_enemies`), or
            `<scenario>/procedural-train-100+layout=0.5`.

    Raises:
        TaskError: another form, an unknown name, or two attributes of one group; the message says what is possible.
    """
    scenario_id, slash, name = str(text).partition("/")  # str: any wrong type gets the error below
    if not slash or not name:
        raise TaskError(
            f"task: got {text!r}, want '<scenario>/<task>', for example 'defend_the_center/gore+mossy_bricks'; "
            f"scenarios: {', '.join(all_scenarios())}"
        )
    scenario = scenario_named(scenario_id)
    whole_sets: dict[str, tuple[str, ...]] = {"default": (), "complete": scenario.complete}
    maps, words = None, name.split("+")
    if names_map_set(name):
        maps = parse_map_set(words[0] if name.startswith(VARIED) else name)
        words = words[1:] if maps.split == VARIED else []
    graded = [_severity(scenario, word) for word in words]
    names = tuple(one for one, _ in graded)
    for whole in (*whole_sets, *filter(names_map_set, names)):
        if whole in names and len(words) + (maps is not None) > 1:
            raise TaskError(f"task: got {text!r}, but {whole!r} is a task and no attribute; want {scenario.choices()}")
    if name.startswith("default="):
        raise TaskError(f"task: got {text!r}, but 'default' has no attribute to grade; want {scenario.choices()}")
    if len(graded) == 1 and (whole := whole_sets.get(name.partition("=")[0])) is not None:
        graded = [(one, graded[0][1]) for one in whole]
    return Task(scenario, tuple(one for one, _ in graded), maps, severities=tuple(graded))


def id_for_processes(task: Task | str) -> str:
    """The task's id, by which other processes make it.

    Raises:
        TaskError: as `parse_task`; or they would make another task, because its scenario is not the one in
            gvz/scenarios.
    """
    if not isinstance(task, Task):
        return parse_task(task).id
    known = all_scenarios().get(task.scenario.id)
    if task.scenario != known:
        raise TaskError(
            f"{task.id}: its scenario {'is not' if known is None else 'differs from that'} in gvz/scenarios, where "
            "other processes look for it; put the scenario into a file there, or play the task with gvz.make"
        )
    return task.id


def _severity(scenario: Scenario, word: str) -> tuple[str, float]:
    """(Attribute, severity) of a word in a task's id: "gore", "gore=0.5"."""
    name, equals, value = word.partition("=")
    if equals and not re.fullmatch(r"[0-9]+(\.[0-9]+)?", value):
        raise TaskError(f"scenario {scenario.id}: got {word!r}, want '<attribute>=<severity>', such as 'gore=0.5'")
    return name, float(value) if equals else 1.0


def named_tasks(
    scenario: str | None = None, level: int | None = None, split: TaskSet | None = None, suite: Suite = "core"
) -> tuple[Task, ...]:
    """The named tasks of a suite or scenario: scenarios in alphabetical order, tasks in the order of their file.

    The sets `pairs`, `compositions` and `train8_varied` have tasks without a name in the benchmark, too.

    Args:
        scenario: only tasks of this scenario, whatever its suite.
        level: only tasks of this level, 0..4.
        split: only tasks of this set.
        suite: whose scenarios, if none is named.

    Raises:
        TaskError: an unknown scenario, level or split; or a set on varied maps, and the scenario has no such maps.
    """
    if level is not None and level not in LEVELS:
        raise TaskError(f"level: got {level!r}, want 0..{MAX_LEVEL}")
    if split is not None and split not in get_args(TaskSet):
        raise TaskError(f"split: got {split!r}, want one of {', '.join(get_args(TaskSet))}")
    chosen = scenarios(suite).values() if scenario is None else (scenario_named(scenario),)
    tasks = (parse_task(f"{one.id}/{name}") for one in chosen for name in _names(one, split))
    return tuple(
        task for task in tasks if level in (None, task.level) and (split != "gate" or task.level == GATE_LEVEL)
    )


def attribute_tasks(scenario: str) -> tuple[Task, ...]:
    """The default task, then each attribute alone, at half its severity and whole, then each two of different groups.

    Raises:
        TaskError: an unknown scenario.
    """
    one = scenario_named(scenario)
    names = [attribute.name for attribute in one.attributes]
    alone = [Task(one, (name,), severities=((name, severity),)) for name in names for severity in (0.5, 1.0)]
    return (Task(one), *alone, *_compositions(one, names, 2))


def _compositions(scenario: Scenario, names: Container[str], most: int) -> list[Task]:
    """Each two to `most` of these attributes that are of different groups: fewer first, then in the file's order."""
    chosen = [attribute for attribute in scenario.attributes if attribute.name in names]
    return [
        Task(scenario, tuple(attribute.name for attribute in some))
        for number in range(2, most + 1)
        for some in itertools.combinations(chosen, number)
        if not any(set(a.groups) & set(b.groups) for a, b in itertools.combinations(some, 2))
    ]


def _names(scenario: Scenario, split: TaskSet | None) -> tuple[str, ...]:
    """Names of a set's tasks; of the gate set, those of every level."""
    if split is None:
        return scenario.tasks
    if split == "gate":
        used = {name for names in scenario.splits.values() for name in names}
        return tuple(name for name in scenario.tasks if name not in used)
    if split == "train8_varied":
        eight = scenario.splits["train8"]
        textures = {attribute.name for attribute in scenario.attributes if "textures" in attribute.groups}
        kept = [name for name in eight if textures.isdisjoint(name.split("+"))]
        return (*eight, *(VARIED if name == "default" else f"{VARIED}+{name}" for name in kept))
    if split in ("pairs", "compositions"):
        eight, named = scenario.splits["train8"], named_tasks(scenario.id)
        composed = _compositions(scenario, eight, 2 if split == "pairs" else len(eight))
        return (*eight, *(task.name for task in composed if task not in named))
    return scenario.splits[split]
