"""What the files of this package consist of: how a script sees the game, and what a picture shows.

A script is a generator: it looks at `Sight`, which changes between its steps, and yields the button to hold. It gets
names and places of what is in sight (the labels buffer), so it need not recognize enemies, kits and missiles. It knows
nothing of what is out of sight.
"""

import itertools
import math
from collections.abc import Callable, Generator, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from gvz.core.errors import ConfigError
from gvz.core.registry import discover

if TYPE_CHECKING:
    from gvz.engine.engine import Label

HALF_TURN = 6.0
"""half of the smallest turn, pixels: nothing can be centred better than this"""
FULL_TURN = 30
"""decisions in which the agent has turned round once, at least"""
AIM = 14.0
"""half of what a decision turns the picture by, pixels: a finer aim would be skipped; walking corrects the rest"""
STUCK_UNITS = 4.0
"""map units; an agent that a step brings less far walks against something"""
NEAR = 14.0
"""nearness, pixels (some 270 map units), of an enemy worth a bullet, and of a vial worth a detour"""


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

    def turn_round(self, wanted: "Sequence[Label]", found: Callable[[], bool]) -> Generator[str, None, bool]:
        """Turns towards the first label, without one somewhere, at most once round; returns whether it `found` it."""
        turn = self.turn_to(wanted[0]) if wanted else self.turn_anywhere()
        for _ in range(FULL_TURN):
            yield turn
            if found():
                return True
        return False

    @property
    def place(self) -> tuple[float, float]:
        """Where the agent is, map units, in scenarios whose variables say it."""
        return self.variables["POSITION_X"], self.variables["POSITION_Y"]

    def walk_on(self, steps: int = 8) -> Iterator[str]:
        """Turns somewhere and walks there."""
        yield from [self.turn_anywhere()] * int(self.rng.integers(3, 12))
        yield from ["MOVE_FORWARD"] * steps

    def step(self, steps: int = 8) -> Iterator[str]:
        """Steps forward, and where it is stuck walks on."""
        place = self.place
        yield "MOVE_FORWARD"
        if math.dist(place, self.place) < STUCK_UNITS:
            yield from self.walk_on(steps)

    def _offset(self, label: "Label") -> float:
        return label.x + label.width / 2 - self._middle


Script = Callable[[Sight], Iterator[str]]


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the agent stands and looks: map units, and degrees counterclockwise from east."""

    x: float
    y: float
    angle: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Moment:
    """What the frames of a map have in common. MOMENTS has one by base map.

    Found by a search over seeds, poses and tics for frames that show what every attribute of the map's tasks changes;
    tests/evaluation/test_gallery.py says what has to be in sight.
    """

    seed: int = 1
    """of the episode"""
    tics: int = 35
    """since its start, of idling"""
    pose: Pose | None = None
    """None: as the episode starts"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Moving:
    """What the moving picture shows of a scenario."""

    first: int
    """the first decision that is shown"""
    tasks: tuple[str, ...]
    """a task of each level"""


def sweep(scenario: str) -> Iterator[str]:
    """The buttons of the scenario's sweep, without end: how to play it without looking.

    `SWEEP` is (button, decisions it is held), again and again. Each scored most of 8 to 25 such sequences, on 8 to 12
    episodes of base seed 1: `default`, in Dodge Projectiles five of the test tasks.

    Raises:
        ConfigError: nobody has written one.
    """
    return itertools.cycle(button for button, decisions in _written(scenario, "SWEEP") for _ in range(decisions))


def script_of(scenario: str) -> Script:
    """The scenario's script.

    Raises:
        ConfigError: nobody has written one.
    """
    return _written(scenario, "script")


def stated(scenario: str, name: str) -> Any:
    """What the scenario's file of this package has under a name; None if there is no such file, or no such name."""
    return getattr(discover("gvz.evaluation.scenarios").get(scenario), name, None)


def _written(scenario: str, name: str) -> Any:
    if (found := stated(scenario, name)) is None:
        file = f"gvz/evaluation/scenarios/{scenario}.py"
        raise ConfigError(f"{scenario}: there is no {name} that this player could follow; write one in {file}")
    return found
