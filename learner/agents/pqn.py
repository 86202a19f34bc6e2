"""PQN: Gallici et al. 2024, "Simplifying Deep Temporal Difference Learning".

Q-learning on the newest rollout: returns Q(lambda), layer normalization, epsilon-greedy, no replay, no target network.
"""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from learner import losses, returns
from learner.agents.base import (
    Params,
    QAgent,
    RolloutSteps,
    SampleLosses,
    Samples,
    Targets,
    allowed_values,
    epsilon_greedy,
)
from learner.agents.configs.pqn import PQNConfig
from learner.networks import QNetwork
from learner.observation import Observation


@dataclass(frozen=True, slots=True)
class PQN(QAgent):
    """Records with every action the largest action value there, which is what its returns bootstrap from.

    As in the published code, these values are those of the parameters that acted. Differs: there, all steps of a
    rollout have the same parameters; here actors go on while the learner learns, so that some steps have older ones.
    """

    config: PQNConfig

    def network(self) -> QNetwork:
        config, spec = self.config, self.spec
        first = (config.initial_value,)
        return QNetwork(config, spec.num_actions, spec.num_tasks, first_outputs=first, layer_norm=config.layer_norm)

    def act(
        self, params: Params, key: PRNGKeyArray, obs: Observation, epsilon: Float[Array, ""]
    ) -> tuple[Int[Array, " B"], Float[Array, "B E"]]:
        q = self.q_values(params, obs)
        action = epsilon_greedy(key, q, epsilon, obs.mask)
        return action, allowed_values(q, obs.mask).max(axis=1, keepdims=True)

    def targets(self, steps: RolloutSteps) -> Targets:
        v_t = steps.extras_t[:, :, 0]
        targets = returns.lambda_returns(
            steps.r_t, v_t, steps.terminated, steps.truncated, self.config.discount, self.config.td_lambda
        )
        return Targets(targets, targets - steps.extras_tm1[:, :, 0])

    def losses(self, params: Params, batch: Samples) -> SampleLosses:
        """Half the squared error of the action taken (the paper's Algorithm 1)."""
        q_tm1 = losses.take_action(self.q_values(params, batch.obs), batch.a_tm1)
        td = batch.targets.returns - q_tm1
        return SampleLosses(
            returns.value_loss(q_tm1, batch.targets.returns),
            {"td_error": jnp.abs(td), "q_mean": q_tm1, "q_max": q_tm1},
        )


AGENT = PQN
