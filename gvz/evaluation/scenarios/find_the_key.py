"""Find the Key: its sweep, script and pictures."""

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from gvz.evaluation.scenarios.base import AIM, HALF_TURN, NEAR, Moment, Pose, Sight

if TYPE_CHECKING:
    from gvz.engine.engine import Label

SWEEP = (("MOVE_FORWARD", 18), ("TURN_RIGHT", 6))
MOMENTS = {
    "health_gathering.wad": Moment(seed=27, tics=20, pose=Pose(896, 480, 120)),
    "health_gathering_supreme.wad": Moment(seed=32, tics=20, pose=Pose(1184, 1728, 225)),
}
CLOSE = 30.0
"""nearness, pixels, of a key that the next steps reach"""
JUMP_UNITS = 60.0
"""map units; no step brings an agent so far, only the portal does"""


class _Memory:
    """What the script knows of what it has done."""

    has_key = False

    def wanted(self, sight: Sight) -> "list[Label]":
        """The keys in sight, or with a key the portals, nearest first."""
        if not self.has_key:
            return _keys(sight)
        portals = [thing for thing in sight.labels if thing.object_name == "Portal"]
        return sorted(portals, key=sight.nearness, reverse=True)

    def ahead(self, sight: Sight) -> bool:
        """Whether it is straight ahead."""
        return any(sight.ahead(thing, max(AIM, thing.width / 2)) for thing in self.wanted(sight))


def script(sight: Sight) -> Iterator[str]:
    """Walks to the nearest key, then to a portal; turns round to look for them, then walks on.

    It has a key when the one that was close is gone, or when it has turned round and seen none: with the first key the
    others vanish. Decoys have other colours in their names; it steps round them.
    """
    memory = _Memory()
    for button in _buttons(sight, memory):
        place = sight.place
        close = any(sight.nearness(thing) > CLOSE for thing in memory.wanted(sight))
        yield button
        if _keys(sight) or math.dist(place, sight.place) > JUMP_UNITS:
            memory.has_key = False
        elif close and button == "MOVE_FORWARD":
            memory.has_key = True


def _buttons(sight: Sight, memory: _Memory) -> Iterator[str]:
    while True:
        touched = [thing for thing in _decoys(sight) if sight.ahead(thing, max(HALF_TURN, sight.nearness(thing)))]
        if touched and sight.nearness(touched[0]) > NEAR:
            yield from [sight.turn_from(touched[0])] * 2
            yield "MOVE_FORWARD"
        elif memory.ahead(sight):
            yield from sight.step()
        elif not (yield from sight.turn_round(memory.wanted(sight), lambda: memory.ahead(sight))):
            memory.has_key = True
            yield from sight.walk_on()


def _keys(sight: Sight) -> "list[Label]":
    return [thing for thing in sight.nearest("Key") if thing.object_name.startswith("Blue")]


def _decoys(sight: Sight) -> "list[Label]":
    return [thing for thing in sight.nearest("Key") if not thing.object_name.startswith("Blue")]
