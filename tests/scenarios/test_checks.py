"""What a scenario must have, and what is said where it has not."""

import dataclasses
from typing import Any

import pytest

from gvz.core.errors import ConfigError, TaskError
from gvz.scenarios.base import Attribute, Content, Textures, Thing
from gvz.scenarios.rewards import Fell, Pace, Reward, living
from gvz.tasks import scenario_named

ICE = Attribute(name="ice", groups=("textures",), content=Content(textures=Textures("FLAT14", "A", "B")))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"name": "gore"}, r"got the name 'gore', which 'gore' has; want another one"),
        ({"aliases": ("fast",)}, r"got the name 'fast', which 'fast_enemies' has"),
        ({"name": "on+ice"}, r"got the name 'on\+ice', want lower-case letters, digits and '_'"),
        ({"name": "ice=1"}, r"got the name 'ice=1', want lower-case"),
        ({"name": "Ice"}, r"got the name 'Ice', want lower-case"),
        ({"name": "varied"}, r"got the name 'varied', want .* none of default, complete, varied, procedural"),
        ({"groups": "map"}, r"\.groups: got 'map', want a tuple, such as \('map',\)"),
        ({"groups": ["map"]}, r"\.groups: got \['map'\], want a tuple$"),
        ({"aliases": "ice_cold"}, r"\.aliases: got 'ice_cold', want a tuple"),
        ({"content": {"textures": ICE.content.textures}}, r"\.content: got {.*}, want Content"),
        ({"content": Content(textures=("A", "B", "C"))}, r"content\.textures: got \('A', 'B', 'C'\), want Textures"),
        ({"content": Content(entity={"ScaleX": None})}, r"content\.entity\['ScaleX'\]: got None, want bool \| int"),
        (
            {"content": Content(things={"defend_the_center.wad": Thing(35, 0, 0)})},
            r"content\.things\['defend_the_center\.wad'\]: got Thing\(.*\), want a tuple, such as \(Thing",
        ),
        (
            {"content": Content(things={"defend_the_center.wad": [Thing(35, 0, 0)]})},
            r"content\.things\['defend_the_center\.wad'\]: got \[Thing\(.*\)\], want a tuple$",
        ),
        ({"content": Content(parameters={"places": [1.0, 2.0]})}, r"parameters\['places'\]: got \[1\.0, 2\.0\], want"),
        (
            {"content": Content(textures=Textures("FLAT14", "-", "FLAT14"))},
            r"got Textures\(.*'-'.*, want three textures",
        ),
        ({"groups": ()}, r"got no group"),
        (
            {"groups": ("texture",)},
            r"got the group 'texture' \(did you mean 'textures'\?\), want one of decorations, entity",
        ),
    ],
)
def test_an_attribute_whose_name_or_groups_would_make_another_task_is_refused(changes: dict[str, Any], message: str):
    scenario = scenario_named("defend_the_center")
    with pytest.raises((TaskError, ConfigError), match=f"scenario defend_the_center, attribute .*{message}"):
        dataclasses.replace(scenario, attributes=(*scenario.attributes, dataclasses.replace(ICE, **changes)))


def test_an_attribute_may_have_a_group_of_its_own():
    scenario = scenario_named("defend_the_center")
    for group in ("weather", "entity_height", "floor_textures"):
        dataclasses.replace(scenario, attributes=(*scenario.attributes, dataclasses.replace(ICE, groups=(group,))))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"levdoom_tasks": {"stone_wall+gore": Content()}},
            r"levdoom_tasks: got 'stone_wall\+gore', want .*'gore\+ston",
        ),
        ({"levdoom_tasks": {"fast": Content()}}, "got 'fast', want the task's name, 'fast_enemies'"),
        ({"levdoom_tasks": {"gor": Content()}}, "unknown attribute 'gor'"),
        ({"complete": ("gore", "fast")}, "complete: got 'fast', want the attribute's name, 'fast_enemies'"),
        ({"content": Content(base_wad="basic.wad")}, "got a content without base_wad or textures"),
        ({"content": Content(textures=ICE.content.textures)}, "got a content without base_wad or textures"),
        ({"metric": "kill"}, "metric: got 'kill', want one of frames_alive, kills, goals"),
        ({"suite": "mine"}, "suite: got 'mine', want one of core, extended"),
        ({"buttons": "ATTACK"}, r"buttons: got 'ATTACK', want a tuple, such as \('ATTACK',\)"),
        ({"buttons": (), "combination_buttons": None}, "got no button, want one or more"),
        ({"timeouts": 1100}, "timeouts: got 1100, want a mapping"),
        ({"timeouts": {"thesis": 1100.5, "levdoom": 1100}}, r"timeouts\['thesis'\]: got 1100\.5, want int"),
        ({"variety": 3}, "variety: got 3, want Variety"),
        ({"draw_map": 3}, "draw_map: got 3, want a function"),
        ({"splits": {}}, "splits: got no task for train1, want one or more"),
        (
            {"splits": dict.fromkeys(("train1", "train4", "train8", "test"), ("default", "gor"))},
            r"splits, train1: got 'gor' \(did you mean 'gore'\?\), want some of its tasks: default, gore",
        ),
        ({"splits": {"train2": ("gore",)}}, "splits: got 'train2', want one of train1, train4, train8, test"),
        (
            {"timeouts": {"thesis": 1100}},
            "got timeouts {'thesis': 1100}, want a positive one for each profile",
        ),
        ({"upper_bounds": {"thesis": 0, "levdoom": 1}}, "got upper_bounds .*, want a positive one for each"),
        ({"combination_buttons": ("ATTACK", "SPEED")}, "combination_buttons: got {'SPEED'}, want some of ATTACK, TURN"),
        (
            {"rewards": {"shells": Reward(event=Fell("AMMO3"), weight=-1.0, levdoom=-1.0)}},
            r"reward 'shells': got the variable 'AMMO3' \(did you mean 'AMMO2'\?\), which is not read; want one of",
        ),
        (
            {"rewards": {"alive": Reward(event=living, weight=1.0, levdoom=1.0, paces=(Pace(needs="ammo"),))}},
            "reward 'alive': got a pace that needs 'ammo', want one of alive",
        ),
        (
            {"rewards": {"alive": Reward(event=living, weight=1.0, levdoom=1.0, paces=(Pace(tics=0),))}},
            r"reward 'alive': got Pace\(tics=0, .*\), want more than 0 tics and more than 0 times",
        ),
    ],
)
def test_a_scenario_whose_parts_do_not_fit_together_is_refused(changes: dict[str, Any], message: str):
    with pytest.raises((TaskError, ConfigError), match=f"scenario defend_the_center.*{message}"):
        dataclasses.replace(scenario_named("defend_the_center"), **changes)
