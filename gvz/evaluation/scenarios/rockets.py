"""Rockets: its sweep, script and pictures."""

import math
from collections.abc import Iterator

from gvz.evaluation.scenarios.base import HALF_TURN, STUCK_UNITS, Moment, Pose, Sight

SWEEP = (("MOVE_BACKWARD", 30), ("ATTACK", 200))
MOMENTS = {"health_gathering.wad": Moment(seed=10, tics=90, pose=Pose(608, 180, 90))}
TOO_NEAR = 25.0
"""nearness, pixels (some 150 map units), of an enemy at which a rocket would hurt the agent, too"""


def script(sight: Sight) -> Iterator[str]:
    """Turns to the nearest enemy and fires; steps back from one that is too near, and where it cannot, runs."""
    turn = "TURN_LEFT"
    while True:
        enemies = sight.nearest("Monster")
        if enemies and sight.nearness(enemies[0]) > TOO_NEAR:
            place = sight.place
            yield "MOVE_BACKWARD"
            if math.dist(place, sight.place) < STUCK_UNITS:
                yield from [sight.turn_anywhere()] * 5
                yield from ["MOVE_FORWARD"] * 6
        elif any(sight.ahead(enemy, max(HALF_TURN, enemy.width / 2)) for enemy in enemies):
            yield "ATTACK"
        else:
            turn = sight.turn_to(enemies[0]) if enemies else turn
            yield turn
