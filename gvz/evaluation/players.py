"""Who plays an evaluation episode: chance, nobody, a sweep, a script, or any function of frames. The policy of a
training run is in gvz.evaluation.trained.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Protocol, assert_never

import numpy as np

from actors.preprocess import push_frame, start_stack
from gvz.core.env_config import EnvConfig, SimplePlayer
from gvz.evaluation.scripted import ScriptedPlayer, SweepPlayer

if TYPE_CHECKING:
    from gvz.env import DoomEnv
    from gvz.observation import Observation


class Player(Protocol):
    """Chooses one action at a time. Everything it does follows from the episode's seed."""

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        """An episode of `env` has begun with `observation`. The player may look at `env`, never step it."""
        ...

    def act(self) -> int:
        """The next action."""
        ...

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        """What the action led to."""
        ...


class RandomPlayer:
    """Uniformly random actions."""

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        self._num_actions = len(env.action_meanings)
        self._rng = np.random.default_rng(seed)

    def act(self) -> int:
        return int(self._rng.integers(self._num_actions))

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        """Ignores observations."""


class IdlePlayer:
    """Presses nothing: the action without a button, which `action_set="combinations"` has in every scenario."""

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        self._action = env.action_meanings.index(())

    def act(self) -> int:
        return self._action

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        """Nobody is there to look."""


class FramePlayer:
    """Plays by a function of the last frames, `choose(stack) -> action`.

    The stack is uint8[H, W, stack_size * C], oldest frame first along the channels; at an episode's start the first
    frame is repeated. It changes with the next decision: copy it to keep it.
    """

    def __init__(self, choose: Callable[[np.ndarray], int], stack_size: int = 4):
        self._choose, self._stack_size = choose, stack_size

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        assert isinstance(observation, np.ndarray)
        height, width, channels = observation.shape
        self._stack = np.zeros((height, width, self._stack_size * channels), np.uint8)
        start_stack(self._stack, observation)

    def act(self) -> int:
        return int(self._choose(self._stack))

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        assert isinstance(observation, np.ndarray)
        push_frame(self._stack, observation)


SIMPLE_PLAYERS: Mapping[SimplePlayer, Callable[[], Player]] = {
    "random": RandomPlayer,
    "idle": IdlePlayer,
    "sweep": SweepPlayer,
    "scripted": ScriptedPlayer,
}


def player_env(kind: SimplePlayer, env: EnvConfig) -> EnvConfig:
    """`env` as a player of this kind needs it.

    All but the scripted one look at nothing: they get the smallest screen, which changes no score. The idle one needs
    the action without a button, the scripted one labels on the default screen, by whose pixels it aims.
    """
    blind = dataclasses.replace(env, render_width=160, render_height=120)
    match kind:
        case "random":
            return blind
        case "idle":
            return dataclasses.replace(blind, action_set="combinations")
        case "sweep":
            return dataclasses.replace(blind, action_set="buttons")
        case "scripted":
            return dataclasses.replace(env, action_set="buttons", buffers=("labels",))
        case _:
            assert_never(kind)
