"""Discrete actions: the buttons that each action of a scenario holds."""

from collections.abc import Iterable
from itertools import chain, combinations, product
from types import MappingProxyType

from gvz.core.env_config import ActionSet
from gvz.core.errors import ConfigError
from gvz.scenarios.base import Scenario, Task

Buttons = tuple[str, ...]
"""buttons that are held together"""

_CONTRADICTORY = ({"TURN_LEFT", "TURN_RIGHT"}, {"MOVE_LEFT", "MOVE_RIGHT"}, {"MOVE_FORWARD", "MOVE_BACKWARD"})

UNIFIED_V1: tuple[Buttons, ...] = (
    (),
    *(("ATTACK",), ("MOVE_FORWARD",), ("MOVE_BACKWARD",), ("MOVE_LEFT",), ("MOVE_RIGHT",)),
    *(("TURN_LEFT",), ("TURN_RIGHT",), ("USE",)),
    *(("ATTACK", "MOVE_FORWARD"), ("ATTACK", "MOVE_LEFT"), ("ATTACK", "MOVE_RIGHT")),
    *(("ATTACK", "TURN_LEFT"), ("ATTACK", "TURN_RIGHT")),
    *(("MOVE_FORWARD", "TURN_LEFT"), ("MOVE_FORWARD", "TURN_RIGHT")),
    *(("SPEED", "MOVE_FORWARD"), ("SPEED", "MOVE_LEFT"), ("SPEED", "MOVE_RIGHT")),
    *(("ATTACK", "MOVE_FORWARD", "TURN_LEFT"), ("ATTACK", "MOVE_FORWARD", "TURN_RIGHT")),
)
"""One list for all scenarios. It never changes: policies and records name actions by their place in it. A scenario
that needs other actions gets a new list, `unified_v2`. SPEED alone is not in it: it does nothing."""

AXES_V1: tuple[Buttons, ...] = (
    *(("", "TURN_LEFT", "TURN_RIGHT"), ("", "MOVE_FORWARD", "MOVE_BACKWARD"), ("", "MOVE_LEFT", "MOVE_RIGHT")),
    *(("", "ATTACK"), ("", "USE"), ("", "SPEED")),
)
"""The axes of a MultiDiscrete action, for agents that choose each by itself; "" holds no button. Never changes."""

_FIXED: MappingProxyType[ActionSet, tuple[Buttons, ...]] = MappingProxyType(
    {
        "unified_v1": UNIFIED_V1,
        "multi_discrete_v1": tuple(tuple(filter(None, held)) for held in product(*AXES_V1)),
    }
)
"""lists that are the same in every scenario"""


def check_one_action_set(where: str, tasks: Iterable[Task], action_set: ActionSet) -> None:
    """Raises ConfigError for tasks of several scenarios, if their actions differ. `where` begins its message."""
    names = sorted({task.scenario.id for task in tasks})
    if len(names) > 1 and action_set not in _FIXED:
        raise ConfigError(
            f"{where}: got tasks of {', '.join(names)}, whose actions differ; want one scenario, or "
            'action_set="unified_v1"'
        )


def action_buttons(scenario: Scenario, action_set: ActionSet) -> tuple[Buttons, ...]:
    """The buttons that each action holds, by action.

    buttons: one button each, in the scenario's order (thesis 3.3).
    combinations: every set of buttons without a contradiction, the empty one first, then by size (LevDoom's sets:
        6, 6, 12 and 6 actions).
    unified_v1: `UNIFIED_V1`, the same actions in all scenarios (thesis 6.1.1). An action with a button that the
        scenario does not have holds none, and `action_mask` forbids it.
    multi_discrete_v1: all products of `AXES_V1`, in C order; buttons that the scenario does not have are left out.
    """
    if action_set == "buttons":
        return tuple((button,) for button in scenario.buttons)
    if action_set == "combinations":
        buttons = scenario.buttons if scenario.combination_buttons is None else scenario.combination_buttons
        sets = chain.from_iterable(combinations(buttons, size) for size in range(len(buttons) + 1))
        return tuple(held for held in sets if not any(pair <= set(held) for pair in _CONTRADICTORY))
    if action_set == "multi_discrete_v1":
        return tuple(tuple(b for b in held if b in scenario.buttons) for held in _FIXED[action_set])
    allowed = action_mask(scenario, action_set)
    return tuple(held if one else () for held, one in zip(_FIXED[action_set], allowed, strict=True))


def choice_mask(scenario: Scenario, action_set: ActionSet) -> tuple[bool, ...]:
    """Whether the scenario allows each action; of a MultiDiscrete action, each choice of each axis in turn."""
    if action_set == "multi_discrete_v1":
        return tuple(button in ("", *scenario.buttons) for axis in AXES_V1 for button in axis)
    return action_mask(scenario, action_set)


def action_mask(scenario: Scenario, action_set: ActionSet) -> tuple[bool, ...]:
    """Whether the scenario allows each action: it has all of the action's buttons. Allowed actions all differ, except
    those of multi_discrete_v1, which allows everything.
    """
    if action_set != "unified_v1":
        return (True,) * len(action_buttons(scenario, action_set))
    return tuple(set(held) <= set(scenario.buttons) for held in _FIXED[action_set])
