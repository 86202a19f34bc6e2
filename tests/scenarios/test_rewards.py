"""Rewards by hand, equation by equation, and the range of returns in real games."""

import math
import random

import numpy as np
import pytest

from gvz.engine import Engine, EngineConfig
from gvz.errors import ConfigError
from gvz.scenarios.base import BOOKKEEPING
from gvz.scenarios.compiler import compile_task
from gvz.specs import Profile
from gvz.tasks import parse_task, scenario_named, scenarios

ALIVE = {"KILLCOUNT": 0, "PLAYER_KILLS": 0, "AMMO2": 26, "HEALTH": 100, "POSITION_X": 0, "POSITION_Y": 0}
ALIVE |= {"POISONS_TAKEN": 0, "KITS_TAKEN": 0}


def one_step(scenario: str, change: dict[str, float], *, terminated: bool = False, **options) -> dict[str, float]:
    """The components of one decision that changed these variables."""
    rewarder = scenario_named(scenario).make_rewarder(**options)
    rewarder.reset(ALIVE)
    return rewarder.step({**ALIVE, **change}, terminated)


def test_defend_the_center_is_equation_3_3():
    nothing = one_step("defend_the_center", {})
    assert set(nothing) == {"kill", "player_kill", "death", "ammo_spent", "health_lost"}
    assert sum(nothing.values()) == 0
    assert sum(one_step("defend_the_center", {"KILLCOUNT": 1}).values()) == 1
    assert sum(one_step("defend_the_center", {"KILLCOUNT": 2}).values()) == 1  # an indicator, not a count
    assert sum(one_step("defend_the_center", {"AMMO2": 25}).values()) == pytest.approx(-0.1)
    assert sum(one_step("defend_the_center", {"HEALTH": 92}).values()) == pytest.approx(-0.2)
    last = one_step("defend_the_center", {"HEALTH": -6, "KILLCOUNT": 1, "AMMO2": 25}, terminated=True)
    assert sum(last.values()) == pytest.approx(1 - 1 - 0.1 - 0.2)
    assert last["death"] == -1


def test_health_gathering_is_equation_3_4():
    assert sum(one_step("health_gathering", {}).values()) == pytest.approx(0.01)
    assert sum(one_step("health_gathering", {"HEALTH": 125}).values()) == pytest.approx(1.01)
    assert sum(one_step("health_gathering", {"HEALTH": 92}).values()) == pytest.approx(0.01)
    poisoned = one_step("health_gathering", {"HEALTH": 70, "POISONS_TAKEN": 1})
    assert sum(poisoned.values()) == pytest.approx(0.01 - 1)
    assert sum(one_step("health_gathering", {"HEALTH": 0}, terminated=True).values()) == pytest.approx(-0.99)


def test_seek_and_kill_is_equation_3_5_with_the_sign_and_the_distance_of_the_text():
    assert sum(one_step("seek_and_kill", {}).values()) == pytest.approx(-0.01)
    assert sum(one_step("seek_and_kill", {"KILLCOUNT": 1, "AMMO2": 25}).values()) == pytest.approx(0.89)
    assert sum(one_step("seek_and_kill", {"HEALTH": 90}).values()) == pytest.approx(-0.31)
    assert sum(one_step("seek_and_kill", {"HEALTH": 110}).values()) == pytest.approx(-0.01)
    walked = one_step("seek_and_kill", {"POSITION_X": 30, "POSITION_Y": -40})
    assert walked["moved"] == pytest.approx(0.005 * 50)


def test_distance_is_counted_over_five_decisions():
    rewarder = scenario_named("seek_and_kill").make_rewarder()
    rewarder.reset(ALIVE)
    moved = [rewarder.step({**ALIVE, "POSITION_X": 10.0 * t}, False)["moved"] for t in range(1, 9)]
    assert moved == pytest.approx([0.05, 0.1, 0.15, 0.2, 0.25, 0.25, 0.25, 0.25])
    rewarder.reset({**ALIVE, "POSITION_X": 1000})  # the last episode's places are forgotten
    assert rewarder.step({**ALIVE, "POSITION_X": 1010}, False)["moved"] == pytest.approx(0.05)


def test_dodge_projectiles_is_equation_3_6():
    assert sum(one_step("dodge_projectiles", {}).values()) == pytest.approx(0.01)
    assert sum(one_step("dodge_projectiles", {"HEALTH": 90}).values()) == pytest.approx(-0.99)


def test_profile_levdoom_has_the_dense_rewards_of_its_package():
    change = {"KILLCOUNT": 1, "AMMO2": 25, "HEALTH": 90, "POSITION_X": 100}
    total = {
        scenario: sum(one_step(scenario, change, terminated=True, profile="levdoom").values())
        for scenario in scenarios()
    }
    assert total == {
        "defend_the_center": pytest.approx(1 - 0.01 - 0.01),
        "dodge_projectiles": pytest.approx(-0.1),
        "health_gathering": pytest.approx(-0.01),
        "seek_and_kill": pytest.approx(1 + 0.001 * 100),
    }


def test_weights_replace_defaults_by_name():
    change = {"KILLCOUNT": 2, "PLAYER_KILLS": 1, "AMMO2": 25}
    merit = one_step("defend_the_center", change, weights={"kill": 0.0, "player_kill": 2.0})
    assert merit == {"kill": 0, "player_kill": 2, "death": 0, "ammo_spent": -0.1, "health_lost": 0}


@pytest.mark.parametrize(
    ("weights", "message"),
    [
        (
            {"kills": 1.0},
            r": unknown component 'kills' \(did you mean 'kill'\?\); want some of kill, player_kill, death",
        ),
        ({"jump": 1.0}, ": unknown component 'jump'; want some of kill, player_kill, death"),
        ({"kill": math.nan}, ", kill: got nan, want a finite float"),
        ({"kill": math.inf}, ", kill: got inf, want a finite float"),
        ({"kill": 10**400}, ", kill: got 1000+, want a finite float"),
        ({"kill": "a"}, ", kill: got 'a', want float"),
        ({"kill": True}, ", kill: got True, want float"),
        ([("kill", 1.0)], r": got \[\('kill', 1.0\)\], want a mapping of component to weight"),
    ],
)
def test_weights_that_mean_nothing_are_refused(weights, message: str):
    with pytest.raises(ConfigError, match=f"env.reward_weights{message}"):
        scenario_named("defend_the_center").make_rewarder(weights)


def test_weights_of_any_number_type_are_taken():
    rewarder = scenario_named("defend_the_center").make_rewarder({"kill": 2, "death": np.float32(-0.5)})
    assert (rewarder.weights["kill"], rewarder.weights["death"]) == (2.0, -0.5)
    assert {type(weight) for weight in rewarder.weights.values()} == {float}


POLICIES = {
    "idle": lambda _rng, buttons: [0.0] * buttons,
    "random": lambda rng, buttons: [float(i == rng.randrange(buttons)) for i in range(buttons)],
    "first": lambda rng, buttons: [float(i == 0 or (i == buttons - 1 and rng.random() < 0.3)) for i in range(buttons)],
}
"""`first` holds the scenario's first button: it fires all its ammunition, or walks on"""


def discounted_returns(task_id: str, policy: str, profile: Profile, discount: float) -> list[float]:
    """The return from every decision of one real episode of at most 275 decisions."""
    task = parse_task(task_id)
    names = ("HEALTH", "AMMO2", "KILLCOUNT", "POSITION_X", "POSITION_Y", *BOOKKEEPING.values())
    config = EngineConfig(
        wad=compile_task(task, profile).wad_path, buttons=task.scenario.buttons, variables=(), width=160, height=120
    )
    engine, rng, rewards = Engine(config), random.Random(3), []

    def variables() -> dict[str, float]:
        read = {name: engine.variable(name) for name in names}
        return {**read, **{name: read[user] for name, user in BOOKKEEPING.items()}}

    try:
        engine.new_episode(seed=3)
        rewarder = task.scenario.make_rewarder(profile=profile)
        rewarder.reset(variables())
        for _ in range(275):
            state = engine.step(POLICIES[policy](rng, len(task.scenario.buttons)), 4)
            rewards.append(sum(rewarder.step(variables(), state is None).values()))
            if state is None:
                break
    finally:
        engine.close()
    returns = [0.0]
    for reward in reversed(rewards):
        returns.append(reward + discount * returns[-1])
    return returns


@pytest.mark.engine
@pytest.mark.parametrize(
    ("task_id", "policy"),
    [
        ("defend_the_center/default", "first"),
        ("defend_the_center/fast_enemies", "idle"),
        ("dodge_projectiles/default", "idle"),
        ("dodge_projectiles/arachnotron", "idle"),
        ("health_gathering/poison", "first"),
        ("health_gathering/default", "random"),
        ("seek_and_kill/mixed_enemies", "idle"),
        ("seek_and_kill/default", "random"),
    ],
)
def test_returns_of_real_games_lie_in_the_range(task_id: str, policy: str):
    low, high = parse_task(task_id).scenario.return_range(0.99)
    returns = discounted_returns(task_id, policy, "thesis", 0.99)
    assert low <= min(returns)
    assert max(returns) <= high


def test_ranges_are_narrow_enough_for_51_atoms():
    """An atom is no more than half the reward of the scenario's main event, or of a second of walking."""
    for scenario, event in (
        ("defend_the_center", 1.0),
        ("health_gathering", 1.0),
        ("dodge_projectiles", 1.0),
        ("seek_and_kill", 0.83 * 35 / 4),
    ):
        low, high = scenario_named(scenario).return_range(0.99)
        assert low < 0 < high
        assert (high - low) / 50 <= event / 2
