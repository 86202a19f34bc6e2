"""Rewards as named events of one decision, each with a weight."""

import math
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gvz.core.env_config import EnvConfig, typed
from gvz.core.errors import ConfigError, TaskError, nearest

Variables = Mapping[str, float]
"""The game's variables after a decision: name of a game or bookkeeping variable -> value."""

Event = Callable[[Sequence[Variables], bool], float]
"""f(history, terminated) -> amount of the event in this decision, at least 0 (the sign is in the weight).

`history` holds the variables after each of the last decisions, oldest first: history[-1] is now, history[-2] one
decision ago. It goes back at most HISTORY_STEPS decisions, and not beyond the start of the episode.
"""

HISTORY_STEPS = 5
"""decisions an event can look back (eq. 3.5 needs five)"""

_EDGE_SHARE = 0.05
"""least part of a range of returns on each side of 0; larger than the edge in gvz/run/alarms.py"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Pace:
    """How often an event can come during a period."""

    tics: float = 1.0
    """least number of game tics from one event to the next"""
    times: float = math.inf
    """number of events before the next pace begins"""
    amount: float = 1.0
    """amount of each event"""
    needs: str | None = None
    """another component whose event comes with each of these events: a kill costs a bullet"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Reward:
    """One component of a scenario's reward: an event, its weight, and how often it can come.

    From any decision on, the paces follow one another. Together they are the maximum that a player can get of the event
    in all tasks: a limit from the game's rules, or else the measured maximum plus some ten percent.
    """

    event: Event
    weight: float
    levdoom: float
    """the weight in profile levdoom"""
    paces: tuple[Pace, ...] = (Pace(),)
    """default: once every decision"""
    levdoom_paces: tuple[Pace, ...] | None = None
    """the paces in profile levdoom, if they differ"""
    adds_up: bool = False
    """amounts within one decision add up (a distance); else the event counts once in a decision"""


def living(_history: Sequence[Variables], _terminated: bool) -> float:
    """1 for every decision."""
    return 1.0


def death(_history: Sequence[Variables], terminated: bool) -> float:
    """1 if the episode terminated: in every scenario this is the agent's death."""
    return float(terminated)


@dataclass(frozen=True, slots=True)
class Rose:
    """1 if variable `name` is higher than one decision ago. A class, because a closure cannot be pickled."""

    name: str

    def __call__(self, history: Sequence[Variables], _terminated: bool) -> float:
        return float(history[-1][self.name] > history[-2][self.name])


@dataclass(frozen=True, slots=True)
class Fell:
    """1 if variable `name` is lower than one decision ago."""

    name: str

    def __call__(self, history: Sequence[Variables], _terminated: bool) -> float:
        return float(history[-1][self.name] < history[-2][self.name])


@dataclass(frozen=True, slots=True)
class Gained:
    """How much variable `name` is higher than one decision ago; 0 if it is not."""

    name: str

    def __call__(self, history: Sequence[Variables], _terminated: bool) -> float:
        return max(0.0, history[-1][self.name] - history[-2][self.name])


def moved(history: Sequence[Variables], _terminated: bool) -> float:
    """Map units between here and where the agent stood HISTORY_STEPS decisions ago, or at the episode's start."""
    old, new = history[0], history[-1]
    dx, dy = new["POSITION_X"] - old["POSITION_X"], new["POSITION_Y"] - old["POSITION_Y"]
    return (dx * dx + dy * dy) ** 0.5


def check_weights(weights: Any, components: Collection[str]) -> dict[str, float]:
    """A user's reward weights, component -> weight, as a dict of floats.

    Raises:
        ConfigError: not a mapping, an unknown component, or a weight that is not a finite number.
    """
    if not isinstance(weights, Mapping):
        raise ConfigError(f"env.reward_weights: got {weights!r}, want a mapping of component to weight")
    for name in weights:
        if name not in components:
            hint = nearest(str(name), components)
            raise ConfigError(
                f"env.reward_weights: unknown component {name!r}{hint}; want some of {', '.join(components)}"
            )
    return {name: typed(float, weight, f"env.reward_weights, {name}") for name, weight in weights.items()}


class Rewarder:
    """Computes rewards from the variables of one game; keeps the last HISTORY_STEPS decisions of its episode."""

    def __init__(self, events: Mapping[str, Event], weights: Mapping[str, float]):
        """`events` and `weights` are by component."""
        self.weights = dict(weights)
        self._terms = [(name, weights[name], event) for name, event in events.items()]
        self._history: deque[Variables] = deque(maxlen=HISTORY_STEPS + 1)

    def reset(self, variables: Variables) -> None:
        """Starts an episode with the variables of its first observation. They are kept, not copied."""
        self._history.clear()
        self._history.append(variables)

    def step(self, variables: Variables, terminated: bool) -> dict[str, float]:
        """Rewards of one decision, by component, weights applied; the reward is their sum.

        Args:
            variables: the variables after the decision; kept, not copied. After the agent's death, the last values
                that the game gave.
            terminated: the episode terminated (not by a time-out).

        Raises:
            TaskError: an event gave no number, or one that is negative or not finite.
        """
        assert self._history, "Rewarder.step before reset"
        self._history.append(variables)
        history = self._history  # "0.0 +" turns -0.0 into 0.0 for the logs
        return {name: 0.0 + weight * _checked(name, event(history, terminated)) for name, weight, event in self._terms}


def _checked(name: str, amount: Any) -> float:
    try:
        number = float(amount)
    except (TypeError, ValueError):
        number = math.nan
    if 0.0 <= number < math.inf:
        return number
    raise TaskError(f"reward {name!r}: its event gave {amount!r}, want a finite number of at least 0")


def return_range(
    rewards: Mapping[str, Reward], weights: Mapping[str, float], env: EnvConfig, discount: float
) -> tuple[float, float]:
    """The range of discounted returns of a scenario, computed from how often its events can come.

    Each component adds the maximum of its event: to the upper end if its weight is positive, else to the lower end. So
    the upper end is the return of a player that gets every positive event at its full pace, and no negative one.

    A time-out does not end a return: it is a truncation, and learners bootstrap from the frame after it. 0 is inside
    the range and not at its end, because it is the return of an episode without events.

    Args:
        rewards: the components.
        weights: component -> weight, for all of them.
        env: its profile and frame skip.
        discount: of one decision, 0 <= discount < 1.

    Returns:
        (v_min, v_max); equal if all weights are 0.
    """
    low = high = 0.0
    for name, reward in rewards.items():
        start = 0.0  # decisions from now to the first event of this pace
        paces = reward.levdoom_paces if env.profile == "levdoom" else None
        for pace in reward.paces if paces is None else paces:
            apart = max(1.0, pace.tics / env.frame_skip)  # decisions from one event to the next
            merged = apart * env.frame_skip / pace.tics if reward.adds_up else 1.0  # events in one decision
            duration = apart * pace.times / merged
            amount = pace.amount * merged * discount**start * (1 - discount**duration) / (1 - discount**apart)
            start += duration
            worth, also = weights[name], 0.0 if pace.needs is None else weights[pace.needs]
            low += amount * min(0.0, worth + max(0.0, also))
            high += amount * max(0.0, worth + min(0.0, also))
    edge = _EDGE_SHARE * (high - low)
    return min(low, -edge), max(high, edge)
