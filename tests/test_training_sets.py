"""The training sets, the gate set and the test set, against the thesis and the rules of the sets."""

import pytest

from gvz.tasks import all_scenarios, named_tasks, parse_task, scenarios

TEST_SETS = {
    "defend_the_center": "gore+mossy_bricks, resized+fuzzy, stone_wall+flying, resized+flying+mossy_bricks, "
    "gore+stone_wall+fuzzy, fast+resized+gore, complete",
    "health_gathering": "slime+obstacles, shaded+stimpacks, supreme+poison, lava+supreme+short_agent, "
    "obstacles+slime+stimpacks, poison+resized+shaded_kits, complete",
    "seek_and_kill": "blue+shadows, obstacles+resized, red+mixed, blue+mixed+resized, red+obstacles+invulnerable, "
    "resized+shadows+invulnerable, complete",
    "dodge_projectiles": "revenants, city+resized_agent, barons+flaming_skulls, flames+flaming_skulls+mancubus, "
    "resized_agent+revenants, city+arachnotron, complete",
    "find_ammunition": "metal+obstacles, boxes+glowing, maze+wrong, stone_wall+maze+boxes, obstacles+metal+imps, "
    "wrong+resized+fast, complete",
    "find_the_key": "moss+obstacles, glowing+skulls, maze+decoys, bricks+maze+short_agent, obstacles+moss+skulls, "
    "decoys+resized+glowing, complete",
    "guarded_goal": "moss+obstacles, knights+shadows, traps+city, flying+moss+traps, sergeants+obstacles+resized, "
    "knights+city+short_agent, complete",
    "rockets": "blue+barrels, fast+flying, resized+hell_knights, stone_wall+fast+obstacles, obstacles+flying+resized, "
    "slime+hell_knights+glowing, complete",
}


def test_training_sets_grow_and_share_nothing_with_the_test_set():
    for scenario in all_scenarios():
        one, four, eight = (
            set(named_tasks(scenario, split="train1")),
            set(named_tasks(scenario, split="train4")),
            set(named_tasks(scenario, split="train8")),
        )
        test = set(named_tasks(scenario, split="test"))
        assert (len(one), len(four), len(eight), len(test)) == (1, 4, 8, 7)
        assert one < four < eight
        assert not eight & test
        assert test == {parse_task(f"{scenario}/{name}") for name in TEST_SETS[scenario].split(", ")}


def test_the_pairs_of_the_eight_training_tasks_are_all_that_have_no_name():
    *eight, first = (task.name for task in named_tasks("dodge_projectiles", split="pairs")[:9])
    assert eight == "default city flames flaming_skulls mancubus barons cacodemons resized_agent".split()
    names = {task.name for task in named_tasks("dodge_projectiles", split="pairs")} - set(eight)
    assert first in names
    # flames and city are both the map's theme, and mancubus, barons and cacodemons are all the enemy
    assert names == set(
        "city+flaming_skulls city+mancubus barons+city cacodemons+city flames+flaming_skulls flames+mancubus "
        "barons+flames flames+resized_agent flaming_skulls+mancubus cacodemons+flaming_skulls "
        "flaming_skulls+resized_agent barons+resized_agent cacodemons+resized_agent".split()
    )


@pytest.mark.parametrize("split", ["pairs", "compositions"])
@pytest.mark.parametrize("scenario", all_scenarios())
def test_composed_sets_bring_no_new_attribute_and_no_task_that_others_are_scored_on(scenario, split):
    eight, composed = named_tasks(scenario, split="train8"), named_tasks(scenario, split=split)
    added = set(composed) - set(eight)
    assert composed[:8] == eight
    assert len(set(composed)) == len(composed)
    assert {name for task in added for name in task.attributes} <= {task.name for task in eight}
    assert {task.level for task in added} == {2, 3, 4} if split == "compositions" else {2}
    assert not added & set(named_tasks(scenario))


def test_compositions_are_all_that_have_no_name():
    # of each group one or none: three textures, two decorations, four enemies, two heights of the agent, less those
    # that have a name: default, 7 of level 1, 2 gate tasks, and 3 test tasks whose attributes are all trained on
    assert len(named_tasks("dodge_projectiles", split="compositions")) == 8 + 3 * 2 * 4 * 2 - 8 - 2 - 3


def test_the_gate_set_is_of_level_2_and_in_no_other_set():
    sizes = {"defend_the_center": 3, "health_gathering": 4, "seek_and_kill": 3, "dodge_projectiles": 3}
    assert {scenario: len(named_tasks(scenario, split="gate")) for scenario in scenarios()} == sizes
    for task in named_tasks(split="gate"):
        others = [name for name in ("train1", "train4", "train8", "test") if task in named_tasks(split=name)]
        assert (task.level, others) == (2, [])
    assert named_tasks(level=3, split="gate") == ()
    left = [task for task in named_tasks(level=2) if task not in named_tasks(split="test")]
    assert list(named_tasks(level=2, split="gate")) == left


def test_the_main_job_trains_on_default_gore_stone_wall_and_fast_enemies():
    names = [task.name for task in named_tasks("defend_the_center", split="train4")]
    assert names == ["default", "gore", "stone_wall", "fast_enemies"]
