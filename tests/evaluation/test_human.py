"""Which keys are which buttons, and which action some pressed buttons are."""

import pytest

from gvz.actions import action_buttons
from gvz.core.errors import ConfigError
from gvz.evaluation.human import key_buttons, key_help, nearest_action
from gvz.tasks import all_scenarios


@pytest.mark.parametrize("scenario", all_scenarios().values(), ids=str)
def test_every_action_has_its_keys(scenario):
    actions = action_buttons(scenario, "combinations")
    key_of = {button: key for key, button in key_buttons(actions).items()}
    for action, held in enumerate(actions):
        assert len({key_of[button] for button in held}) == len(held)
        assert nearest_action(actions, held) == nearest_action(actions, held[::-1]) == action


def test_letters_do_what_arrows_do_unless_the_agent_can_also_step_aside():
    turns, steps = ("TURN_LEFT", "TURN_RIGHT"), ("MOVE_LEFT", "MOVE_RIGHT")
    assert key_buttons([turns]) == key_buttons([(name,) for name in turns])
    assert {key_buttons([turns])[key] for key in ("left", "a")} == {"TURN_LEFT"}
    assert {key_buttons([steps])[key] for key in ("left", "a")} == {"MOVE_LEFT"}
    both = {"left": "TURN_LEFT", "right": "TURN_RIGHT", "a": "MOVE_LEFT", "d": "MOVE_RIGHT"}
    assert key_buttons([turns, steps]) == both


def test_keys_are_told_by_button():
    assert key_help(((), ("ATTACK",), ("TURN_LEFT", "ATTACK"))) == ["attack: space, left ctrl", "turn left: left, a"]


def test_a_button_without_a_key_is_an_error():
    with pytest.raises(ConfigError, match=r"no key stands for LOOK_UP, LOOK_DOWN; add it to KEYS in gvz/"):
        key_buttons([("ATTACK",), ("LOOK_UP", "LOOK_DOWN")])


ACTIONS = ((), ("ATTACK",), ("TURN_LEFT",), ("TURN_RIGHT",), ("ATTACK", "TURN_LEFT"), ("ATTACK", "TURN_RIGHT"))


@pytest.mark.parametrize(
    ("pressed", "action"),
    [
        ((), 0),
        (("TURN_LEFT", "TURN_RIGHT"), 3),  # 2 and 3 differ by one button each; the right turn came last
        (("TURN_RIGHT", "TURN_LEFT"), 2),
        (("TURN_LEFT", "TURN_RIGHT", "ATTACK"), 5),
        (("ATTACK", "TURN_RIGHT", "TURN_LEFT"), 4),
        (("ATTACK", "MOVE_FORWARD"), 1),  # one button too few, where 4 has one too many besides
        (("MOVE_FORWARD",), 0),
    ],
)
def test_the_nearest_action_differs_by_fewest_buttons_and_then_has_the_last_one(pressed, action):
    assert nearest_action(ACTIONS, pressed) == action
