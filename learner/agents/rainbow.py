"""Rainbow: thesis 4.2, Hessel et al. 2018.

Four of its six parts live here, each behind a switch of `AgentConfig`: double, dueling, noisy, distributional. The
other two, prioritized replay and n-step returns, are the replay's. With all of them off it is DQN.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8

from gvz.core.errors import ConfigError
from learner import losses
from learner.agents.base import AgentLoss, AgentSpec, Evaluation, Params, epsilon_greedy
from learner.config import AgentConfig
from learner.networks import QNetwork, add_noise, check_fits, draw_noise
from learner.replay import Transitions


@dataclass(frozen=True, slots=True)
class Rainbow:
    """Raises ConfigError: v_min not below v_max, initial_value not between them, or frames too small to convolve."""

    config: AgentConfig
    spec: AgentSpec

    def __post_init__(self) -> None:
        v_min, v_max = self._value_range()
        if not v_min < v_max:
            raise ConfigError(f"agent.v_min, v_max: got {v_min}, {v_max}, want v_min < v_max")
        if self.config.distributional and not v_min < self.config.initial_value < v_max:
            raise ConfigError(
                f"agent.initial_value: got {self.config.initial_value}, want more than v_min {v_min} and less than "
                f"v_max {v_max}: it is the mean of the first distribution on the atoms between them"
            )
        check_fits(self.config, *self.spec.obs_shape[:2])

    @property
    def atoms(self) -> Float[Array, "N"]:
        """The returns that a distribution's masses stand for."""
        return losses.support(*self._value_range(), self.config.num_atoms)

    def logits(
        self,
        params: Params,
        obs: UInt8[Array, "B H W C"],
        task: Int[Array, "B"],
        noise: dict[str, Float[Array, "B _"]] | None = None,
    ) -> Float[Array, "B A N"]:
        """Logits of the return distributions; Q values (N = 1) if not distributional. `noise` is each row's own."""
        return jnp.asarray(self._network().apply(params, obs, task, noise))

    def q_values(self, logits: Float[Array, "B A N"]) -> Float[Array, "B A"]:
        if not self.config.distributional:
            return logits[:, :, 0]
        return losses.expectation(jax.nn.softmax(logits), self.atoms)

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
        """Greedy in a freshly drawn noisy network, each game with noise of its own if factorized."""
        if self.config.noisy == "off":
            return epsilon_greedy(key, self.q_values(self.logits(params, obs, task)), epsilon)
        key_noise, key_epsilon = jax.random.split(key)
        if self.config.noisy == "factorized":
            logits = self.logits(params, obs, task, draw_noise(params, key_noise, obs.shape[0]))
        else:
            logits = self.logits(add_noise(params, key_noise, "independent"), obs, task)
        return epsilon_greedy(key_epsilon, self.q_values(logits), epsilon)

    def evaluate(self, params: Params, obs: UInt8[Array, "B H W C"], task: Int[Array, "B"]) -> Evaluation:
        logits = self.logits(params, obs, task)
        q = self.q_values(logits)
        if not self.config.distributional:
            return Evaluation(jnp.argmax(q, axis=-1), q)
        return Evaluation(jnp.argmax(q, axis=-1), q, jax.nn.softmax(logits), self.atoms)

    def loss(self, online_params: Params, target_params: Params, key: PRNGKeyArray, batch: Transitions) -> AgentLoss:
        """Three noise samples a batch: for the online network, for the target, for the choice of the next action.

        Source: Fortunato et al. 2018, section 3.1, the loss of NoisyNet-Dueling (epsilon, epsilon' and epsilon'').
        """
        key_online, key_target, key_selector = jax.random.split(key, 3)
        online = add_noise(online_params, key_online, self.config.noisy)
        target = add_noise(target_params, key_target, self.config.noisy)
        logits_tm1 = self.logits(online, batch.obs_tm1, batch.task)
        logits_t = self.logits(target, batch.obs_t, batch.task)
        q_t_selector = None
        if self.config.double:
            selector = add_noise(online_params, key_selector, self.config.noisy)
            q_t_selector = self.q_values(self.logits(selector, batch.obs_t, batch.task))
        q_tm1, q_t = self.q_values(logits_tm1), self.q_values(logits_t)
        td = losses.q_learning_td(q_tm1, batch.a_tm1, batch.r_t, batch.discount_t, q_t, q_t_selector)
        if self.config.distributional:
            loss, priority = losses.categorical_q_learning(
                logits_tm1, batch.a_tm1, batch.r_t, batch.discount_t, logits_t, self.atoms, q_t_selector
            )
        else:
            loss, priority = losses.huber(td), jnp.abs(td)
        priority, td_error = jax.lax.stop_gradient((priority, td))
        return AgentLoss(loss, priority, losses.take_action(q_tm1, batch.a_tm1), td_error)

    def _network(self) -> QNetwork:
        return QNetwork(self.config, self.spec.num_actions, self.spec.num_tasks, self._value_range())

    def _value_range(self) -> tuple[float, float]:
        return self.config.value_range(self.spec.v_min, self.spec.v_max)


AGENT = Rainbow
