"""Dodge Projectiles: its sweep, script and pictures."""

from collections.abc import Iterator

from gvz.evaluation.scenarios.base import Moment, Moving, Pose, Sight, sweep

SWEEP = (("MOVE_LEFT", 16), ("MOVE_RIGHT", 16))
MOMENTS = {"defend_the_line.wad": Moment(seed=8, tics=80, pose=Pose(-480, 160, 0))}
MOVING = Moving(first=24, tasks=("default", "flames", "barons+flaming_skulls", "city+arachnotron", "complete"))


def script(_sight: Sight) -> Iterator[str]:
    """The sweep: walks left and right, a little longer than the strip is. Missiles fly to where the agent was.

    A script that stepped aside from the nearest missile lived a third as long.
    """
    return sweep("dodge_projectiles")
