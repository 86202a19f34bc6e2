"""Names, levels and splits of tasks, against the thesis's appendix A."""

import dataclasses
import doctest
import functools
import pickle
from pathlib import Path
from typing import Any

import cloudpickle
import gymnasium
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import gvz
import gvz.scenarios
from gvz.commands.tasks import task_row
from gvz.core.errors import ConfigError, TaskError
from gvz.scenarios.base import Attribute, Content, Task, Textures
from gvz.scenarios.compiler import task_content
from gvz.scenarios.map_set import PARTS, MapSet
from gvz.tasks import all_scenarios, named_tasks, parse_task, scenario_named, scenarios

LEVELS = {  # tasks of level 0, 1, 2, 3, 4
    "defend_the_center": (1, 7, 6, 3, 1),
    "health_gathering": (1, 10, 7, 3, 1),
    "seek_and_kill": (1, 7, 6, 3, 1),
    "dodge_projectiles": (1, 7, 6, 3, 1),
}
LATER = {  # those of the suite `extended`, and how many of level 2 are in the gate set
    "find_ammunition": ((1, 10, 5, 3, 1), 2),
    "find_the_key": ((1, 10, 7, 3, 1), 4),
    "guarded_goal": ((1, 10, 5, 3, 1), 2),
    "rockets": ((1, 9, 5, 3, 1), 2),
}


@st.composite
def attribute_sets(draw: st.DrawFn) -> tuple[str, list[str]]:
    """A scenario and some of its attributes, at most one of a group, in any order."""
    scenario = draw(st.sampled_from(sorted(all_scenarios().values(), key=lambda one: one.id)))
    chosen: list[str] = []
    taken: set[str] = set()
    for attribute in draw(st.permutations(scenario.attributes)):
        if not taken.intersection(attribute.groups) and draw(st.booleans()):
            chosen.append(draw(st.sampled_from((attribute.name, *attribute.aliases))))
            taken.update(attribute.groups)
    return scenario.id, chosen


def test_there_are_76_named_tasks_with_the_levels_of_the_thesis():
    assert len(named_tasks()) == 76
    assert len({task.id for task in named_tasks()}) == 76
    for scenario, counts in LEVELS.items():
        assert tuple(len(named_tasks(scenario, level=level)) for level in range(5)) == counts


def test_later_scenarios_are_in_a_suite_of_their_own():
    """What published scores are of does not grow when a scenario is added."""
    assert set(scenarios()) == set(LEVELS)
    assert set(scenarios("extended")) == set(LATER) == set(all_scenarios()) - set(scenarios())
    assert {task.scenario.id for task in named_tasks()} == set(LEVELS)
    later = named_tasks(suite="extended")
    assert {task.scenario.id for task in later} == set(LATER)
    for scenario, (counts, num_gate) in LATER.items():
        assert tuple(task for task in later if task.scenario.id == scenario) == named_tasks(scenario)
        assert tuple(len(named_tasks(scenario, level=level)) for level in range(5)) == counts
        assert len(named_tasks(scenario, split="gate")) == num_gate


def test_revenants_and_arachnotron_are_level_2_though_one_attribute():
    assert parse_task("dodge_projectiles/revenants").level == 2
    assert parse_task("dodge_projectiles/arachnotron").level == 2
    assert parse_task("dodge_projectiles/city+arachnotron").level == 3


def test_four_and_more_attributes_are_level_4():
    assert parse_task("seek_and_kill/blue+obstacles+shadows+mixed_enemies").level == 4
    for scenario in all_scenarios():
        assert parse_task(f"{scenario}/complete").level == 4


def test_complete_has_exactly_one_attribute_of_every_group():
    for scenario in all_scenarios().values():
        groups = [group for name in scenario.complete for group in scenario.attribute(name).groups]
        assert sorted(groups) == sorted({group for one in scenario.attributes for group in one.groups})


@given(attribute_sets())
def test_any_set_with_at_most_one_attribute_a_group_is_a_task_in_any_order(chosen: tuple[str, list[str]]):
    scenario, names = chosen
    task = parse_task(f"{scenario}/{'+'.join(names) or 'default'}")
    assert parse_task(task.id) == task
    assert task.attributes == tuple(sorted(scenario_named(scenario).attribute(name).name for name in names))
    assert task == parse_task(f"{scenario}/{'+'.join(reversed(names)) or 'default'}")
    assert str(task) == task.id
    for profile in ("thesis", "levdoom"):
        content = task_content(task, profile)
        assert content.textures is not None


@pytest.mark.parametrize("pickler", [pickle, cloudpickle], ids=["pickle", "cloudpickle"])
def test_tasks_and_scenarios_survive_pickling(pickler):
    for scenario in all_scenarios().values():
        assert pickle.loads(pickler.dumps(scenario)) == scenario
    for task in named_tasks():
        again = pickle.loads(pickler.dumps(task))
        assert (again, hash(again), again.id) == (task, hash(task), task.id)
        assert again.scenario.make_rewarder().weights == task.scenario.make_rewarder().weights
    one, other = scenario_named("seek_and_kill"), scenario_named("health_gathering")
    assert one != other
    assert one != dataclasses.replace(one, timeouts={"thesis": 1, "levdoom": 1})


@pytest.mark.engine
def test_a_task_of_ones_own_plays_in_a_spawned_process():
    centre = scenario_named("defend_the_center")
    ice = Attribute(
        name="ice", groups=("textures",), content=Content(textures=Textures("FLAT14", "FWATER1", "CEIL4_3"))
    )
    task = Task(dataclasses.replace(centre, attributes=(*centre.attributes, ice)), ("gore", "ice"))
    make = functools.partial(gvz.make, task)
    envs = gymnasium.vector.AsyncVectorEnv([make], context="spawn", shared_memory=False)
    frames, _ = envs.reset(seed=1)
    (there,) = envs.call("task")
    envs.close()
    here = make()
    np.testing.assert_array_equal(frames[0], here.reset(seed=1)[0])
    here.close()
    assert there == task


def test_ids_are_canonical():
    task = parse_task("defend_the_center/mossy_bricks+gore")
    assert task.id == "defend_the_center/gore+mossy_bricks"
    assert parse_task("defend_the_center/fast+flying").id == "defend_the_center/fast_enemies+flying_enemies"
    assert parse_task("health_gathering/resized+shaded_kits").attributes == ("resized_kits", "shaded_kits")
    assert parse_task("seek_and_kill/default").attributes == ()


def test_a_varied_task_has_a_number_of_maps_and_is_none_of_the_named_ones():
    for scenario in all_scenarios():
        varied, ten = parse_task(f"{scenario}/varied"), parse_task(f"{scenario}/varied-10")
        assert varied.maps is not None
        assert ten.maps is not None
        assert (varied.maps.num_maps, varied.name, varied.level, varied.attributes) == (1000, "varied", 0, ())
        assert (ten.maps.num_maps, ten.id) == (10, f"{scenario}/varied-10")
        assert parse_task(f"{scenario}/varied-1000") == varied
        assert pickle.loads(pickle.dumps(ten)) == ten != varied
        assert not {varied, ten} & set(named_tasks())


def test_a_scenario_that_does_not_say_what_may_differ_has_no_varied_task():
    centre = scenario_named("defend_the_center")
    plain = dataclasses.replace(centre, variety=None)
    with pytest.raises(TaskError, match="defend_the_center: got varied, but the scenario has no variety"):
        Task(plain, maps=MapSet("varied"))
    assert "varied" not in plain.choices()
    with pytest.raises(TaskError, match="got procedural-train and gore, want one of them; 'varied' takes attributes"):
        Task(centre, ("gore",), MapSet("train"))
    with pytest.raises(TaskError, match="varied--1: want 1 to 1000 maps"):
        MapSet("varied", -1)


def test_a_varied_task_may_have_attributes_but_none_of_textures():
    task = parse_task("defend_the_center/varied-10+resized+gore")
    assert task.maps == MapSet("varied", 10)
    assert (task.attributes, task.level) == (("gore", "resized_enemies"), 2)
    assert task.id == "defend_the_center/varied-10+gore+resized_enemies"
    assert parse_task(task.id) == task == pickle.loads(pickle.dumps(task))
    graded = parse_task("defend_the_center/varied+gore=0.5")
    assert (graded.id, graded.severity("gore")) == ("defend_the_center/varied+gore=0.5", 0.5)


def test_a_procedural_task_has_a_split_a_number_of_maps_and_strengths():
    task = parse_task("seek_and_kill/procedural")
    assert task == parse_task("seek_and_kill/procedural-train")
    assert (task.id, task.level) == ("seek_and_kill/procedural-train", 0)
    some = parse_task("seek_and_kill/procedural-test-20+lights=0+layout=0.50+textures=1.0")
    assert some.id == "seek_and_kill/procedural-test-20+layout=0.5+lights=0"
    assert parse_task(some.id) == some
    assert pickle.loads(pickle.dumps(some)) == some
    assert some.maps is not None
    assert [some.maps.strength(part) for part in PARTS] == [0.5, 1, 1, 0, 1]
    assert [some.maps.number_of(seed) for seed in (0, 19, 20, 45)] == [0, 19, 0, 5]


def test_no_two_splits_share_a_map():
    first = {split: MapSet(split).number_of(0) for split in ("test", "validation", "train")}
    assert first == {"test": 0, "validation": 1_000_000, "train": 2_000_000}
    last = {split: MapSet(split).number_of(MapSet(split).num_maps - 1) for split in first}
    assert last == {"test": 999_999, "validation": 1_999_999, "train": 2**31 - 1}
    ten = MapSet("train", 10)
    assert {ten.number_of(seed) for seed in range(1000)} == set(range(2_000_000, 2_000_010))


def test_all_of_complete_spelled_out_is_complete():
    names = "+".join(reversed(scenario_named("seek_and_kill").complete))
    assert parse_task(f"seek_and_kill/{names}").id == "seek_and_kill/complete"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("defend_the_center", "want '<scenario>/<task>'.*scenarios: defend_the_center, dodge_projectiles"),
        ("defend_the_center/", "want '<scenario>/<task>'"),
        ("defend_center/gore", r"unknown scenario 'defend_center' \(did you mean 'defend_the_center'\?\); want one"),
        ("defend_the_center/goer", r"unknown attribute 'goer' \(did you mean 'gore'\?\); want default, complete"),
        ("defend_the_center/lava", "unknown attribute 'lava'; want .*textures: mossy_bricks, stone_wall"),
        ("health_gathering/lava+slime", "lava and slime are both of group textures"),
        ("health_gathering/lava+lava", "lava and lava are both of group textures"),
        ("health_gathering/complete+lava", "'complete' is a task and no attribute; want default, complete, or at most"),
        ("defend_the_center/default+gore", r"'default' is a task and no attribute; want .* \(decorations: gore; "),
        (None, "task: got None, want '<scenario>/<task>'"),
        ("dodge_projectiles/revenants+arachnotron", "both of group entity_type"),
        ("health_gathering/lava++slime", "unknown attribute ''"),
        (
            "defend_the_center/varid",
            r"unknown attribute 'varid' \(did you mean 'varied'\?\).* varied-<number of maps>, procedural-<split>",
        ),
        ("defend_the_center/varied+stone_wall", "got varied and stone_wall, but textures are drawn"),
        ("defend_the_center/varied+layout=0.5", "unknown attribute 'layout'"),
        ("defend_the_center/varied+complete", "'complete' is a task and no attribute"),
        ("defend_the_center/varied+varied", "'varied' is a task and no attribute"),
        ("defend_the_center/varied+", "unknown attribute ''"),
        ("defend_the_center/gore+varied-10", "'varied-10' is a task and no attribute"),
        ("seek_and_kill/varied-0", "got 'varied-0', want 'varied-<number of maps>', as 'varied-10'"),
        ("seek_and_kill/varied-1001", "varied-1001: want 1 to 1000 maps"),
        ("seek_and_kill/varied=10", "got 'varied=10', want 'varied-<number of maps>', as 'varied-10'"),
        ("seek_and_kill/procedural=0.5", "got 'procedural=0.5', want 'procedural-<split>-<number of maps>'"),
        ("seek_and_kill/varied-ten", "got 'varied-ten', want 'varied-<number of maps>'"),
        ("seek_and_kill/procedural-", "got 'procedural-', want 'procedural-<split>-<number of maps>'"),
        (
            "seek_and_kill/procedural-trian",
            r"unknown split 'trian' \(did you mean 'train'\?\); want one of test, valid",
        ),
        ("seek_and_kill/procedural-varied", "unknown split 'varied'"),
        ("seek_and_kill/procedural-test-2000000", "procedural-test-2000000: want 1 to 1000000 maps"),
        ("seek_and_kill/procedural-test-20-3", "want 'procedural-<split>-<number of maps>'"),
        ("seek_and_kill/procedural+layout=1.5", r"got layout=1.5, want a strength from 0 .* to 1"),
        ("seek_and_kill/procedural+layout=0.1234", "got layout=0.1234, want .* with at most three decimals"),
        ("seek_and_kill/procedural+layout=nan", "got 'layout=nan' in .*strengths from 0 to 1"),
        (
            "seek_and_kill/procedural+gore",
            "got 'gore' in 'procedural[+]gore', want each at most once: '<part>=.*attributes go with 'varied' alone",
        ),
        ("seek_and_kill/procedural+layout=1+layout=0", "got 'layout=0' in .* at most once"),
        ("seek_and_kill/procedural+light=1", r"unknown part 'light' \(did you mean 'lights'\?\); want one of layout, "),
    ],
)
def test_what_is_no_task_is_refused_with_what_is_possible(text: str, message: str):
    with pytest.raises(TaskError, match=message):
        parse_task(text)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"num_maps": 2.5}, "procedural-train.num_maps: got 2.5, want int"),
        ({"num_maps": "10"}, "num_maps: got '10', want int"),
        ({"strengths": (("layout", "0.5"),)}, "strengths, .*: got '0.5', want float"),
        ({"strengths": {"layout": 0.5}}, "strengths: got {'layout': 0.5}, want a list"),
    ],
)
def test_a_map_set_whose_fields_have_other_types_is_refused(fields: dict[str, Any], message: str):
    with pytest.raises(ConfigError, match=message):
        MapSet("train", **fields)


def test_unknown_selections_of_named_tasks_are_refused():
    with pytest.raises(TaskError, match=r"level: got 5, want 0\.\.4"):
        named_tasks(level=5)
    with pytest.raises(
        TaskError,
        match="split: got 'train2', want one of train1, train4, train8, pairs, compositions, train8_varied, test",
    ):
        named_tasks(split="train2")
    with pytest.raises(TaskError, match="unknown scenario 'seek'"):
        named_tasks("seek")


def test_the_set_on_varied_maps_has_the_eight_tasks_and_those_without_textures_on_varied_maps():
    found = [task.id for task in named_tasks("seek_and_kill", split="train8_varied")]
    assert found[:8] == [task.id for task in named_tasks("seek_and_kill", split="train8")]
    assert found[1:3] == ["seek_and_kill/blue", "seek_and_kill/red"], "of textures alone"
    names = ("", "+obstacles", "+resized_enemies", "+shadows", "+mixed_enemies", "+invulnerable")
    assert found[8:] == [f"seek_and_kill/varied{name}" for name in names]
    assert not set(named_tasks(split="train8_varied")) & {*named_tasks(split="test"), *named_tasks(split="gate")}


def test_a_scenario_without_varied_maps_has_no_set_on_them(monkeypatch: pytest.MonkeyPatch):
    plain = dataclasses.replace(scenario_named("seek_and_kill"), variety=None)
    monkeypatch.setattr("gvz.tasks.all_scenarios", lambda: {plain.id: plain})
    assert task_row(Task(plain))["sets"] == ["train1", "train4", "train8", "pairs", "compositions"]
    with pytest.raises(TaskError, match="seek_and_kill: got varied, but the scenario has no variety; set it"):
        named_tasks(plain.id, split="train8_varied")


def test_attributes_of_different_groups_do_not_fight_over_a_value():
    """In profile thesis, what a task is does not depend on the order its attributes stand in."""
    for scenario in all_scenarios().values():
        for one in scenario.attributes:
            for other in scenario.attributes:
                if one is other or set(one.groups) & set(other.groups) or "supreme" in (one.name, other.name):
                    continue  # the map `supreme` comes with textures and kits that others then change
                if {one.name, other.name} == {"fast_enemies", "flying_enemies"}:
                    continue  # flying_enemies takes back the other's damage factor (docs/benchmark/differences.md)
                both = one.content.overlaid(other.content)
                assert both == dataclasses.replace(other.content.overlaid(one.content), things=both.things)


def test_the_worked_example_of_adding_an_attribute_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path))
    result = doctest.testmod(gvz.scenarios)
    assert result.attempted >= 9
    assert result.failed == 0
    assert len(list(tmp_path.iterdir())) == 1


def test_an_added_attribute_obeys_its_group():
    scenario = scenario_named("defend_the_center")
    ice = Attribute(name="ice", groups=("textures",), content=Content(textures=Textures("FLAT14", "A", "B")))
    with_ice = dataclasses.replace(scenario, attributes=(*scenario.attributes, ice))
    with pytest.raises(TaskError, match="ice and stone_wall are both of group textures"):
        Task(with_ice, ("ice", "stone_wall"))


TABLE_3_1 = {
    "defend_the_center": (
        ("ATTACK", "TURN_LEFT", "TURN_RIGHT"),
        ("KILLCOUNT", "AMMO2", "HEALTH"),
        *("frames_alive", 1100, 1100, True),
    ),
    "health_gathering": (
        ("MOVE_FORWARD", "TURN_LEFT", "TURN_RIGHT"),
        ("HEALTH",),
        *("frames_alive", 2100, 2100, False),
    ),
    "seek_and_kill": (
        ("ATTACK", "SPEED", "MOVE_FORWARD", "TURN_LEFT", "TURN_RIGHT"),
        ("KILLCOUNT", "AMMO2", "HEALTH", "POSITION_X", "POSITION_Y"),
        *("kills", 20, 1200, True),
    ),
    "dodge_projectiles": (
        ("SPEED", "MOVE_LEFT", "MOVE_RIGHT"),
        ("HEALTH",),
        *("frames_alive", 2100, 2100, False),
    ),
}
"""buttons, variables, metric, its upper bound, time-out in frames, whether there is a weapon"""


@pytest.mark.parametrize("name", TABLE_3_1)
def test_a_scenario_is_the_thesiss_table_3_1(name: str):
    one = scenario_named(name)
    found = (one.buttons, one.game_variables, one.metric, one.upper_bound(), one.timeout_frames(), one.render_weapon)
    assert found == TABLE_3_1[name]
    assert one.timeout_frames("levdoom") == (1250 if name == "seek_and_kill" else 2100)
    assert one.upper_bound("levdoom") == (20 if name == "seek_and_kill" else 2100)


def test_the_maps_are_made_from_the_engines_own():
    assert {name: one.content.base_wad for name, one in scenarios().items()} == {
        "defend_the_center": "defend_the_center.wad",
        "health_gathering": "health_gathering.wad",
        "seek_and_kill": "health_gathering_supreme.wad",
        "dodge_projectiles": "defend_the_line.wad",
    }
