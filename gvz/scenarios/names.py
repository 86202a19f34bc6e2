"""What a scenario must name so that ids of tasks mean what they say."""

import re
from typing import TYPE_CHECKING

from gvz.core.errors import TaskError
from gvz.scenarios.map_set import PROCEDURAL, VARIED

if TYPE_CHECKING:
    from gvz.scenarios.base import Scenario

_NAME = re.compile("[a-z][a-z0-9_]*")
_TAKEN = ("default", "complete", VARIED, PROCEDURAL)
"""names of tasks and of sets of drawn maps"""


def check_names(scenario: "Scenario") -> None:
    """Refuses a scenario that would play another task than an id says.

    Raises:
        TaskError: a name of an attribute that ids cannot have or that another attribute has, groups or aliases that are
            no tuple, no group, an attribute in `complete` or an exception in `levdoom_tasks` under another name than
            its own, or no base map or textures.
    """
    if scenario.content.base_wad is None or scenario.content.textures is None:
        raise TaskError(f"scenario {scenario.id}: got a content without base_wad or textures, want both")
    owners: dict[str, str] = {}
    for attribute in scenario.attributes:
        where = f"scenario {scenario.id}, attribute {attribute.name!r}"
        for field in ("groups", "aliases"):
            if isinstance(text := getattr(attribute, field), str):
                raise TaskError(f"{where}: got the text {text!r} for its {field}, want a tuple, such as ({text!r},)")
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
    for name in scenario.complete:
        if name != (wanted := scenario.attribute(name).name):
            raise TaskError(f"scenario {scenario.id}, complete: got {name!r}, want the attribute's name, {wanted!r}")
    for task in set(scenario.levdoom_tasks) - {"default", "complete"}:
        names = sorted(scenario.attribute(word).name for word in task.split("+"))
        wanted = "complete" if set(names) == set(scenario.complete) else "+".join(names)
        if task != wanted:
            raise TaskError(f"scenario {scenario.id}, levdoom_tasks: got {task!r}, want the task's name, {wanted!r}")


def graded_name(severity: float) -> str:
    """What an attribute's name in a task's id ends with: "=0.5", or nothing if it is whole."""
    return "" if severity == 1 else f"={severity:g}"
