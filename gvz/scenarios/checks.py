"""What a scenario must have so that ids of tasks, rewards and scores mean what they say."""

import dataclasses
import re
from difflib import get_close_matches
from typing import TYPE_CHECKING, get_args

from gvz.core.env_config import Profile, check_types
from gvz.core.errors import TaskError, nearest
from gvz.scenarios.map_set import PROCEDURAL, VARIED
from gvz.scenarios.rewards import Fell, Gained, Rose
from gvz.wad.textures import NO_TEXTURE

if TYPE_CHECKING:
    from gvz.scenarios.base import Content, Scenario, Task, Value

ALWAYS_READ = ("KILLCOUNT", "POSITION_X", "POSITION_Y")
"""game variables that rewards and infos know in every scenario, beside the scenario's own"""
_NAME = re.compile("[a-z][a-z0-9_]*")
_TAKEN = ("default", "complete", VARIED, PROCEDURAL)
"""names of tasks and of sets of drawn maps"""
_MISTYPED = 0.85
"""least similarity of a group's name to another one that it is taken for: `entity_speed` and `entity_type` have 0.78"""


def check_scenario(scenario: "Scenario") -> None:
    """Refuses a scenario that would play another task than an id says, or whose rewards or scores would be wrong.

    Raises:
        ConfigError: a field of another type.
        TaskError: a name of an attribute that ids cannot have or that another attribute has; no group, or one that no
            attribute in `complete` has and whose name is nearly that of another group; an attribute in `complete` or an
            exception in `levdoom_tasks` under another name than its own; a set without tasks, or with one that has no
            name; no base map or textures, or "-" for one of them; a reward of a variable that is not read; a pace that
            needs an unknown reward or lasts no tic; no button; no time-out or bound of a profile; a combined button
            that the scenario lacks.
    """
    from gvz.scenarios.base import Split  # which imports this module

    check_types(scenario, f"scenario {scenario.id}", convert=False)
    for content in (scenario.content, scenario.levdoom, *scenario.levdoom_tasks.values()):
        _check_content(content, f"scenario {scenario.id}, content")
    if not _NAME.fullmatch(scenario.id):
        raise TaskError(f"scenario: got the id {scenario.id!r}, want lower-case letters, digits and '_'")
    if scenario.content.base_wad is None or scenario.content.textures is None:
        raise TaskError(f"scenario {scenario.id}: got a content without base_wad or textures, want both")
    _check_attributes(scenario)
    for name in scenario.complete:
        if name != (wanted := scenario.attribute(name).name):
            raise TaskError(f"scenario {scenario.id}, complete: got {name!r}, want the attribute's name, {wanted!r}")
    for task in set(scenario.levdoom_tasks) - {"default", "complete"}:
        names = sorted(scenario.attribute(word).name for word in task.split("+"))
        wanted = "complete" if set(names) == set(scenario.complete) else "+".join(names)
        if task != wanted:
            raise TaskError(f"scenario {scenario.id}, levdoom_tasks: got {task!r}, want the task's name, {wanted!r}")
    for split in get_args(Split):
        names = scenario.splits.get(split, ())
        if not names:
            raise TaskError(f"scenario {scenario.id}, splits: got no task for {split}, want one or more")
        if strange := [name for name in names if name not in scenario.tasks]:
            raise TaskError(
                f"scenario {scenario.id}, splits, {split}: got {strange[0]!r}{nearest(strange[0], scenario.tasks)}, "
                f"want some of its tasks: {', '.join(scenario.tasks)}"
            )
    _check_score(scenario)


def _check_content(content: "Content", where: str) -> None:
    check_types(content, where, convert=False)
    if content.textures is not None:
        check_types(content.textures, f"{where}.textures", convert=False)
        if NO_TEXTURE in dataclasses.astuple(content.textures):
            raise TaskError(
                f"{where}: got {content.textures}, want three textures; where there is none, the engine shows what it "
                "drew before, so the frames of an episode would depend on earlier ones"
            )


def _check_attributes(scenario: "Scenario") -> None:
    owners: dict[str, str] = {}
    for attribute in scenario.attributes:
        where = f"scenario {scenario.id}, attribute {attribute.name!r}"
        check_types(attribute, where, convert=False)
        for content in (attribute.content, attribute.levdoom):
            _check_content(content, f"{where}, content")
        if not attribute.groups:
            raise TaskError(f"{where}: got no group, want one or more")
        for name in (attribute.name, *attribute.aliases):
            if not _NAME.fullmatch(name) or name in _TAKEN:
                raise TaskError(
                    f"{where}: got the name {name!r}, want lower-case letters, digits and '_', "
                    f"and none of {', '.join(_TAKEN)}"
                )
            if name in owners:
                raise TaskError(f"{where}: got the name {name!r}, which {owners[name]!r} has; want another one")
            owners[name] = attribute.name
    groups = {group: attribute for attribute in scenario.attributes for group in attribute.groups}
    whole = {
        group for attribute in scenario.attributes if attribute.name in scenario.complete for group in attribute.groups
    }
    for group in sorted(groups.keys() - whole):
        others = sorted(groups.keys() - {group})
        if near := get_close_matches(group, others, n=1, cutoff=_MISTYPED):
            raise TaskError(
                f"scenario {scenario.id}, attribute {groups[group].name!r}: got the group {group!r} (did you mean "
                f"{near[0]!r}?), want one of {', '.join(others)}, or a name that is less similar"
            )


def _check_score(scenario: "Scenario") -> None:
    from gvz.scenarios.base import BOOKKEEPING  # which imports this module

    where = f"scenario {scenario.id}"
    for field in ("timeouts", "upper_bounds"):
        if not all(getattr(scenario, field).get(profile, 0) > 0 for profile in get_args(Profile)):
            raise TaskError(f"{where}: got {field} {getattr(scenario, field)}, want a positive one for each profile")
    if not scenario.buttons:
        raise TaskError(f"{where}: got no button, want one or more")
    if strange := set(scenario.combination_buttons or ()) - set(scenario.buttons):
        raise TaskError(f"{where}, combination_buttons: got {strange}, want some of {', '.join(scenario.buttons)}")
    variables = (*scenario.game_variables, *ALWAYS_READ, *BOOKKEEPING)
    for name, reward in scenario.rewards.items():
        check_types(reward, f"{where}, reward {name!r}", convert=False)
        if isinstance(reward.event, Rose | Fell | Gained) and (read := reward.event.name) not in variables:
            raise TaskError(
                f"{where}, reward {name!r}: got the variable {read!r}{nearest(read, variables)}, which is not read; "
                f"want one of {', '.join(variables)}, or add it to game_variables"
            )
        for pace in (*reward.paces, *(reward.levdoom_paces or ())):
            if not (pace.tics > 0 and pace.times > 0):
                raise TaskError(f"{where}, reward {name!r}: got {pace}, want more than 0 tics and more than 0 times")
            if pace.needs is not None and pace.needs not in scenario.rewards:
                raise TaskError(
                    f"{where}, reward {name!r}: got a pace that needs {pace.needs!r}, "
                    f"want one of {', '.join(scenario.rewards)}"
                )


def check_kinds(task: "Task", content: "Content") -> None:
    """Refuses an integer where the scenario has a fixed-point number, and the reverse: 1.0 is 65536 to the engine."""
    for name, own in task.scenario.content.parameters.items():
        if len(_kinds(own) | _kinds(value := content.parameters[name])) > 1:
            raise TaskError(
                f"task {task.id}: got {name}={value!r}, and {own!r} in the scenario; want both with a point, or neither"
            )


def _kinds(value: "Value") -> set[type]:
    """int or float, or both, of a parameter's numbers; 0 may be either."""
    numbers = dataclasses.astuple(value) if dataclasses.is_dataclass(value) else value
    numbers = numbers if isinstance(numbers, tuple) else (numbers,)
    return {float if isinstance(one, float) else int for one in numbers if isinstance(one, int | float) and one}


def graded_name(severity: float) -> str:
    """What an attribute's name in a task's id ends with: "=0.5", or nothing if it is whole."""
    return "" if severity == 1 else f"={severity:g}"
