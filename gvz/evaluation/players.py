"""Who plays an evaluation episode: a trained policy or chance. Imports numpy, actors.policy and actors.preprocess.

A `PlayerSpec` is data that travels to worker processes; `make_player` makes the player there.
"""

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import gymnasium
import numpy as np

from actors.policy import make_policy
from actors.preprocess import push_frame, start_stack
from gvz.errors import ConfigError
from gvz.transport.messages import ParamsHeader

PlayerKind = Literal["random", "policy"]


@dataclass(frozen=True, kw_only=True, slots=True)
class PlayerSpec:
    """A player as data."""

    kind: PlayerKind
    policy: bytes = b""
    """exported greedy acting function for one game (kind policy)"""
    params: np.ndarray | None = None
    """float32[P] (kind policy)"""
    stack_size: int = 4
    """frames in an observation (kind policy)"""


class Player(Protocol):
    """Chooses one action at a time. Everything it does follows from the episode's seed."""

    def begin(self, frame: np.ndarray, info: dict[str, Any], seed: int) -> None:
        """An episode has begun with `frame` uint8[H, W, C]."""
        ...

    def act(self) -> int:
        """The next action."""
        ...

    def observe(self, frame: np.ndarray, info: dict[str, Any]) -> None:
        """What the action led to."""
        ...


class RandomPlayer:
    """Uniformly random actions."""

    def __init__(self, num_actions: int):
        self._num_actions = num_actions
        self._rng = np.random.default_rng(0)

    def begin(self, frame: np.ndarray, info: dict[str, Any], seed: int) -> None:
        self._rng = np.random.default_rng(seed)

    def act(self) -> int:
        return int(self._rng.integers(self._num_actions))

    def observe(self, frame: np.ndarray, info: dict[str, Any]) -> None:
        """Chance looks at nothing."""


class PolicyPlayer:
    """A trained agent: greedy, noise off."""

    def __init__(self, spec: PlayerSpec, frame_shape: tuple[int, int, int], num_actions: int):
        if spec.params is None or not spec.policy:
            raise ConfigError("player of kind policy: want its exported function and its parameters")
        height, width, channels = frame_shape
        self._obs = np.zeros((1, height, width, channels * spec.stack_size), np.uint8)
        self._task = np.zeros(1, np.int32)
        self._policy = make_policy(
            spec.policy, num_actions=num_actions, num_params=spec.params.size, obs_shape=self._obs.shape, seed=0
        )
        self._policy.set_params(spec.params, ParamsHeader(version=0, num_updates=0))

    def begin(self, frame: np.ndarray, info: dict[str, Any], seed: int) -> None:
        start_stack(self._obs[0], frame)

    def act(self) -> int:
        return int(self._policy.act(self._obs, self._task)[0])

    def observe(self, frame: np.ndarray, info: dict[str, Any]) -> None:
        push_frame(self._obs[0], frame)


def make_player(spec: PlayerSpec, env: gymnasium.Env[np.ndarray, int]) -> Player:
    """The player for an environment with uint8[H, W, C] frames and discrete actions."""
    space, actions = env.observation_space, env.action_space
    assert isinstance(space, gymnasium.spaces.Box)
    assert isinstance(actions, gymnasium.spaces.Discrete)
    if spec.kind == "random":
        return RandomPlayer(int(actions.n))
    height, width, channels = space.shape
    return PolicyPlayer(spec, (height, width, channels), int(actions.n))
