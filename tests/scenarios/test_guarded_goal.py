"""Guarded Goal: what a running engine shows, against what the scenario's file says."""

import math
import random
from math import dist
from typing import Any

import pytest

from gvz.evaluation.players import ScriptedPlayer
from gvz.observation import label_class
from gvz.scenarios.guarded_goal import ROOM_SPOTS
from gvz.tasks import scenario_named
from tests.episodes import evaluated
from tests.scenarios.measure import Player

GUARDS = {"default": ("DoomImp", 40), "sergeants": ("ShotgunGuy", 40), "flying_guards": ("Cacodemon", 62)}
GUARDS |= {"complete": ("HellKnight", 48), "obstacles": ("DoomImp", 40)}
"""task -> kind of its guards, and how far they stand from the goal"""
SIDES = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""of the goal, in the order of the guards' tids"""
FIRST_GUARD = 110
WALK = 8.33
"""map units a tic, the agent's full speed"""
TURN, SLOW_TURN, SLOW_TICS = 360 * 640 / 65536, 360 * 320 / 65536, 6
"""degrees a tic; the first six tics of a turn are slow"""


SCENARIO = "guarded_goal"
"""which the fixture `start` plays"""


def places(player: Player, *names: str) -> list[tuple[float, float]]:
    return [(x, y) for name, x, y in player.objects() if name in names]


def agent(player: Player) -> tuple[float, float]:
    return player["POSITION_X"], player["POSITION_Y"]


def warp(player: Player, x: float, y: float) -> None:
    player.game.send_game_command(f"warp {x} {y}")
    player.step()


def face(player: Player, angle: float) -> None:
    """Turns to an angle, degrees, by single tics: each begins a turn and so is a small one."""
    for _ in range(400):
        off = (angle - player["ANGLE"] + 180) % 360 - 180
        if abs(off) <= SLOW_TURN / 2:
            return
        player.step("TURN_LEFT" if off > 0 else "TURN_RIGHT")
        player.step()
    raise AssertionError(f"at {player['ANGLE']}, want {angle}")


def walk_in(player: Player, side: tuple[int, int], goal: tuple[float, float]) -> None:
    """Walks from a place at a side of the goal straight towards it."""
    player.step(tics=40)  # or it would slide on
    warp(player, goal[0] + 140 * side[0], goal[1] + 140 * side[1])
    face(player, math.degrees(math.atan2(-side[1], -side[0])))
    player.step("MOVE_FORWARD", 30)


@pytest.mark.engine
@pytest.mark.parametrize("name", GUARDS)
def test_four_guards_stand_round_a_goal_and_leave_no_way_between_them(start, name: str):
    player, (kind, away) = start(name), GUARDS[name]
    starts = set()
    for seed in range(8):
        player.restart(seed)
        (goal,) = places(player, "Goal")
        assert 300 < dist(goal, agent(player)) < 700
        found = {(round(x - goal[0]), round(y - goal[1])) for x, y in places(player, kind)}
        assert found == {(away * x, away * y) for x, y in SIDES}
        assert all(player.properties(FIRST_GUARD + n)["health"] == 1 for n in range(4))
        columns = [(x, y) for one, x, y in player.objects() if "Column" in one]
        assert len(columns) == (17 if name in ("complete", "obstacles") else 0)
        assert all(max(abs(x - goal[0]), abs(y - goal[1])) >= 36 for x, y in columns)
        traps = places(player, "Trap")
        assert len(traps) == (2 if name == "complete" else 0)
        assert all(dist(trap, other) > 200 for trap in traps for other in (goal, agent(player)))
        starts.add(agent(player))
    assert len(starts) == 8


@pytest.mark.engine
def test_nobody_passes_the_guards_and_where_one_died_the_agent_walks_in(start):
    player = start("default")
    player.step(tics=12)  # the agent cannot move before
    player.command(903)  # and nothing hurts it
    (goal,) = places(player, "Goal")
    for side in (*SIDES, *((x / 2**0.5, y / 2**0.5) for x in (1, -1) for y in (1, -1))):
        walk_in(player, side, goal)
        assert dist(agent(player), goal) > 32
    assert player["GOALS"] == 0
    player.command(901, FIRST_GUARD + 2, 0)  # the western guard dies by the agent's hand
    player.step(tics=2)
    assert (player["PLAYER_KILLS"], len(places(player, "DoomImp"))) == (1, 3)
    walk_in(player, SIDES[2], goal)
    assert (player["GOALS"], player["PLAYER_KILLS"]) == (1, 1)
    (again,) = places(player, "Goal")
    assert again != goal
    assert len(places(player, "DoomImp")) == 4
    assert (player["KILLCOUNT"], player["SPAWNED"]) == (1, 8)


@pytest.mark.engine
def test_guards_shoot_at_an_agent_that_does_nothing_and_its_health_does_not_come_back(start):
    player = start("default")
    (goal,) = places(player, "Goal")
    player.step(tics=12)
    warp(player, goal[0] - 200 if goal[0] > 608 else goal[0] + 200, goal[1])
    player.step("ATTACK", 4)  # the noise wakes all of them
    healths = [player["HEALTH"]]
    while healths[-1] > 40 and len(healths) < 60:
        player.step(tics=10)
        healths.append(player["HEALTH"])
    assert healths == sorted(healths, reverse=True)
    assert healths[-1] <= 40


@pytest.mark.engine
@pytest.mark.parametrize(
    ("name", "deaths"), [("default", 0), ("sergeants", 2), ("flying_guards", 0), ("knights+shadows", 0)]
)
def test_only_sergeants_kill_each_other_while_the_agent_does_nothing(start, name: str, deaths: int):
    player = start(name)
    for seed in range(3):
        player.restart(seed)
        player.step(tics=12)
        player.command(903)  # nothing hurts the agent
        player.step("ATTACK", 4)  # the noise wakes all of them
        player.step(tics=600)
        assert (player["KILLCOUNT"], player["PLAYER_KILLS"], player["GOALS"]) == (deaths, 0, 0), seed


@pytest.mark.engine
@pytest.mark.parametrize(
    ("name", "damage"), [("traps", 35), ("sergeants+traps", 70), ("flying_guards+traps", 20), ("complete", 13)]
)
def test_traps_take_35_health_times_the_guards_damage_factor_and_vanish(start, name: str, damage: int):
    player, taken = start(name), 0
    player.step(tics=12)
    while not player.game.is_player_dead():
        assert (player["HEALTH"], player["POISONS_TAKEN"]) == (100 - taken * damage, taken)
        assert player["GOALS"] == taken // 2
        for guard in range(FIRST_GUARD, FIRST_GUARD + 4):
            player.command(901, guard, 0)  # so that only traps hurt
        traps = places(player, "Trap")
        assert len(traps) == 2 - taken % 2
        warp(player, *traps[0])
        player.step(tics=2)
        taken += 1
        if taken % 2 == 0 and not player.game.is_player_dead():  # two others stand round the next goal
            warp(player, *places(player, "Goal")[0])
            player.step(tics=3)
    assert taken == math.ceil(100 / damage)


def test_the_reward_of_traps_expects_as_many_as_an_agent_can_take():
    scenario = scenario_named("guarded_goal")
    factors = [attribute.content.agent.get("DamageFactor", 1.0) for attribute in scenario.attributes]
    (pace,) = scenario.rewards["trapped"].paces
    assert pace.times == max(math.ceil(100 / int(35 * factor - 0.01)) for factor in factors)


@pytest.mark.engine
def test_each_64_units_nearer_to_a_goal_than_before_count_once(start):
    player = start("default")
    player.step(tics=12)
    player.command(903)
    (goal,), before = places(player, "Goal"), player["STEPS_NEARER"]
    side = -1 if goal[0] > 608 else 1
    first = dist(goal, agent(player))
    for away, steps in ((first - 60, 0), (first - 70, 1), (first, 1), (first - 80, 1), (first - 140, 2)):
        warp(player, goal[0] + side * away, goal[1])
        assert player["STEPS_NEARER"] - before == steps, away


class HastyPlayer(ScriptedPlayer):
    """The script, but where it sees two guards or fewer it does not care for them."""

    def observe(self, observation: Any, info: dict[str, Any]) -> None:
        super().observe(observation, info)
        guards = self._sight.nearest("Monster")
        if len(guards) <= 2:
            self._sight.labels = [thing for thing in self._sight.labels if thing not in guards]


def total(rows: list[dict[str, Any]], column: str) -> float:
    return sum(row[column] for row in rows)


@pytest.mark.engine
def test_a_script_that_shoots_all_guards_reaches_goals_and_a_blind_sweep_hardly_any():
    task = "guarded_goal/default"
    patient, blind = evaluated(task, "scripted", 6), evaluated(task, "sweep")
    for row in patient + blind:
        assert row["reward_components"]["goal"] == row["score"]
        assert row["normalized_score"] == pytest.approx(100 * row["score"] / 14)
        assert row["terminated"] or row["length_frames"] == 1050
    assert total(patient, "score") / 6 > 4 > 1 > total(blind, "score") / 3
    hasty = evaluated(task, "scripted", 6, HastyPlayer)
    assert total(hasty, "terminated") >= 3 > 1 >= total(patient, "terminated")
    assert total(hasty, "score") < total(patient, "score")


@pytest.mark.engine
def test_drawn_rooms_can_be_played():
    """Walls may stand where a guard would; goals are reached and guards are killed all the same."""
    rows = evaluated("guarded_goal/procedural-train-4", "scripted", 4)
    assert total(rows, "score") > 4
    assert total(rows, "player_kills") > 12


def test_the_bound_is_what_a_player_reaches_that_knows_all_and_is_stopped_by_nobody():
    """It turns to each goal and walks as soon as it faces it roughly: 13.9 goals with the best angle, 75 degrees."""
    rng, timeout, episodes = random.Random(1), scenario_named("guarded_goal").timeout_frames(), 200

    def place() -> tuple[float, float]:
        x, y = rng.choice(ROOM_SPOTS)
        return x + rng.uniform(-32, 32), y + rng.uniform(-32, 32)

    goals = 0
    for _ in range(episodes):
        tics, (x, y), goal, angle, turned = 0, (0.0, 0.0), (0.0, 0.0), 0.0, 0
        while tics < timeout:
            tics += 1
            if dist((x, y), goal) <= 32 or tics == 1:
                goals += tics > 1
                goal = x, y = place()
                angle, turned = rng.uniform(-180, 180), 0
                while not 300 < dist((x, y), goal) < 700:
                    goal = place()
                continue
            off = (math.degrees(math.atan2(goal[1] - y, goal[0] - x)) - angle + 180) % 360 - 180
            most = SLOW_TURN if turned < SLOW_TICS else TURN
            turned = turned + 1 if abs(off) > most / 2 else 0
            angle += max(-most, min(most, off)) if turned else 0.0
            if abs(off) < 75:
                x, y = x + WALK * math.cos(math.radians(angle)), y + WALK * math.sin(math.radians(angle))
    assert goals / episodes == pytest.approx(13.9, abs=0.15)
    assert scenario_named("guarded_goal").upper_bound() == 14


def test_goals_and_traps_are_of_class_other():
    assert {label_class("Internal", name) for name in ("Goal", "Trap")} == {"other"}


def test_rewards_by_hand():
    rewarder = scenario_named("guarded_goal").make_rewarder()
    start = {"GOALS": 0.0, "PLAYER_KILLS": 0.0, "STEPS_NEARER": 0.0, "POISONS_TAKEN": 0.0, "HEALTH": 100, "AMMO2": 200}
    rewarder.reset(start)
    killed = {**start, "PLAYER_KILLS": 1.0, "AMMO2": 199}
    assert {name: value for name, value in rewarder.step(killed, False).items() if value} == {
        "guard_killed": 0.2,
        "ammo_spent": -0.01,
    }
    reached = {**killed, "GOALS": 1.0, "STEPS_NEARER": 1.0, "POISONS_TAKEN": 1.0, "HEALTH": 0}
    assert rewarder.step(reached, True) == {
        "goal": 1.0,
        "guard_killed": 0.0,
        "nearer": 0.05,
        "trapped": -0.5,
        "health_lost": -0.05,
        "ammo_spent": 0.0,
        "death": -1.0,
    }
