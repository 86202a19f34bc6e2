"""One jitted call: a rollout -> returns -> epochs of minibatches -> parameters. The counterpart of `train_step`."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, PRNGKeyArray

from learner import store
from learner.agents.base import OnPolicyAgent, Params, SampleLosses, Samples, Targets
from learner.config import OnPolicyConfig
from learner.rollouts import RolloutSpec, steps_of
from learner.store import Store
from learner.train_step import LearnerState, averaged, gradient_step, no_non_finite, no_sums, of_each_task


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True, slots=True)
class MetricSums:
    """What has been added up since the last read, as in `train_step.MetricSums`."""

    num_updates: Int[Array, ""]
    loss: Float[Array, ""]
    grad_norm: Float[Array, ""]
    grad_norm_max: Float[Array, ""]
    agent: dict[str, Float[Array, ""]]
    """of `SampleLosses.metrics`: means of minibatches, and largest numbers"""
    task_samples: Float[Array, " Z"]
    task_loss: Float[Array, " Z"]


Update = Callable[[LearnerState, Store, Int[Array, ""]], LearnerState]


def init(agent: OnPolicyAgent, spec: RolloutSpec, config: OnPolicyConfig, key: PRNGKeyArray) -> LearnerState:
    """The state before the first update."""
    key_params, key_state = jax.random.split(key)
    params = agent.init(key_params)
    B = batch_size(spec, config)
    batch = Samples(
        obs=agent.spec.zeros(B),
        a_tm1=jnp.zeros(B, jnp.int32),
        extras=jnp.zeros((B, spec.num_extras)),
        targets=Targets(jnp.zeros(B), jnp.zeros(B)),
        weight=jnp.zeros(B),
    )
    zero, per_task = jnp.zeros((), jnp.float32), jnp.zeros(spec.num_tasks, jnp.float32)
    metrics = MetricSums(
        num_updates=jnp.int32(0),
        loss=zero,
        grad_norm=zero,
        grad_norm_max=zero,
        agent=dict.fromkeys(jax.eval_shape(agent.losses, params, batch).metrics, zero),
        task_samples=per_task,
        task_loss=per_task,
    )
    state = LearnerState(
        params=params,
        target_params=None,
        average_params=None if config.average_ema is None else params,
        opt_state=optimizer(config).init(params),
        key=key_state,
        num_updates=jnp.int32(0),
        metrics=no_sums(metrics),
        non_finite=no_non_finite(batch, B),
    )
    return jax.tree.map(jnp.copy, state)  # donation refuses a buffer that stands in two places


def batch_size(spec: RolloutSpec, config: OnPolicyConfig) -> int:
    """Steps of a minibatch."""
    return spec.num_lanes * spec.num_steps // config.num_minibatches


def make_update(agent: OnPolicyAgent, spec: RolloutSpec, config: OnPolicyConfig) -> Update:
    """Builds `update(state, windows, num_updates) -> state`; the state is donated.

    Args:
        agent: whose returns and loss.
        spec: of the rollout.
        config: epochs, minibatches, optimizer.

    Returns:
        The jitted function, which compiles once. Each epoch goes through the rollout's steps in an order of its own;
        `num_updates` is how many of its minibatches are learnt from, at most `config.updates_per_rollout`.
    """

    def update(state: LearnerState, windows: Store, num_updates: Int[Array, ""]) -> LearnerState:
        steps, slots = steps_of(spec, windows)
        targets, slots = jax.tree.map(jnp.ravel, agent.targets(steps)), slots.ravel()
        key, key_order = jax.random.split(state.key)
        keys = jax.random.split(key_order, config.num_epochs)
        orders = jax.vmap(lambda key: jax.random.permutation(key, len(slots)))(keys)
        orders = orders.reshape(config.updates_per_rollout, -1)

        def one(i: Array, state: LearnerState) -> LearnerState:
            chosen = orders[i]
            at = slots[chosen]
            batch = Samples(
                obs=store.observations(spec, windows, at),
                a_tm1=windows.action[at],
                extras=windows.extras[at],
                targets=jax.tree.map(lambda x: x[chosen], targets),
                weight=1.0 - windows.last[at],
            )

            def mean_loss(params: Params) -> tuple[Float[Array, ""], SampleLosses]:
                losses = agent.losses(params, batch)
                return _mean(losses.loss, batch.weight), losses

            state, loss, losses, grad_norm = gradient_step(
                state, optimizer(config), mean_loss, batch, batch.weight, hold_gradient=False
            )
            return replace(
                state,
                average_params=averaged(state.average_params, state.params, config.average_ema),
                metrics=_add_metrics(state.metrics, loss, losses, grad_norm, batch),
            )

        return jax.lax.fori_loop(0, num_updates, one, replace(state, key=key))

    return jax.jit(update, donate_argnums=0)


def optimizer(config: OnPolicyConfig) -> optax.GradientTransformation:
    """(Rectified) Adam, after clipping by the global norm if configured."""
    rate = config.learning_rate
    if config.learning_rate_decay:
        rate = optax.linear_schedule(rate, 0.0, config.total_updates)
    adam = (optax.radam if config.optimizer == "radam" else optax.adam)(rate, eps=config.adam_eps)
    if config.max_grad_norm is None:
        return adam
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), adam)


def _mean(values: Float[Array, " B"], weight: Float[Array, " B"]) -> Float[Array, ""]:
    return (weight * values).sum() / jnp.maximum(weight.sum(), 1.0)


def _add_metrics(
    sums: MetricSums, loss: Float[Array, ""], losses: SampleLosses, grad_norm: Float[Array, ""], batch: Samples
) -> MetricSums:
    weight = batch.weight

    def added(name: str, values: Array) -> Array:
        if name.endswith("_max"):
            return jnp.maximum(sums.agent[name], jnp.where(weight > 0, values, -jnp.inf).max())
        return sums.agent[name] + _mean(values, weight)

    def per_task(sums: Float[Array, " Z"], values: Float[Array, " B"]) -> Float[Array, " Z"]:
        return sums + of_each_task(values, batch.obs.task, len(sums))

    return MetricSums(
        num_updates=sums.num_updates + 1,
        loss=sums.loss + loss,
        grad_norm=sums.grad_norm + grad_norm,
        grad_norm_max=jnp.maximum(sums.grad_norm_max, grad_norm),
        agent={name: added(name, values) for name, values in losses.metrics.items()},
        task_samples=per_task(sums.task_samples, weight),
        task_loss=per_task(sums.task_loss, weight * losses.loss),
    )
