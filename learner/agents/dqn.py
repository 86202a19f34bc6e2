"""DQN: thesis 4.1, Algorithm 1.

The plain agent, written out: a target network, the Huber loss, epsilon-greedy exploration. Linear Q outputs (thesis
4.1.5 speaks of a softmax over Q values, which cannot represent returns). The n-step return is the replay's.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from learner import losses
from learner.agents.base import AgentLoss, Params, QAgent, allowed_values, epsilon_greedy
from learner.agents.configs.dqn import DQNConfig
from learner.augment import training_view
from learner.networks import QNetwork
from learner.observation import Observation
from learner.replay import Transitions


@dataclass(frozen=True, slots=True)
class DQN(QAgent):
    """Deep Q-learning with experience replay and a fixed target network."""

    config: DQNConfig

    def network(self) -> QNetwork:
        first = (self.config.initial_value,)
        return QNetwork(self.config, self.spec.num_actions, self.spec.num_tasks, first_outputs=first)

    def act(
        self, params: Params, key: PRNGKeyArray, obs: Observation, epsilon: Float[Array, ""]
    ) -> tuple[Int[Array, " B"], Float[Array, "B E"]]:
        action = epsilon_greedy(key, self.q_values(params, obs), epsilon, obs.mask)
        return action, jnp.zeros((action.shape[0], 0))

    def loss(self, online_params: Params, target_params: Params, key: PRNGKeyArray, batch: Transitions) -> AgentLoss:
        q_tm1 = self.q_values(online_params, training_view(self.config, key, batch.obs_tm1))
        q_t = self.q_values(target_params, batch.obs_t)
        selector = allowed_values(q_t, batch.obs_t.mask)
        td = losses.q_learning_td(q_tm1, batch.a_tm1, batch.r_t, batch.discount_t, q_t, selector)
        td_error = jax.lax.stop_gradient(td)
        return AgentLoss(losses.huber(td), jnp.abs(td_error), losses.take_action(q_tm1, batch.a_tm1), td_error)


AGENT = DQN
