"""Health Gathering: its sweep, script and pictures."""

from collections.abc import Iterator

import numpy as np

from gvz.evaluation.scenarios.base import HALF_TURN, NEAR, Moment, Moving, Pose, Sight

SWEEP = (("MOVE_FORWARD", 18), ("TURN_RIGHT", 6))
MOMENTS = {
    "health_gathering.wad": Moment(seed=7, tics=20, pose=Pose(672, 608, 30)),
    "health_gathering_supreme.wad": Moment(seed=196, tics=20, pose=Pose(1376, 928, 240)),
}
MOVING = Moving(first=12, tasks=("default", "lava", "slime+obstacles", "poison+resized+shaded_kits", "complete"))
STUCK_CHANGE = 2.5
"""grey levels; a screen that changes less in a step forward on average is that of one who walks against a wall"""


def script(sight: Sight) -> Iterator[str]:
    """Turns towards the nearest kit until one is ahead, and walks; steps round vials of poison, away from walls."""
    while True:
        kits = sight.nearest("Health", but="Poison")
        # what the agent, walking straight on, would touch: in a corridor that is as wide as it is near
        touched = [
            thing for thing in sight.nearest("Health") if sight.ahead(thing, max(HALF_TURN, sight.nearness(thing)))
        ]
        if touched and touched[0].object_name == "Poison" and sight.nearness(touched[0]) > NEAR:
            yield from [sight.turn_from(touched[0])] * 2
            yield "MOVE_FORWARD"
        elif any(kit in touched for kit in kits):
            before = sight.screen.astype(np.int16)
            yield "MOVE_FORWARD"
            if np.abs(sight.screen - before).mean() < STUCK_CHANGE:
                yield from [sight.turn_anywhere()] * 5
                yield from ["MOVE_FORWARD"] * 5
        elif kits:
            yield from sight.turn_round(
                kits, lambda: any(sight.ahead(kit, HALF_TURN) for kit in sight.nearest("Health", but="Poison"))
            )
        else:
            yield from [sight.turn_anywhere()] * int(sight.rng.integers(2, 8))
            yield from ["MOVE_FORWARD"] * 4
