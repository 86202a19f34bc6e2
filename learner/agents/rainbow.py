"""Rainbow: thesis 4.2, Hessel et al. 2018.

Four of its six parts live here, each behind a switch of `RainbowConfig`: double, dueling, noisy, distributional. The
other two, prioritized replay and n-step returns, are the replay's. With all of them off it is DQN. Two later parts can
take the place of the categorical distribution: quantile regression (QR-DQN) and Munchausen's target.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from gvz.core.env_config import SIGHT_CLASSES
from gvz.core.errors import ConfigError
from learner import losses
from learner.agents.base import AgentLoss, Evaluation, NetworkAgent, Params, allowed_values, epsilon_greedy
from learner.agents.configs.rainbow import RainbowConfig
from learner.augment import training_view, with_augmented_frames
from learner.networks import QNetwork, add_noise, draw_noise, fold_noise, initial_logits, is_folded
from learner.observation import Observation
from learner.replay import Transitions


@dataclass(frozen=True, slots=True)
class Rainbow(NetworkAgent):
    """The network's outputs are logits of return distributions, or their quantiles, or Q values (N = 1).

    Raises ConfigError: v_min not below v_max, or initial_value not between them.
    """

    config: RainbowConfig

    def __post_init__(self) -> None:
        v_min, v_max = self._value_range()
        if not v_min < v_max:
            raise ConfigError(f"agent.v_min, v_max: got {v_min}, {v_max}, want v_min < v_max")
        if self.config.has_atoms and not v_min < self.config.initial_value < v_max:
            raise ConfigError(
                f"agent.initial_value: got {self.config.initial_value}, want more than v_min {v_min} and less than "
                f"v_max {v_max}: it is the mean of the first distribution on the atoms between them"
            )

    @property
    def atoms(self) -> Float[Array, " N"]:
        """The returns that a distribution's masses stand for."""
        return losses.support(*self._value_range(), self.config.num_atoms)

    def network(self) -> QNetwork:
        config = self.config
        first = (config.initial_value,) * max(1, config.num_quantiles)
        if config.has_atoms:
            first = initial_logits(*self._value_range(), config.num_atoms, config.initial_value)
        return QNetwork(
            config,
            self.spec.num_actions,
            self.spec.num_tasks,
            first_outputs=first,
            dueling=config.dueling,
            noisy_sigma=None if config.noisy == "off" else config.noisy_sigma,
            num_sights=self.spec.num_sights,
        )

    def q_values(self, logits: Float[Array, "B A N"]) -> Float[Array, "B A"]:
        if self.config.has_atoms:
            return losses.expectation(jax.nn.softmax(logits), self.atoms)
        return logits.mean(axis=-1) if self.config.distributional else logits[:, :, 0]

    def act(
        self, params: Params, key: PRNGKeyArray, obs: Observation, epsilon: Float[Array, ""]
    ) -> tuple[Int[Array, " B"], Float[Array, "B E"]]:
        """Greedy in a freshly drawn noisy network, each game with noise of its own if factorized.

        With parameters that `fold` made, greedy in their network.
        """
        key_noise, key = (key, key) if self.config.noisy == "off" else jax.random.split(key)
        q = self.q_values(self.exploring_logits(params, key_noise, obs))
        action = epsilon_greedy(key, q, epsilon, obs.mask)
        return action, jnp.zeros((action.shape[0], 0))

    def exploring_logits(self, params: Params, key: PRNGKeyArray, obs: Observation) -> Float[Array, "B A N"]:
        """The network's answer with noise that is drawn by `key`, unless there is none or it was folded in."""
        if is_folded(params):
            return jnp.asarray(self.network().clone(noisy_sigma=None).apply(params, obs))
        if self.config.noisy == "factorized":
            return self.outputs(params, obs, draw_noise(params, key, obs.task.shape[0]))
        return self.outputs(add_noise(params, key, "independent"), obs)

    @property
    def fold_period_steps(self) -> int:
        steps = self.config.noisy_period_steps
        return steps if self.config.noisy != "off" and steps > 1 else 0

    def fold(self, params: Params, key: PRNGKeyArray) -> Params:
        """Moves the means by one draw of noise: the draw of `act` with this key, were it for a single game."""
        key_noise, _ = jax.random.split(key)
        return fold_noise(params, key_noise, self.config.noisy)

    def evaluate(self, params: Params, obs: Observation) -> Evaluation:
        logits = self.outputs(params, obs)
        q = self.q_values(logits)
        action = jnp.argmax(allowed_values(q, obs.mask), axis=-1)
        if not self.config.has_atoms:
            return Evaluation(action, q)
        return Evaluation(action, q, jax.nn.softmax(logits), self.atoms)

    def loss(self, online_params: Params, target_params: Params, key: PRNGKeyArray, batch: Transitions) -> AgentLoss:
        """Three noise samples a batch: for the online network, for the target, for the choice of the next action.

        Source: Fortunato et al. 2018, section 3.1, the loss of NoisyNet-Dueling (epsilon, epsilon' and epsilon'').
        """
        config = self.config
        key_online, key_target, key_selector = jax.random.split(key, 3)
        online = add_noise(online_params, key_online, self.config.noisy)
        target = add_noise(target_params, key_target, self.config.noisy)
        key_view = jax.random.fold_in(key, 3)
        logits_tm1, sight_logits = self.outputs_and_sight(online, training_view(config, key_view, batch.obs_tm1))
        logits_t = self.outputs(target, batch.obs_t)
        q_tm1, q_t = self.q_values(logits_tm1), self.q_values(logits_t)
        q_t_selector = q_t
        if config.double and not config.munchausen:
            selector = add_noise(online_params, key_selector, self.config.noisy)
            q_t_selector = self.q_values(self.outputs(selector, batch.obs_t))
        q_t_selector = allowed_values(q_t_selector, batch.obs_t.mask)
        td = losses.q_learning_td(q_tm1, batch.a_tm1, batch.r_t, batch.discount_t, q_t, q_t_selector)
        if config.has_atoms:
            loss, priority = losses.categorical_q_learning(
                logits_tm1, batch.a_tm1, batch.r_t, batch.discount_t, logits_t, self.atoms, q_t_selector
            )
        elif config.munchausen or config.distributional:
            targets = self._targets(batch, target, logits_t, q_t_selector)
            td = targets.mean(axis=1) - losses.take_action(q_tm1, batch.a_tm1)
            loss, priority = losses.huber(td), jnp.abs(td)
            if config.distributional:
                z_tm1 = losses.take_action(logits_tm1, batch.a_tm1)
                loss = losses.quantile_huber(z_tm1, losses.quantile_midpoints(config.num_quantiles), targets)
        else:
            loss, priority = losses.huber(td), jnp.abs(td)
        if config.sight_augmentations:
            key_sight = jax.random.fold_in(key, 4)
            view = with_augmented_frames(config, config.sight_augmentations, key_sight, batch.obs_tm1)
            _, sight_logits = self.outputs_and_sight(online, view)
        if sight_logits is not None and batch.sight_tm1 is not None:
            loss += config.sight_weight * losses.sight(sight_logits, batch.sight_tm1, len(SIGHT_CLASSES))
        priority, td_error = jax.lax.stop_gradient((priority, td))
        return AgentLoss(loss, priority, losses.take_action(q_tm1, batch.a_tm1), td_error)

    def _targets(
        self, batch: Transitions, target: Params, logits_t: Float[Array, "B A N"], q_t_selector: Float[Array, "B A"]
    ) -> Float[Array, "B N"]:
        """What quantiles (or, N = 1, the value) of the action taken are drawn to; constant."""
        config = self.config
        if not config.munchausen:
            return losses.quantile_target(batch.r_t, batch.discount_t, logits_t, q_t_selector)
        q_tm1, q_t = self.q_values(self.outputs(target, batch.obs_tm1)), self.q_values(logits_t)
        return losses.munchausen_target(
            allowed_values(q_tm1, batch.obs_tm1.mask),
            batch.a_tm1,
            batch.r_t,
            batch.discount_t,
            logits_t,
            allowed_values(q_t, batch.obs_t.mask),
            config.munchausen_alpha,
            config.munchausen_temperature,
        )

    def _value_range(self) -> tuple[float, float]:
        return self.config.value_range(self.spec.v_min, self.spec.v_max)


AGENT = Rainbow
