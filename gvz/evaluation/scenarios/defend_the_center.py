"""Defend the Center: its sweep, script and pictures."""

from collections.abc import Iterator

from gvz.evaluation.scenarios.base import NEAR, Moment, Moving, Pose, Sight

SWEEP = (("TURN_RIGHT", 3), ("ATTACK", 2))
MOMENTS = {"defend_the_center.wad": Moment(seed=4, tics=100, pose=Pose(0, 0, 40))}
MOVING = Moving(first=32, tasks=("default", "stone_wall", "gore+mossy_bricks", "fast+resized+gore", "complete"))


def script(sight: Sight) -> Iterator[str]:
    """Turns until an enemy is near, turns to it, fires when it is in the middle; bullets are too few for far ones."""
    turn = "TURN_LEFT"
    while True:
        near = [enemy for enemy in sight.nearest("Monster") if sight.nearness(enemy) > NEAR]
        if any(sight.ahead(enemy, enemy.width / 2) for enemy in near):
            yield "ATTACK"
        else:
            turn = sight.turn_to(near[0]) if near else turn
            yield turn
