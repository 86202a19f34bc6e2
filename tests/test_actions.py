"""Action sets: what each action holds."""

from typing import get_args

import pytest

from gvz.actions import AXES_V1, UNIFIED_V1, action_buttons, action_mask
from gvz.core.env_config import ActionSet
from gvz.tasks import all_scenarios, scenario_named

LISTED = """
-
ATTACK / MOVE_FORWARD / MOVE_BACKWARD / MOVE_LEFT / MOVE_RIGHT / TURN_LEFT / TURN_RIGHT / USE
ATTACK MOVE_FORWARD / ATTACK MOVE_LEFT / ATTACK MOVE_RIGHT / ATTACK TURN_LEFT / ATTACK TURN_RIGHT
MOVE_FORWARD TURN_LEFT / MOVE_FORWARD TURN_RIGHT / SPEED MOVE_FORWARD / SPEED MOVE_LEFT / SPEED MOVE_RIGHT
ATTACK MOVE_FORWARD TURN_LEFT / ATTACK MOVE_FORWARD TURN_RIGHT
"""
"""Version 1, as policies of version 1 were trained with it. This text never changes."""


@pytest.mark.parametrize(
    ("scenario", "sizes"),
    [
        ("defend_the_center", (3, 6, 6)),
        ("health_gathering", (3, 6, 6)),
        ("seek_and_kill", (5, 12, 13)),
        ("dodge_projectiles", (3, 6, 5)),
    ],
)
def test_sizes_are_the_thesiss_and_levdooms(scenario: str, sizes: tuple[int, int, int]):
    one = scenario_named(scenario)
    assert tuple(sum(action_mask(one, name)) for name in ("buttons", "combinations", "unified_v1")) == sizes


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


@pytest.mark.parametrize("scenario", all_scenarios().values(), ids=all_scenarios())
def test_action_sets_hold_only_the_scenarios_buttons(scenario):
    for action_set in get_args(ActionSet):
        actions = action_buttons(scenario, action_set)
        assert {button for held in actions for button in held} <= set(scenario.buttons)
    combinations = action_buttons(scenario, "combinations")
    assert len(set(combinations)) == len(combinations)
    assert not any({"TURN_LEFT", "TURN_RIGHT"} <= set(h) or {"MOVE_LEFT", "MOVE_RIGHT"} <= set(h) for h in combinations)


def test_version_1_is_frozen():
    listed = tuple(tuple(one.split()) for one in LISTED.strip().replace("-", "", 1).replace("\n", "/").split("/"))
    assert listed == UNIFIED_V1
    assert len(set(map(frozenset, UNIFIED_V1))) == len(UNIFIED_V1)
    assert (
        *(("", "TURN_LEFT", "TURN_RIGHT"), ("", "MOVE_FORWARD", "MOVE_BACKWARD"), ("", "MOVE_LEFT", "MOVE_RIGHT")),
        *(("", "ATTACK"), ("", "USE"), ("", "SPEED")),
    ) == AXES_V1


@pytest.mark.parametrize("scenario", all_scenarios().values(), ids=all_scenarios())
def test_a_unified_action_is_the_same_everywhere_or_forbidden(scenario):
    held, mask = action_buttons(scenario, "unified_v1"), action_mask(scenario, "unified_v1")
    assert [one for one, allowed in zip(held, mask, strict=True) if allowed] == [
        one for one in UNIFIED_V1 if set(one) <= set(scenario.buttons)
    ]
    assert all(not one for one, allowed in zip(held, mask, strict=True) if not allowed)
    assert mask[0], "doing nothing is allowed"
    assert {button for one in held for button in one} == set(scenario.buttons), "no button is lost"
