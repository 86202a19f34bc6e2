"""Find Ammunition: its sweep, script and pictures."""

from collections.abc import Iterator
from typing import TYPE_CHECKING

from gvz.evaluation.scenarios.base import AIM, NEAR, Moment, Pose, Sight

if TYPE_CHECKING:
    from gvz.engine.engine import Label

SWEEP = (("MOVE_FORWARD", 18), ("TURN_RIGHT", 11), ("ATTACK", 2))
MOMENTS = {
    "health_gathering.wad": Moment(seed=29, tics=20, pose=Pose(1168, 768, 195)),
    "health_gathering_supreme.wad": Moment(seed=39, tics=20, pose=Pose(976, 1712, 210)),
}


def script(sight: Sight) -> Iterator[str]:
    """Without bullets it walks to clips that no enemy stands before, with bullets it shoots enemies that are near.

    It turns round to look for what it wants, then walks on. It takes no notice of wrong ammunition.
    """
    while True:
        wanted = _wanted(sight)
        if _armed(sight) and any(
            sight.ahead(enemy, enemy.width / 2) and sight.nearness(enemy) > NEAR for enemy in wanted
        ):
            yield "ATTACK"
        elif _ahead(sight):
            yield from sight.step()
        elif not (yield from sight.turn_round(wanted, lambda: _ahead(sight))):
            yield from sight.walk_on()


def _ahead(sight: Sight) -> bool:
    """Whether something wanted is straight ahead."""
    return any(sight.ahead(one, max(AIM, one.width / 2)) for one in _wanted(sight))


def _armed(sight: Sight) -> bool:
    return sight.variables["AMMO2"] > 0


def _wanted(sight: Sight) -> "list[Label]":
    """Clips in sight, or with bullets the enemies, nearest first."""
    enemies = sight.nearest("Monster")
    if _armed(sight):
        return enemies
    clips = [one for one in sight.nearest("Ammo") if one.object_name.startswith("Bullet")]
    return [clip for clip in clips if not any(_hides(sight, enemy, clip) for enemy in enemies)]


def _hides(sight: Sight, enemy: "Label", clip: "Label") -> bool:
    """Whether an enemy stands on the way to a clip."""
    apart = abs(enemy.x + enemy.width / 2 - clip.x - clip.width / 2)
    return sight.nearness(enemy) > sight.nearness(clip) and apart < enemy.width
