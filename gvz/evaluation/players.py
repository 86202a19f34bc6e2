"""Players of evaluation episodes that need no training run, and players made of a function of frames. The policies of
training runs are in gvz.evaluation.trained.

A new simple player is a class here, a line in CLASSES, and a line in gvz.evaluation.simple.
"""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from actors.preprocess import push_frame, start_stack
from gvz.core.errors import ConfigError
from gvz.evaluation.scenarios.base import Sight, script_of, sweep

if TYPE_CHECKING:
    from gvz.env import Action, DoomEnv
    from gvz.observation import Observation


class Player(Protocol):
    """Chooses one action at a time. Everything it does follows from the episode's seed."""

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        """An episode of `env` has begun with `observation`. The player may look at `env`, never step it."""
        ...

    def act(self) -> "Action":
        """The next action, as `DoomEnv.step` takes it."""
        ...

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        """What the action led to."""
        ...


class _Blind:
    """A player that ignores observations."""

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        """Ignores it."""


class RandomPlayer(_Blind):
    """Uniformly random actions."""

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        self._num_actions = len(env.action_meanings)
        self._rng = np.random.default_rng(seed)

    def act(self) -> int:
        return int(self._rng.integers(self._num_actions))


class IdlePlayer(_Blind):
    """Presses nothing: the action without a button, which `action_set="combinations"` has in every scenario."""

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        self._action = env.action_meanings.index(())

    def act(self) -> int:
        return self._action


class SweepPlayer(_Blind):
    """Plays each scenario by a fixed sequence of buttons. Wants action_set="buttons"."""

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        self._actions = _action_of_button(env)
        self._buttons = sweep(env.task.scenario.id)

    def act(self) -> int:
        return self._actions[next(self._buttons)]


class ScriptedPlayer:
    """Plays each scenario by its script. Wants an environment with buffers=("labels",) and action_set="buttons"."""

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        self._env, self._actions = env, _action_of_button(env)
        self._sight = Sight(env.config.render_width, env.config.render_height, np.random.default_rng(seed))
        self.observe(observation, info)
        self._buttons = script_of(env.task.scenario.id)(self._sight)

    def act(self) -> int:
        return self._actions[next(self._buttons)]

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        assert isinstance(observation, dict)
        self._sight.screen = observation["screen"]
        self._sight.labels = self._env.labels()
        self._sight.variables = info["variables"]


def _action_of_button(env: "DoomEnv") -> dict[str, int]:
    return {held[0]: action for action, held in enumerate(env.action_meanings) if held}


CLASSES: Mapping[str, Callable[[], Player]] = {
    "random": RandomPlayer,
    "idle": IdlePlayer,
    "sweep": SweepPlayer,
    "scripted": ScriptedPlayer,
}
"""of the simple players, by name"""


class FramePlayer:
    """Plays by a function of the last frames, `choose(stack) -> action`; the action is what `DoomEnv.step` takes.

    The stack is uint8[H, W, stack_size * C], oldest frame first along the channels; at an episode's start the first
    frame is repeated. It changes with the next decision: copy it to keep it.
    """

    def __init__(self, choose: Callable[[np.ndarray], "Action"], stack_size: int = 4):
        if stack_size < 1:
            raise ConfigError(f"FramePlayer: stack_size: got {stack_size}, want at least 1")
        self._choose, self._stack_size = choose, stack_size

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        if not isinstance(observation, np.ndarray):
            raise ConfigError(
                f"FramePlayer: got observations of {', '.join(observation)} (env.buffers), want frames alone; a player "
                "of your own (docs/EVALUATION.md) can have the others"
            )
        height, width, channels = observation.shape
        self._stack = np.zeros((height, width, self._stack_size * channels), np.uint8)
        start_stack(self._stack, observation)

    def act(self) -> "Action":
        return self._choose(self._stack)

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        assert isinstance(observation, np.ndarray)
        push_frame(self._stack, observation)
