"""Discrete actions: the buttons that each action of a scenario holds."""

from itertools import chain, combinations
from typing import assert_never

from gvz.core.env_config import ActionSet
from gvz.scenarios.base import Scenario
from gvz.tasks import scenarios

_CONTRADICTORY = ({"TURN_LEFT", "TURN_RIGHT"}, {"MOVE_LEFT", "MOVE_RIGHT"}, {"MOVE_FORWARD", "MOVE_BACKWARD"})


def action_buttons(scenario: Scenario, action_set: ActionSet) -> tuple[tuple[str, ...], ...]:
    """The buttons that each action holds, by action.

    buttons: one button each, in the scenario's order (thesis 3.3).
    combinations: every set of buttons without a contradiction, the empty one first, then by size (LevDoom's sets:
        6, 6, 12 and 6 actions).
    unified: one button each, of all scenarios together, in alphabetical order. If the scenario does not have
        the button, the action holds none (thesis 6.1.1).
    """
    match action_set:
        case "buttons":
            return tuple((button,) for button in scenario.buttons)
        case "combinations":
            buttons = scenario.buttons if scenario.combination_buttons is None else scenario.combination_buttons
            sets = chain.from_iterable(combinations(buttons, size) for size in range(len(buttons) + 1))
            return tuple(held for held in sets if not any(pair <= set(held) for pair in _CONTRADICTORY))
        case "unified":
            everything = sorted({button for one in scenarios().values() for button in one.buttons})
            return tuple((button,) if button in scenario.buttons else () for button in everything)
        case _:
            assert_never(action_set)
