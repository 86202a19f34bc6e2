"""What an agent is: pure functions and the sizes they fit.

A further agent is a module beside this file that sets `AGENT`, something callable as `AGENT(config, spec)` that returns
an `Agent`, and a module of the same name in learner/agents/configs that sets `CONFIG`, the class of its configuration.
(They are two files because a command line must be read without importing jax.) An agent of a user's own is one file
anywhere that sets both; its name is the file's path. docs/AGENTS.md has a worked example.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from gvz.core.errors import ConfigError
from gvz.core.registry import find
from learner.config import AgentConfig, agent_config_class
from learner.networks import Params, QNetwork
from learner.observation import Observation
from learner.replay import Transitions


@dataclass(frozen=True, kw_only=True, slots=True)
class AgentSpec:
    """What an agent must fit."""

    obs_shape: tuple[int, int, int]
    """(H, W, stack * C) of an observation's frames, uint8"""
    num_actions: int
    num_tasks: int
    v_min: float
    """smallest return of the run's tasks"""
    v_max: float
    """largest return"""
    num_variables: int = 0
    """game variables of an observation, V"""
    num_past_actions: int = 0
    """actions of an observation, K"""
    num_sights: int = 0
    """flags of what is in sight that transitions have, C"""
    masked: bool = False
    """observations have masks of actions"""

    def __post_init__(self) -> None:
        if not self.v_min < self.v_max:
            raise ConfigError(f"AgentSpec.v_min, v_max: got {self.v_min}, {self.v_max}, want v_min < v_max")
        for name in ("num_actions", "num_tasks"):
            if getattr(self, name) < 1:
                raise ConfigError(f"AgentSpec.{name}: got {getattr(self, name)}, want at least 1")

    def zeros(self, batch_size: int = 1) -> Observation:
        """A batch of empty observations."""
        B = batch_size
        return Observation(
            frames=jnp.zeros((B, *self.obs_shape), jnp.uint8),
            vector=jnp.zeros((B, self.num_variables)),
            actions=jnp.zeros((B, self.num_past_actions), jnp.int32),
            task=jnp.zeros(B, jnp.int32),
            mask=jnp.ones((B, self.num_actions), bool) if self.masked else None,
        )


class Evaluation(NamedTuple):
    """What an agent thinks of a batch of observations with its noise off."""

    action: Int[Array, " B"]
    """the greedy action: the largest of `q_values` or `policy` among the allowed"""
    q_values: Float[Array, "B A"] | None
    """action values, if the agent has them"""
    probabilities: Float[Array, "B A N"] | None = None
    """return distributions, if the agent has them"""
    atoms: Float[Array, " N"] | None = None
    """the returns that `probabilities` stand for"""
    policy: Float[Array, "B A"] | None = None
    """the probability of each action, if the agent learns a policy"""
    value: Float[Array, " B"] | None = None
    """the value of the observation, if the agent learns one beside its policy"""


class AgentLoss(NamedTuple):
    """One number per sample of a batch."""

    loss: Float[Array, " B"]
    """what the gradient step makes smaller, before any weights"""
    priority: Float[Array, " B"]
    """how surprising the sample was, >= 0: |TD error|, or the KL divergence if distributional"""
    q_tm1: Float[Array, " B"]
    """online Q(s, a) of the action taken"""
    td_error: Float[Array, " B"]
    """r + discount * Q'(s', a') - Q(s, a), for the records"""


class Agent(Protocol):
    """Pure functions; the object holds configuration only and is hashable."""

    @property
    def spec(self) -> AgentSpec:
        """What it was made for."""
        ...

    def epsilon(self, env_steps: int) -> float:
        """Probability of a uniformly random action after this number of decisions since warm-up."""
        ...

    def init(self, key: PRNGKeyArray) -> Params:
        """Fresh parameters."""
        ...

    def act(
        self, params: Params, key: PRNGKeyArray, obs: Observation, epsilon: Float[Array, ""]
    ) -> tuple[Int[Array, " B"], Float[Array, "B E"]]:
        """Exploring actions: with fresh noise, or uniformly random with probability epsilon, or both.

        Returns: (actions, what the learner wants to be recorded with each of them; E = 0 for nothing).
        """
        ...

    def evaluate(self, params: Params, obs: Observation) -> Evaluation:
        """Greedy actions and values without noise."""
        ...


@runtime_checkable
class FoldingAgent(Agent, Protocol):
    """An agent that can act by parameters of another form than it learns, made once for a stretch of decisions.

    `act` takes both forms.
    """

    @property
    def fold_period_steps(self) -> int:
        """Decisions of each game in a stretch; 0: nothing is folded."""
        ...

    def fold(self, params: Params, key: PRNGKeyArray) -> Params:
        """What `act` takes for a stretch. `act` gets the same key at the first of its decisions."""
        ...


def folding(agent: Agent) -> FoldingAgent | None:
    """The agent, if its actors are to fold its parameters."""
    return agent if isinstance(agent, FoldingAgent) and agent.fold_period_steps else None


@runtime_checkable
class OffPolicyAgent(Agent, Protocol):
    """An agent that learns from transitions of a replay."""

    def loss(self, online_params: Params, target_params: Params, key: PRNGKeyArray, batch: Transitions) -> AgentLoss:
        """Per-sample losses; differentiable in `online_params`, constant in `target_params`."""
        ...


class RolloutSteps(NamedTuple):
    """T steps in a row of B windows of records; step t goes from record t to record t + 1.

    A step that begins at the last record of an episode was not taken by anybody. It has numbers like any other, and
    weight 0 in the loss; the step before it has `terminated` or `truncated`, so nothing flows back from it.
    """

    r_t: Float[Array, "T B"]
    terminated: Bool[Array, "T B"]
    """the step ended its episode by the rules"""
    truncated: Bool[Array, "T B"]
    """the step ended its episode otherwise: by a time-out, or because the game died"""
    extras_tm1: Float[Array, "T B E"]
    """what the agent recorded where the step began"""
    extras_t: Float[Array, "T B E"]
    """what it recorded where the step ended: also for an episode's final observation"""


class Targets(NamedTuple):
    """What is worked out of a rollout once, before its first gradient step."""

    returns: Float[Array, "*batch"]
    advantages: Float[Array, "*batch"]


class Samples(NamedTuple):
    """A minibatch of steps."""

    obs: Observation
    """where the step began"""
    a_tm1: Int[Array, " B"]
    extras: Float[Array, "B E"]
    """what the agent recorded with the action"""
    targets: Targets
    weight: Float[Array, " B"]
    """1, or 0 for a step that nobody took"""


class SampleLosses(NamedTuple):
    """One number per sample of a minibatch."""

    loss: Float[Array, " B"]
    """what the gradient step makes smaller, before the weights"""
    metrics: dict[str, Float[Array, " B"]]
    """for the records, by name: means are logged, and of a name that ends in _max the largest"""


@runtime_checkable
class OnPolicyAgent(Agent, Protocol):
    """An agent that learns from the rollouts that it has just played. Its class of configuration has `on_policy`."""

    def targets(self, steps: RolloutSteps) -> Targets:
        """Returns and advantages [T, B] from rewards and from what `act` recorded; constant."""
        ...

    def losses(self, params: Params, batch: Samples) -> SampleLosses:
        """Per-sample losses; differentiable in `params`."""
        ...


def make_agent(config: AgentConfig, spec: AgentSpec) -> Agent:
    """Builds the agent that `config.name` names: a module in learner/agents, or the path of a Python file.

    Raises:
        ConfigError: no such agent, a configuration of another agent, or one that the agent cannot be built from.
    """
    if not isinstance(config, kind := agent_config_class(config.name)):
        raise ConfigError(
            f"agent.name: got {config.name!r} in a {type(config).__name__}, want a {kind.__name__}; to change the "
            "agent of a configuration, use learner.config.change_agent"
        )
    return find("learner.agents", "AGENT", config.name, "agent.name", "config", "spec")(config, spec)


def allowed_values(q_values: Float[Array, "B A"], mask: Bool[Array, "B A"] | None) -> Float[Array, "B A"]:
    """The values with minus infinity for masked actions, so that none of them is the largest."""
    return q_values if mask is None else jnp.where(mask, q_values, -jnp.inf)


def epsilon_greedy(
    key: PRNGKeyArray,
    q_values: Float[Array, "B A"],
    epsilon: Float[Array, ""],
    mask: Bool[Array, "B A"] | None = None,
) -> Int[Array, " B"]:
    """The greedy action of each row, or with probability epsilon a uniformly random one (thesis, Algorithm 1).

    Both among the actions that the mask allows.
    """
    key_coin, key_action = jax.random.split(key)
    batch_size, num_actions = q_values.shape
    explore = jax.random.uniform(key_coin, (batch_size,)) < epsilon
    if mask is None:
        random_action = jax.random.randint(key_action, (batch_size,), 0, num_actions)
    else:
        random_action = jax.random.categorical(key_action, jnp.where(mask, 0.0, -jnp.inf))
    greedy = jnp.argmax(allowed_values(q_values, mask), axis=-1)
    return jnp.where(explore, random_action, greedy).astype(jnp.int32)


@dataclass(frozen=True, slots=True)
class NetworkAgent(ABC):
    """An agent with one `QNetwork`, which explores by the epsilon of its configuration. The base of ours."""

    config: AgentConfig
    spec: AgentSpec

    @abstractmethod
    def network(self) -> QNetwork:
        """The network, without its parameters."""

    def outputs(
        self, params: Params, obs: Observation, noise: dict[str, Float[Array, "B _"]] | None = None
    ) -> Float[Array, "B A N"]:
        """What the network answers. `noise` is each row's own."""
        return jnp.asarray(self.network().apply(params, obs, noise))

    def outputs_and_sight(
        self, params: Params, obs: Observation
    ) -> tuple[Float[Array, "B A N"], Float[Array, "B C"] | None]:
        """What the network answers, and its logits of what is in sight, if it has them."""
        outputs, variables = self.network().apply(params, obs, mutable=["sight"])
        return jnp.asarray(outputs), jnp.asarray(variables["sight"]["logits"][0]) if self.spec.num_sights else None

    def init(self, key: PRNGKeyArray) -> Params:
        return {"params": self.network().init(key, self.spec.zeros())["params"]}

    def epsilon(self, env_steps: int) -> float:
        return self.config.epsilon(env_steps)


@dataclass(frozen=True, slots=True)
class QAgent(NetworkAgent):
    """A `NetworkAgent` whose network answers Q(s, a)."""

    def q_values(self, params: Params, obs: Observation) -> Float[Array, "B A"]:
        return self.outputs(params, obs)[:, :, 0]

    def evaluate(self, params: Params, obs: Observation) -> Evaluation:
        q = self.q_values(params, obs)
        return Evaluation(jnp.argmax(allowed_values(q, obs.mask), axis=-1), q)
