"""Who plays an evaluation episode: chance, nobody, a script, or a trained policy. Imports numpy, gymnasium,
gvz.evaluation.scripted; actors.policy where there is a policy to load.

A `PlayerSpec` is data that travels to worker processes; `make_player` makes the player there.
"""

import dataclasses
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol, assert_never

import numpy as np

from actors.preprocess import push_frame, start_stack
from gvz.errors import ConfigError
from gvz.evaluation.scripted import ScriptedPlayer
from gvz.specs import EnvConfig
from gvz.transport.messages import ParamsHeader

if TYPE_CHECKING:
    from gvz.env import DoomEnv
    from gvz.observation import Observation

PlayerKind = Literal["random", "idle", "scripted", "policy"]


@dataclass(frozen=True, kw_only=True, slots=True)
class PlayerSpec:
    """A player as data. All but `kind` is for kind policy."""

    kind: PlayerKind
    policy: bytes = b""
    """exported greedy acting function for one game"""
    params: np.ndarray | None = None
    """float32[P]"""
    obs_shape: tuple[int, int, int] = (84, 84, 12)
    """(H, W, stack * C) of what the policy sees"""
    conditioned_on: tuple[str, ...] = ()
    """ids of the tasks whose index the policy is given; none if it is not given any"""


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
        """Chance looks at nothing."""


class IdlePlayer:
    """Presses nothing: the action without a button, which `action_set="combinations"` has in every scenario."""

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        self._action = env.action_meanings.index(())

    def act(self) -> int:
        return self._action

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        """Nobody is there to look."""


class PolicyPlayer:
    """A trained agent: greedy, noise off."""

    def __init__(self, spec: PlayerSpec):
        from actors.policy import make_policy

        if spec.params is None or not spec.policy:
            raise ConfigError("player of kind policy: want its exported function and its parameters")
        self._obs = np.zeros((1, *spec.obs_shape), np.uint8)
        self._task = np.zeros(1, np.int32)
        self._conditioned_on = spec.conditioned_on
        # num_actions is for a random policy; the exported function knows its own
        self._policy = make_policy(
            spec.policy, num_actions=1, num_params=spec.params.size, obs_shape=self._obs.shape, seed=0
        )
        self._policy.set_params(spec.params, ParamsHeader(version=0, num_updates=0))

    def begin(self, env: "DoomEnv", observation: "Observation", info: dict[str, Any], seed: int) -> None:
        if self._conditioned_on:
            self._task[0] = self._conditioned_on.index(env.task.id)
        assert isinstance(observation, np.ndarray)
        start_stack(self._obs[0], observation)

    def act(self) -> int:
        return int(self._policy.act(self._obs, self._task)[0])

    def observe(self, observation: "Observation", info: dict[str, Any]) -> None:
        assert isinstance(observation, np.ndarray)
        push_frame(self._obs[0], observation)


def make_player(spec: PlayerSpec) -> Player:
    """The player, for any number of episodes of any tasks."""
    match spec.kind:
        case "random":
            return RandomPlayer()
        case "idle":
            return IdlePlayer()
        case "scripted":
            return ScriptedPlayer()
        case "policy":
            return PolicyPlayer(spec)
        case _:
            assert_never(spec.kind)


def player_env(kind: PlayerKind, env: EnvConfig) -> EnvConfig:
    """`env` as a player of this kind needs it.

    Chance and nobody look at nothing: they get the smallest screen, which changes no score. The idle one needs the
    action without a button, the scripted one labels on the default screen, by whose pixels it aims.
    """
    blind = dataclasses.replace(env, render_width=160, render_height=120)
    match kind:
        case "random":
            return blind
        case "idle":
            return dataclasses.replace(blind, action_set="combinations")
        case "scripted":
            return dataclasses.replace(env, action_set="buttons", buffers=("labels",))
        case "policy":
            return env
        case _:
            assert_never(kind)
