"""Seek and Kill: its sweep, script and pictures."""

from collections.abc import Iterator

from gvz.evaluation.scenarios.base import HALF_TURN, Moment, Moving, Pose, Sight

SWEEP = (("MOVE_FORWARD", 5), ("TURN_RIGHT", 3), ("ATTACK", 1))
MOMENTS = {"health_gathering_supreme.wad": Moment(seed=5, tics=2, pose=Pose(700, 1100, 180))}
MOVING = Moving(first=2, tasks=("default", "red", "obstacles+resized", "blue+mixed+resized", "complete"))


def script(sight: Sight) -> Iterator[str]:
    """Turns towards the nearest enemy until one is ahead, and fires, or walks up to one too far to aim at.

    Without an enemy in sight it walks on, and turns where it is stuck.
    """
    while True:
        enemies = sight.nearest("Monster")
        if any(sight.ahead(enemy, enemy.width / 2) for enemy in enemies):
            yield "ATTACK"
        elif enemies and not any(sight.ahead(enemy, HALF_TURN) for enemy in enemies):
            yield from sight.turn_round(
                enemies,
                lambda: any(sight.ahead(one, max(HALF_TURN, one.width / 2)) for one in sight.nearest("Monster")),
            )
        else:
            yield from sight.step(5)
