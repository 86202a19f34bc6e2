"""Simple players for each scenario, the floor that a trained agent is held against: a script, and a sweep, which looks
at nothing.

A script is a generator: it looks at `Sight`, which changes between its steps, and yields the button to hold. It is
told names and places of what is in sight (the labels buffer), so it knows enemies, kits and missiles without having
to recognize them; it knows nothing of what is out of sight.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from gvz.engine.engine import Label
    from gvz.env import DoomEnv
    from gvz.observation import Observation


class Sight:
    """What a script goes by. Places are in pixels of the rendered screen.

    Attributes:
        labels: everything in sight.
        variables: the scenario's game variables.
        screen: the observed screen, u8[H W C].
        rng: for chance, seeded with the episode.
    """

    def __init__(self, width: int, height: int, rng: np.random.Generator):
        self.labels: Sequence[Label] = ()
        self.variables: dict[str, float] = {}
        self.screen = np.zeros((0, 0, 3), np.uint8)
        self.rng = rng
        self._middle = width / 2
        self._horizon = 0.42 * height  # half of what the status bar leaves

    def nearest(self, category: str, *, but: str = "") -> "list[Label]":
        """Labels of a category (Monster, Health), nearest first, but none of the class of this name."""
        found = [label for label in self.labels if label.object_category == category and label.object_name != but]
        return sorted(found, key=self.nearness, reverse=True)

    def nearness(self, label: "Label") -> float:
        """How far a thing's feet are below the horizon, pixels: 1 / distance, whatever the size it is drawn in."""
        return label.y + label.height - self._horizon

    def ahead(self, label: "Label", half_width: float) -> bool:
        """Whether the middle of a label's box is at most `half_width` pixels from the screen's middle."""
        return abs(self._offset(label)) <= half_width

    def turn_to(self, label: "Label") -> str:
        """The button that turns towards a label."""
        return "TURN_RIGHT" if self._offset(label) > 0 else "TURN_LEFT"

    def turn_from(self, label: "Label") -> str:
        """The button that turns away from a label."""
        return "TURN_LEFT" if self._offset(label) > 0 else "TURN_RIGHT"

    def turn_anywhere(self) -> str:
        """A button that turns, by chance."""
        return ("TURN_LEFT", "TURN_RIGHT")[self.rng.integers(2)]

    def _offset(self, label: "Label") -> float:
        return label.x + label.width / 2 - self._middle


Script = Callable[[Sight], Iterator[str]]

HALF_TURN = 6.0
"""half of the smallest turn, pixels: nothing can be centred better than this"""
FULL_TURN = 30
"""decisions in which the agent has turned round once, at least"""
NEAR = 14.0
"""nearness, pixels (some 270 map units), of an enemy worth a bullet, and of a vial worth a detour"""
STUCK_CHANGE = 2.5
"""grey levels; a screen that changes less in a step forward on average is that of one who walks against a wall"""
STUCK_UNITS = 4.0
"""map units; likewise, of the way that the step led"""

SWEEPS: dict[str, tuple[tuple[str, int], ...]] = {
    "defend_the_center": (("TURN_RIGHT", 3), ("ATTACK", 2)),
    "health_gathering": (("MOVE_FORWARD", 18), ("TURN_RIGHT", 6)),
    "seek_and_kill": (("MOVE_FORWARD", 5), ("TURN_RIGHT", 3), ("ATTACK", 1)),
    "dodge_projectiles": (("MOVE_LEFT", 16), ("MOVE_RIGHT", 16)),
}
"""scenario -> (button, decisions it is held), again and again: how to play it without looking. Each scored most of 8 to
25 such sequences, on 8 to 12 episodes of base seed 1: `default`, in Dodge Projectiles five of the test tasks."""


def sweep(scenario: str) -> Iterator[str]:
    """The buttons of the scenario's sweep, without end."""
    return itertools.cycle(button for button, decisions in SWEEPS[scenario] for _ in range(decisions))


def defend_the_center(sight: Sight) -> Iterator[str]:
    """Turns until an enemy is near, turns to it, fires when it is in the middle; bullets are too few for far ones."""
    turn = "TURN_LEFT"
    while True:
        near = [enemy for enemy in sight.nearest("Monster") if sight.nearness(enemy) > NEAR]
        if any(sight.ahead(enemy, enemy.width / 2) for enemy in near):
            yield "ATTACK"
        else:
            turn = sight.turn_to(near[0]) if near else turn
            yield turn


def health_gathering(sight: Sight) -> Iterator[str]:
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
            turn = sight.turn_to(kits[0])
            for _ in range(FULL_TURN):
                yield turn
                if any(sight.ahead(kit, HALF_TURN) for kit in sight.nearest("Health", but="Poison")):
                    break
        else:
            yield from [sight.turn_anywhere()] * int(sight.rng.integers(2, 8))
            yield from ["MOVE_FORWARD"] * 4


def seek_and_kill(sight: Sight) -> Iterator[str]:
    """Turns towards the nearest enemy until one is ahead, and fires, or walks up to one too far to aim at.

    Without an enemy in sight it walks on, and turns where it is stuck.
    """
    while True:
        enemies = sight.nearest("Monster")
        if any(sight.ahead(enemy, enemy.width / 2) for enemy in enemies):
            yield "ATTACK"
        elif enemies and not any(sight.ahead(enemy, HALF_TURN) for enemy in enemies):
            turn = sight.turn_to(enemies[0])
            for _ in range(FULL_TURN):
                yield turn
                if any(sight.ahead(enemy, max(HALF_TURN, enemy.width / 2)) for enemy in sight.nearest("Monster")):
                    break
        else:
            x, y = sight.variables["POSITION_X"], sight.variables["POSITION_Y"]
            yield "MOVE_FORWARD"
            if math.hypot(sight.variables["POSITION_X"] - x, sight.variables["POSITION_Y"] - y) < STUCK_UNITS:
                yield from [sight.turn_anywhere()] * int(sight.rng.integers(3, 12))
                yield from ["MOVE_FORWARD"] * 5


def dodge_projectiles(_sight: Sight) -> Iterator[str]:
    """The sweep: walks to and fro, a little longer than the strip is. It looks at nothing: missiles go where it was.

    Stepping aside from the nearest missile was tried, too: it lives a third as long.
    """
    return sweep("dodge_projectiles")


SCRIPTS: dict[str, Script] = {
    script.__name__: script for script in (defend_the_center, health_gathering, seek_and_kill, dodge_projectiles)
}
"""scenario -> its script"""


class SweepPlayer:
    """Plays each scenario by a fixed sequence of buttons, looking at nothing. Wants action_set="buttons"."""

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        self._actions = {held[0]: action for action, held in enumerate(env.action_meanings) if held}
        self._script = sweep(env.task.scenario.id)

    def act(self) -> int:
        return self._actions[next(self._script)]

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        """Ignores observations."""


class ScriptedPlayer:
    """Plays each scenario by its script. Wants an environment with buffers=("labels",) and action_set="buttons"."""

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        self._env = env
        self._actions = {held[0]: action for action, held in enumerate(env.action_meanings) if held}
        self._sight = Sight(env.config.render_width, env.config.render_height, np.random.default_rng(seed))
        self.observe(observation, info)
        self._script = SCRIPTS[env.task.scenario.id](self._sight)

    def act(self) -> int:
        return self._actions[next(self._script)]

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        assert isinstance(observation, dict)
        self._sight.screen = observation["screen"]
        self._sight.labels = self._env.labels()
        self._sight.variables = info["variables"]
