"""PPO: Schulman et al. 2017, "Proximal Policy Optimization Algorithms".

One network with two outputs, the policy's logits and the value (the paper's section 5 for shared parameters).
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from learner import losses, returns
from learner.agents.base import Evaluation, NetworkAgent, Params, RolloutSteps, SampleLosses, Samples, Targets
from learner.agents.configs.ppo import PPOConfig
from learner.networks import QNetwork
from learner.observation import Observation

FORBIDDEN = -1e9
"""logit of a masked action: its probability is 0 in float32, and its gradient is finite, which -inf's is not"""


@dataclass(frozen=True, slots=True)
class PPO(NetworkAgent):
    """Records with every action its value and its log-probability, so that the ratio of the loss is to who acted."""

    config: PPOConfig

    def network(self) -> QNetwork:
        """The last of its outputs is the value; all begin at 0, so the first policy is uniform."""
        return QNetwork(self.config, self.spec.num_actions + 1, self.spec.num_tasks, first_outputs=(0.0,))

    def policy(self, params: Params, obs: Observation) -> tuple[Float[Array, "B A"], Float[Array, " B"]]:
        """(logits, value)."""
        outputs = self.outputs(params, obs)[:, :, 0]
        logits, value = outputs[:, :-1], outputs[:, -1]
        return logits if obs.mask is None else jnp.where(obs.mask, logits, FORBIDDEN), value

    def act(
        self, params: Params, key: PRNGKeyArray, obs: Observation, epsilon: Float[Array, ""]
    ) -> tuple[Int[Array, " B"], Float[Array, "B E"]]:
        """Samples the policy; with probability epsilon uniformly instead, which is part of the recorded probability."""
        logits, value = self.policy(params, obs)
        allowed = jnp.ones(logits.shape, bool) if obs.mask is None else obs.mask
        uniform = allowed / allowed.sum(axis=1, keepdims=True)
        log_p = jnp.log((1 - epsilon) * jax.nn.softmax(logits) + epsilon * uniform)
        action = jax.random.categorical(key, log_p).astype(jnp.int32)
        return action, jnp.stack([value, losses.take_action(log_p, action)], axis=1)

    def evaluate(self, params: Params, obs: Observation) -> Evaluation:
        """The likeliest action, the policy and the value; PPO has no action values."""
        logits, value = self.policy(params, obs)
        return Evaluation(jnp.argmax(logits, axis=-1), None, policy=jax.nn.softmax(logits), value=value)

    def targets(self, steps: RolloutSteps) -> Targets:
        config = self.config
        v_tm1, v_t = steps.extras_tm1[:, :, 0], steps.extras_t[:, :, 0]
        advantages, targets = returns.generalized_advantages(
            steps.r_t, v_tm1, v_t, steps.terminated, steps.truncated, config.discount, config.td_lambda
        )
        return Targets(targets, advantages)

    def losses(self, params: Params, batch: Samples) -> SampleLosses:
        """Eq. 9 of the paper with its sign turned round."""
        config, weight = self.config, batch.weight
        logits, v = self.policy(params, batch.obs)
        log_p = losses.take_action(jax.nn.log_softmax(logits), batch.a_tm1)
        v_old, log_p_old = batch.extras[:, 0], batch.extras[:, 1]
        advantages = batch.targets.advantages
        if config.normalize_advantages:
            advantages = _normalized(advantages, weight)
        policy_loss = returns.clipped_surrogate_loss(log_p, log_p_old, advantages, config.clip)
        value_loss = returns.value_loss(v, batch.targets.returns, v_old, config.value_clip)
        entropy = returns.entropy(logits)
        log_ratio = log_p - log_p_old
        ratio = jnp.exp(log_ratio)
        clipped: Bool[Array, " B"] = jnp.abs(ratio - 1) > config.clip
        return SampleLosses(
            policy_loss + config.value_weight * value_loss - config.entropy_weight * entropy,
            {
                "policy_loss": policy_loss,
                "value_loss": value_loss,
                "entropy": entropy,
                "value_mean": v,
                "td_error": jnp.abs(batch.targets.returns - v),
                "kl": ratio - 1 - log_ratio,  # Schulman 2020, joschu.net/blog/kl-approx.html, k3
                "clipped_share": clipped.astype(jnp.float32),
            },
        )


def _normalized(x: Float[Array, " B"], weight: Float[Array, " B"]) -> Float[Array, " B"]:
    """Mean 0 and deviation 1 over the steps of weight 1. A single step has no deviation: its number stays as it is."""
    total = weight.sum()
    at_least_one = jnp.maximum(total, 1.0)
    centred = x - (weight * x).sum() / at_least_one
    normalized = centred / (jnp.sqrt((weight * centred**2).sum() / at_least_one) + 1e-8)
    return jnp.where(total > 1.0, normalized, x)


AGENT = PPO
