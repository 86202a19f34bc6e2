"""DQN: thesis 4.1, Algorithm 1.

The plain agent, written out: a target network, the Huber loss, epsilon-greedy exploration. Linear Q outputs (thesis
4.1.5 speaks of a softmax over Q values, which cannot represent returns). The n-step return is the replay's.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8

from gvz.core.errors import ConfigError
from learner import losses
from learner.agents.base import AgentLoss, AgentSpec, Evaluation, Params, epsilon_greedy
from learner.config import AgentConfig
from learner.networks import QNetwork, check_fits
from learner.replay import Transitions


@dataclass(frozen=True, slots=True)
class DQN:
    """Deep Q-learning with experience replay and a fixed target network.

    Raises:
        ConfigError: a component of Rainbow is switched on, or the frames are too small for the convolutions.
    """

    config: AgentConfig
    spec: AgentSpec

    def __post_init__(self) -> None:
        for name, off in (("double", False), ("dueling", False), ("noisy", "off"), ("distributional", False)):
            if getattr(self.config, name) != off:
                raise ConfigError(
                    f"agent.{name}: got {getattr(self.config, name)!r}, but dqn has no such part; "
                    f"set {name}={off!r}, or name='rainbow'"
                )
        check_fits(self.config, *self.spec.obs_shape[:2])

    def q_values(self, params: Params, obs: UInt8[Array, "B H W C"], task: Int[Array, "B"]) -> Float[Array, "B A"]:
        return jnp.asarray(self._network().apply(params, obs, task))[:, :, 0]

    def init(self, key: PRNGKeyArray) -> Params:
        obs = jnp.zeros((1, *self.spec.obs_shape), jnp.uint8)
        return self._network().init(key, obs, jnp.zeros((1,), jnp.int32))

    def act(
        self,
        params: Params,
        key: PRNGKeyArray,
        obs: UInt8[Array, "B H W C"],
        task: Int[Array, "B"],
        epsilon: Float[Array, ""],
    ) -> Int[Array, "B"]:
        return epsilon_greedy(key, self.q_values(params, obs, task), epsilon)

    def evaluate(self, params: Params, obs: UInt8[Array, "B H W C"], task: Int[Array, "B"]) -> Evaluation:
        q = self.q_values(params, obs, task)
        return Evaluation(jnp.argmax(q, axis=-1), q)

    def loss(self, online_params: Params, target_params: Params, key: PRNGKeyArray, batch: Transitions) -> AgentLoss:
        del key  # nothing here is random
        q_tm1 = self.q_values(online_params, batch.obs_tm1, batch.task)
        q_t = self.q_values(target_params, batch.obs_t, batch.task)
        td = losses.q_learning_td(q_tm1, batch.a_tm1, batch.r_t, batch.discount_t, q_t)
        td_error = jax.lax.stop_gradient(td)
        return AgentLoss(losses.huber(td), jnp.abs(td_error), losses.take_action(q_tm1, batch.a_tm1), td_error)

    def _network(self) -> QNetwork:
        return QNetwork(self.config, self.spec.num_actions, self.spec.num_tasks)


AGENT = DQN
