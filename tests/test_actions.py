"""Action sets: what each action holds."""

import pytest

from gvz.actions import action_buttons
from gvz.tasks import scenario_named, scenarios

UNIFIED = ("ATTACK", "MOVE_FORWARD", "MOVE_LEFT", "MOVE_RIGHT", "SPEED", "TURN_LEFT", "TURN_RIGHT")


@pytest.mark.parametrize(
    ("scenario", "sizes"),
    [
        ("defend_the_center", (3, 6, 7)),
        ("health_gathering", (3, 6, 7)),
        ("seek_and_kill", (5, 12, 7)),
        ("dodge_projectiles", (3, 6, 7)),
    ],
)
def test_sizes_are_the_thesiss_and_levdooms(scenario: str, sizes: tuple[int, int, int]):
    one = scenario_named(scenario)
    assert tuple(len(action_buttons(one, name)) for name in ("buttons", "combinations", "unified")) == sizes


def test_defend_the_center_by_hand():
    scenario = scenario_named("defend_the_center")
    assert action_buttons(scenario, "buttons") == (("ATTACK",), ("TURN_LEFT",), ("TURN_RIGHT",))
    assert action_buttons(scenario, "combinations") == (
        (),
        ("ATTACK",),
        ("TURN_LEFT",),
        ("TURN_RIGHT",),
        ("ATTACK", "TURN_LEFT"),
        ("ATTACK", "TURN_RIGHT"),
    )
    assert action_buttons(scenario, "unified") == (("ATTACK",), (), (), (), (), ("TURN_LEFT",), ("TURN_RIGHT",))


@pytest.mark.parametrize("scenario", scenarios().values(), ids=scenarios())
def test_action_sets_hold_only_the_scenarios_buttons(scenario):
    for action_set in ("buttons", "combinations", "unified"):
        actions = action_buttons(scenario, action_set)
        assert {button for held in actions for button in held} <= set(scenario.buttons)
    combinations = action_buttons(scenario, "combinations")
    assert len(set(combinations)) == len(combinations)
    assert not any({"TURN_LEFT", "TURN_RIGHT"} <= set(h) or {"MOVE_LEFT", "MOVE_RIGHT"} <= set(h) for h in combinations)


@pytest.mark.parametrize("scenario", scenarios().values(), ids=scenarios())
def test_a_unified_action_is_the_same_button_everywhere(scenario):
    actions = action_buttons(scenario, "unified")
    assert [held or (button,) for held, button in zip(actions, UNIFIED, strict=True)] == [(b,) for b in UNIFIED]
