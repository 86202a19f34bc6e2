"""Rockets: what a running engine shows, against what the scenario's file says."""

import itertools
from math import cos, radians, sin

import pytest

from gvz.observation import label_class
from gvz.scenarios.compiler import map_source
from gvz.tasks import parse_task, scenario_named
from tests.episodes import evaluated

MIDDLE = 608
"""of the square room, map units"""
WEAPON_UP_TICS = 20


SCENARIO = "rockets"
"""which the fixture `start` plays"""


@pytest.mark.engine
@pytest.mark.parametrize(
    ("name", "enemy"),
    [("default", "Demon"), ("complete", "HellKnight"), ("procedural", "Demon"), ("flying_enemies", "PeacefulSoul")],
)
def test_an_agent_that_cannot_be_hurt_meets_all_15_squads_of_3(start, name: str, enemy: str):
    player = start(name)
    player.step()
    assert (player["HEALTH"], player["AMMO5"], player["SPAWNED"]) == (100, 30, 1)
    assert player.properties(100)["health"] == 1
    came = {number: tic for tic, number in player.timeline("SPAWNED", 1090)}
    assert len(came) == player["SPAWNED"] == 45
    firsts = [came[number] for number in range(4, 46, 3)]
    assert min(later - earlier for earlier, later in itertools.pairwise(firsts)) >= 70
    assert came[45] < 1100, "before the time-out, though no enemy dies and makes room"
    alive = sum(kind.startswith(enemy) for kind, _, _ in player.objects())
    assert alive == 45 - player["KILLCOUNT"]
    assert alive == 45 or name == "complete", "they do not kill each other, but fireballs burst barrels"


@pytest.mark.engine
def test_episodes_start_anywhere_and_the_first_squad_comes_from_far_away(start):
    player, starts = start("default"), set()
    for seed in range(8):
        player.restart(seed)
        player.step()
        enemies = [(x, y) for kind, x, y in player.objects() if kind == "Demon"]
        assert len(enemies) == 1
        (x, y), here = enemies[0], (player["POSITION_X"], player["POSITION_Y"])
        assert abs(x - here[0]) + abs(y - here[1]) > 600
        starts.add((round(here[0]), round(here[1])))
    assert len(starts) == 8


@pytest.mark.engine
def test_the_agent_hits_itself_at_a_wall_and_not_across_the_room(start):
    """A rocket does 128 damage where it bursts, one less for each map unit from there."""
    player, health = start("default"), []
    for to_wall in (90, MIDDLE):
        player.restart(1)
        player.step(tics=WEAPON_UP_TICS)
        east, north = cos(radians(player["ANGLE"])), sin(radians(player["ANGLE"]))
        length = (MIDDLE - to_wall) / max(abs(east), abs(north))
        player.game.send_game_command(f"warp {MIDDLE + length * east:.0f} {MIDDLE + length * north:.0f}")
        player.step("ATTACK", 10)
        player.step(tics=40)
        assert player["AMMO5"] == 29
        health.append(player["HEALTH"])
    assert 10 < health[0] < 75
    assert health[1] == 100


@pytest.mark.engine
def test_a_script_that_sees_kills_most_and_a_blind_sweep_few():
    """Three episodes each of base seed 1: 28 and 6 on average (2026-11-23)."""
    scores, at_once = {}, []
    for name in ("scripted", "sweep"):
        rows = evaluated("rockets/default", name)
        scores[name] = sum(row["score"] for row in rows) / 3
        for row in rows:
            assert row["reward_components"]["kill"] == row["kills"] == row["score"]
            assert row["normalized_score"] == pytest.approx(100 * row["score"] / 45)
            spent = row["reward_components"]["ammo_spent"] / -0.05
            at_once.append(row["kills"] / max(1, spent))
    assert scores["scripted"] > 22 > 15 > scores["sweep"]
    assert max(at_once) > 1, "a rocket kills several"


def test_drawn_maps_can_be_played():
    for number in range(40):  # a map with a place out of reach is an error
        map_source(parse_task("rockets/procedural-test"), "thesis", number)


def test_every_kill_counts_and_so_does_what_the_agent_does_to_itself():
    rewarder = scenario_named("rockets").make_rewarder()
    start = {"KILLCOUNT": 2.0, "PLAYER_KILLS": 2.0, "AMMO5": 30.0, "HEALTH": 100.0}
    rewarder.reset(start)
    three = rewarder.step({**start, "KILLCOUNT": 5.0, "PLAYER_KILLS": 5.0, "AMMO5": 29.0}, False)
    assert three == {"kill": 3.0, "player_kill": 0.0, "death": 0.0, "ammo_spent": -0.05, "health_lost": 0.0}
    last = rewarder.step({"KILLCOUNT": 5.0, "PLAYER_KILLS": 5.0, "AMMO5": 28.0, "HEALTH": -20.0}, True)
    assert last == {"kill": 0.0, "player_kill": 0.0, "death": -1.0, "ammo_spent": -0.05, "health_lost": -0.2}
    assert scenario_named("rockets").upper_bound() == 45


def test_barrels_are_an_other_thing_and_rockets_are_projectiles():
    assert label_class("Hazard", "ExplosiveBarrel") == "other"
    assert label_class("Explosive", "Rocket") == "projectile"
