"""What an agent is: four pure functions.

A third agent is one file that sets `AGENT` to something callable as `AGENT(config, spec)` which returns an `Agent`.
Beside this file its `agent.name` is its file name; anywhere else, its path. docs/AGENTS.md has a worked example.
"""

import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8

from gvz.core.errors import ConfigError
from gvz.core.registry import discover
from learner.config import AgentConfig
from learner.networks import Params
from learner.replay import Transitions


@dataclass(frozen=True, kw_only=True, slots=True)
class AgentSpec:
    """What an agent must fit."""

    obs_shape: tuple[int, int, int]
    """(H, W, stack * C) of an observation, uint8"""
    num_actions: int
    num_tasks: int
    v_min: float
    """smallest return the distributional part represents; agent.v_min overrides it"""
    v_max: float
    """largest return; agent.v_max overrides it"""

    def __post_init__(self) -> None:
        if not self.v_min < self.v_max:
            raise ConfigError(f"AgentSpec.v_min, v_max: got {self.v_min}, {self.v_max}, want v_min < v_max")
        for name in ("num_actions", "num_tasks"):
            if getattr(self, name) < 1:
                raise ConfigError(f"AgentSpec.{name}: got {getattr(self, name)}, want at least 1")


class Evaluation(NamedTuple):
    """What an agent thinks of a batch of observations with its noise off."""

    action: Int[Array, "B"]
    """the greedy action"""
    q_values: Float[Array, "B A"]
    probabilities: Float[Array, "B A N"] | None = None
    """return distributions, if the agent has them"""
    atoms: Float[Array, "N"] | None = None
    """the returns that `probabilities` stand for"""


class AgentLoss(NamedTuple):
    """One number per sample of a batch."""

    loss: Float[Array, "B"]
    """what the gradient step makes smaller, before any weights"""
    priority: Float[Array, "B"]
    """how surprising the sample was, >= 0: |TD error|, or the KL divergence if distributional"""
    q_tm1: Float[Array, "B"]
    """online Q(s, a) of the action taken"""
    td_error: Float[Array, "B"]
    """r + discount * Q'(s', a') - Q(s, a), for the records"""


class Agent(Protocol):
    """Pure functions; the object holds configuration only and is hashable."""

    @property
    def spec(self) -> AgentSpec:
        """What it was made for."""
        ...

    def init(self, key: PRNGKeyArray) -> Params:
        """Fresh parameters."""
        ...

    def act(
        self,
        params: Params,
        key: PRNGKeyArray,
        obs: UInt8[Array, "B H W C"],
        task: Int[Array, "B"],
        epsilon: Float[Array, ""],
    ) -> Int[Array, "B"]:
        """Exploring actions: with fresh noise, or uniformly random with probability epsilon, or both."""
        ...

    def evaluate(self, params: Params, obs: UInt8[Array, "B H W C"], task: Int[Array, "B"]) -> Evaluation:
        """Greedy actions and values without noise."""
        ...

    def loss(self, online_params: Params, target_params: Params, key: PRNGKeyArray, batch: Transitions) -> AgentLoss:
        """Per-sample losses; differentiable in `online_params`, constant in `target_params`."""
        ...


def make_agent(config: AgentConfig, spec: AgentSpec) -> Agent:
    """Builds the agent that `config.name` names: a module in learner/agents, or the path of a Python file.

    Raises:
        ConfigError: no such agent, or a configuration that the agent cannot be built from.
    """
    if config.name.endswith(".py"):
        return _agent_in_file(Path(config.name).resolve())(config, spec)
    agents = {name: m.AGENT for name, m in discover("learner.agents").items() if hasattr(m, "AGENT")}
    if config.name not in agents:
        raise ConfigError(
            f"agent.name: got {config.name!r}, want one of {', '.join(agents)}, or the path of a file, ./my_agent.py"
        )
    return agents[config.name](config, spec)


@cache  # two agents of one configuration are equal, so their class must be one
def _agent_in_file(file: Path) -> Callable[[AgentConfig, AgentSpec], Agent]:
    if not file.is_file():
        raise ConfigError(f"agent.name: no file {file}; give a path from here, or an absolute one")
    name = f"agent_in_{file.stem}"
    module = sys.modules[name] = ModuleType(name)
    SourceFileLoader(name, str(file)).exec_module(module)
    if not hasattr(module, "AGENT"):
        raise ConfigError(f"agent.name: {file} does not set AGENT, want `AGENT = TheClassOfTheAgent` at its end")
    return module.AGENT


def epsilon_greedy(key: PRNGKeyArray, q_values: Float[Array, "B A"], epsilon: Float[Array, ""]) -> Int[Array, "B"]:
    """The greedy action of each row, or with probability epsilon a uniformly random one (thesis, Algorithm 1)."""
    key_coin, key_action = jax.random.split(key)
    batch_size, num_actions = q_values.shape
    explore = jax.random.uniform(key_coin, (batch_size,)) < epsilon
    random_action = jax.random.randint(key_action, (batch_size,), 0, num_actions)
    return jnp.where(explore, random_action, jnp.argmax(q_values, axis=-1)).astype(jnp.int32)
