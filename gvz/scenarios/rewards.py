"""Rewards as named events of one decision, each with a weight. Imports tier 0."""

from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

from gvz.errors import ConfigError
from gvz.specs import typed

Variables = Mapping[str, float]
"""What the game says after a decision: name of a game or bookkeeping variable -> value."""

Event = Callable[[Sequence[Variables], bool], float]
"""f(history, terminated) -> how much of the event this decision brought, at least 0 (the weight has the sign).

`history` holds the variables after each of the last decisions, oldest first: history[-1] is now, history[-2] one
decision ago, back to the start of the episode or HISTORY_STEPS decisions, whichever is nearer.
"""

HISTORY_STEPS = 5
"""decisions an event can look back (eq. 3.5 needs five)"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Reward:
    """One component of a scenario's reward: an event and what it is worth."""

    event: Event
    weight: float
    levdoom: float
    """the weight in profile levdoom"""


def living(_history: Sequence[Variables], _terminated: bool) -> float:
    """1 for every decision."""
    return 1.0


def death(_history: Sequence[Variables], terminated: bool) -> float:
    """1 if the episode ended by the rules: in every scenario that is the agent's death."""
    return float(terminated)


@dataclass(frozen=True, slots=True)
class Rose:
    """1 if variable `name` is higher than one decision ago. An object, because a closure cannot be pickled."""

    name: str

    def __call__(self, history: Sequence[Variables], _terminated: bool) -> float:
        return float(history[-1][self.name] > history[-2][self.name])


@dataclass(frozen=True, slots=True)
class Fell:
    """1 if variable `name` is lower than one decision ago."""

    name: str

    def __call__(self, history: Sequence[Variables], _terminated: bool) -> float:
        return float(history[-1][self.name] < history[-2][self.name])


def moved(history: Sequence[Variables], _terminated: bool) -> float:
    """Map units between here and where the agent stood HISTORY_STEPS decisions ago, or at the episode's start."""
    old, new = history[0], history[-1]
    dx, dy = new["POSITION_X"] - old["POSITION_X"], new["POSITION_Y"] - old["POSITION_Y"]
    return (dx * dx + dy * dy) ** 0.5


def check_weights(weights: Any, components: Collection[str]) -> dict[str, float]:
    """Reward weights as somebody gave them, as a dict of floats.

    Args:
        weights: component -> weight.
        components: names of the components there are.

    Raises:
        ConfigError: not a mapping, a name that is no component's, or a weight that is no finite number.
    """
    if not isinstance(weights, Mapping):
        raise ConfigError(f"env.reward_weights: got {weights!r}, want a mapping of component to weight")
    for name in weights:
        if name not in components:
            near = get_close_matches(str(name), components, n=1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            raise ConfigError(
                f"env.reward_weights: unknown component {name!r}{hint}; want some of {', '.join(components)}"
            )
    return {name: typed(float, weight, f"env.reward_weights, {name}") for name, weight in weights.items()}


class Rewarder:
    """Turns the variables of one game into rewards; remembers the last HISTORY_STEPS decisions of its episode."""

    def __init__(self, events: Mapping[str, Event], weights: Mapping[str, float]):
        """Takes events and their weights, both by component."""
        self.weights = dict(weights)
        self._terms = [(name, weights[name], event) for name, event in events.items()]
        self._history: deque[Variables] = deque(maxlen=HISTORY_STEPS + 1)

    def reset(self, variables: Variables) -> None:
        """Starts an episode with the variables that came with its first observation. They are kept, not copied."""
        self._history.clear()
        self._history.append(variables)

    def step(self, variables: Variables, terminated: bool) -> dict[str, float]:
        """Rewards of one decision, by component, weights applied; the reward is their sum.

        Args:
            variables: the variables after the decision; kept, not copied. When the agent died, the last that could
                be read.
            terminated: the episode ended by the rules (a time-out is not).
        """
        assert self._history, "Rewarder.step before reset"
        self._history.append(variables)
        history = self._history  # "0.0 +" keeps negative zeros out of the logs
        return {name: 0.0 + weight * event(history, terminated) for name, weight, event in self._terms}
