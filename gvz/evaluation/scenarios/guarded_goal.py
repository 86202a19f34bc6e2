"""Guarded Goal: its sweep, script and pictures."""

import math
from collections.abc import Iterator

from gvz.evaluation.scenarios.base import AIM, HALF_TURN, STUCK_UNITS, Moment, Pose, Sight

SWEEP = (("MOVE_FORWARD", 8), ("ATTACK", 1), ("MOVE_FORWARD", 8), ("TURN_RIGHT", 6))
MOMENTS = {"health_gathering.wad": Moment(seed=1, tics=20, pose=Pose(916, 300, 135))}
IN_RANGE = 7.0
"""nearness, pixels, of a guard worth a bullet"""


def script(sight: Sight) -> Iterator[str]:
    """Walks towards the goal, shoots all guards as soon as they are near enough, then walks on.

    It turns round to look for the goal, then walks on. After a turn too far it takes a step: a turn that begins again
    is a small one.
    """
    last = ""
    while True:
        button = _button(sight)
        if button is None:
            if not (yield from sight.turn_round((), lambda: any(one.object_name == "Goal" for one in sight.labels))):
                yield from sight.walk_on(5)
            continue
        if {button, last} == {"TURN_LEFT", "TURN_RIGHT"}:
            button = "MOVE_FORWARD"
        place = sight.place
        yield (last := button)
        if button == "MOVE_FORWARD" and math.dist(place, sight.place) < STUCK_UNITS:
            yield from sight.walk_on(5)


def _button(sight: Sight) -> str | None:
    """What to do about the guards and the goal in sight; None: there is nothing."""
    guards = [guard for guard in sight.nearest("Monster") if sight.nearness(guard) > IN_RANGE]
    goals = [thing for thing in sight.labels if thing.object_name == "Goal"]
    if any(sight.ahead(guard, guard.width / 3) for guard in guards):
        return "ATTACK"
    if guards and not any(sight.ahead(guard, HALF_TURN) for guard in guards):
        return sight.turn_to(guards[0])
    if not goals:
        return None
    return "MOVE_FORWARD" if guards or sight.ahead(goals[0], AIM) else sight.turn_to(goals[0])
