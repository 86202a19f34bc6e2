"""One jitted, donated call: sample -> loss -> update -> priorities.

Everything the loop needs lives on the device in two pytrees, `LearnerState` and the replay's state; nothing comes to
the host between log periods. `read_metrics` is the only reader.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from gvz.core.errors import NonFiniteError
from learner import replay
from learner.agents.base import Agent, AgentLoss, Params
from learner.config import LearnerConfig, ReplayConfig
from learner.replay import ReplaySpec, ReplayState, SampleInfo, Transitions


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True, slots=True)
class MetricSums:
    """What has been added up since the last read, one number or one per task (`[num_tasks]`)."""

    num_updates: Int[Array, ""]
    loss: Float[Array, ""]
    priority: Float[Array, ""]
    td_error: Float[Array, ""]
    """of magnitudes, as `task_td_error`"""
    q_mean: Float[Array, ""]
    q_max: Float[Array, ""]
    """the largest seen, not a sum"""
    grad_norm: Float[Array, ""]
    grad_norm_max: Float[Array, ""]
    """the largest seen, not a sum"""
    importance_weight: Float[Array, ""]
    task_samples: Float[Array, "Z"]
    task_loss: Float[Array, "Z"]
    task_priority: Float[Array, "Z"]
    task_td_error: Float[Array, "Z"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True, slots=True)
class NonFinite:
    """The first batch whose loss or gradient was not finite, kept for the host to save."""

    num_skipped: Int[Array, ""]
    """updates skipped so far for this reason; 0 while all is well"""
    update: Int[Array, ""]
    """number of the first such update"""
    batch: Transitions
    loss: Float[Array, "B"]
    weights: Float[Array, "B"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True, slots=True)
class LearnerState:
    """All that the learner remembers between updates, beside the replay."""

    params: Params
    target_params: Params
    opt_state: optax.OptState
    key: PRNGKeyArray
    num_updates: Int[Array, ""]
    metrics: MetricSums
    non_finite: NonFinite


T = TypeVar("T")
TrainStep = Callable[[LearnerState, ReplayState, Float[Array, "Z"]], tuple[LearnerState, ReplayState]]


def init(agent: Agent, replay_spec: ReplaySpec, learner_config: LearnerConfig, key: PRNGKeyArray) -> LearnerState:
    """The state before the first update: target equal to online parameters."""
    key_params, key_state = jax.random.split(key)
    params = agent.init(key_params)
    batch_size = learner_config.batch_size

    def sample(key: PRNGKeyArray) -> Transitions:
        return replay.sample(replay_spec, replay.init(replay_spec), key, batch_size, 1.0)[0]

    batch = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), jax.eval_shape(sample, key))
    state = LearnerState(
        params=params,
        target_params=params,
        opt_state=_optimizer(learner_config).init(params),
        key=key_state,
        num_updates=jnp.int32(0),
        metrics=_no_metrics(replay_spec.num_tasks),
        non_finite=NonFinite(
            num_skipped=jnp.int32(0),
            update=jnp.int32(-1),
            batch=batch,
            loss=jnp.zeros((batch_size,), jnp.float32),
            weights=jnp.zeros((batch_size,), jnp.float32),
        ),
    )
    return jax.tree.map(jnp.copy, state)  # donation refuses a buffer that stands in two places


def make_train_step(
    agent: Agent,
    replay_spec: ReplaySpec,
    learner_config: LearnerConfig,
    replay_config: ReplayConfig,
    num_updates: int,
) -> TrainStep:
    """Builds `train_step(state, replay_state, task_weights) -> (state, replay_state)`; both states are donated.

    Args:
        agent: whose loss.
        replay_spec: the replay's sizes.
        learner_config: batch size, optimizer, periods.
        replay_config: importance-sampling exponents.
        num_updates: gradient steps of one call, in one scan.

    Returns:
        The jitted function. `task_weights` f32[num_tasks] scale the samples' losses (all 1: no effect). It compiles
        once, at its first call.
    """

    def train_step(
        state: LearnerState, replay_state: ReplayState, task_weights: Float[Array, "Z"]
    ) -> tuple[LearnerState, ReplayState]:
        def update(carry: tuple[LearnerState, ReplayState], _: None):
            return _update(*carry, task_weights, agent, replay_spec, learner_config, replay_config), None

        return jax.lax.scan(update, (state, replay_state), length=num_updates)[0]

    return jax.jit(train_step, donate_argnums=(0, 1))


def default_num_updates(learner_config: LearnerConfig) -> int:
    """Gradient steps of one call: as configured, else 1 on a CPU and 8 elsewhere."""
    if learner_config.num_updates_per_call is not None:
        return learner_config.num_updates_per_call
    return 1 if jax.default_backend() == "cpu" else 8


def read_metrics(
    state: LearnerState, task_names: Sequence[str], diagnostics_dir: Path
) -> tuple[dict[str, float], LearnerState]:
    """Brings the means since the last read to the host and starts new sums. Waits for the device.

    Args:
        state: the learner's state.
        task_names: a name for each task index, for the per-task entries.
        diagnostics_dir: existing directory where the batch of a non-finite update is saved.

    Returns:
        (metrics, the state with empty sums). A task without samples has no loss, priority and TD error.

    Raises:
        NonFiniteError: a loss or gradient was NaN or infinite since the last read; the batch is saved.
    """
    check_finite(state, diagnostics_dir)
    sums = jax.device_get(state.metrics)
    n = max(int(sums.num_updates), 1)
    metrics = {
        "loss": float(sums.loss) / n,
        "priority": float(sums.priority) / n,
        "td_error": float(sums.td_error) / n,
        "q_mean": float(sums.q_mean) / n,
        "grad_norm": float(sums.grad_norm) / n,
        "importance_weight": float(sums.importance_weight) / n,
    }
    if sums.num_updates > 0:
        metrics |= {"q_max": float(sums.q_max), "grad_norm_max": float(sums.grad_norm_max)}
    total = max(float(sums.task_samples.sum()), 1.0)
    for i, name in enumerate(task_names):
        samples = float(sums.task_samples[i])
        metrics[f"sample_share/{name}"] = samples / total
        if samples > 0:
            metrics[f"loss/{name}"] = float(sums.task_loss[i]) / samples
            metrics[f"priority/{name}"] = float(sums.task_priority[i]) / samples
            metrics[f"td_error/{name}"] = float(sums.task_td_error[i]) / samples
    return metrics, replace(state, metrics=_no_metrics(len(task_names)))


def check_finite(state: LearnerState, diagnostics_dir: Path) -> None:
    """Raises NonFiniteError as `read_metrics` does. Waits for the device."""
    if jax.device_get(state.non_finite.num_skipped) > 0:
        raise _save_non_finite(jax.device_get(state.non_finite), diagnostics_dir)


def _update(
    state: LearnerState,
    replay_state: ReplayState,
    task_weights: Float[Array, "Z"],
    agent: Agent,
    replay_spec: ReplaySpec,
    learner_config: LearnerConfig,
    replay_config: ReplayConfig,
) -> tuple[LearnerState, ReplayState]:
    """One gradient step (thesis Algorithm 1 with prioritized replay)."""
    key, key_sample, key_loss = jax.random.split(state.key, 3)
    progress = jnp.minimum(state.num_updates / learner_config.total_updates, 1.0)
    start, end = replay_config.importance_sampling_exponent, replay_config.importance_sampling_exponent_end
    batch, info = replay.sample(
        replay_spec, replay_state, key_sample, learner_config.batch_size, start + progress * (end - start)
    )
    weights = info.weights * task_weights[batch.task]

    def weighted_loss(params: Params) -> tuple[Float[Array, ""], AgentLoss]:
        losses = agent.loss(params, state.target_params, key_loss, batch)
        return jnp.mean(weights * losses.loss), losses

    (loss, losses), grads = jax.value_and_grad(weighted_loss, has_aux=True)(state.params)
    grad_norm = jnp.sqrt(sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(grads)))
    finite = jnp.isfinite(loss) & jnp.isfinite(grad_norm)

    def apply_gradient(trained: tuple[Params, optax.OptState]) -> tuple[Params, optax.OptState]:
        # The barrier keeps XLA from computing multiples of the gradient ahead of the loop that `_when` is.
        (params, opt_state), here = jax.lax.optimization_barrier((trained, grads))
        deltas, opt_state = _optimizer(learner_config).update(here, opt_state, params)
        return optax.apply_updates(params, deltas), opt_state

    params, opt_state = _when(finite, apply_gradient, (state.params, state.opt_state))
    num_updates = state.num_updates + 1
    target_params = _when(
        num_updates % learner_config.target_period_updates == 0, lambda _: params, state.target_params
    )
    replay_state = replay.update_priorities(
        replay_spec, replay_state, info.slots, jnp.where(jnp.isfinite(losses.priority), losses.priority, 0.0)
    )
    first_bad = NonFinite(num_skipped=jnp.int32(0), update=num_updates, batch=batch, loss=losses.loss, weights=weights)
    non_finite = _when(~finite & (state.non_finite.num_skipped == 0), lambda _: first_bad, state.non_finite)
    state = LearnerState(
        params=params,
        target_params=target_params,
        opt_state=opt_state,
        key=key,
        num_updates=num_updates,
        metrics=_add_metrics(state.metrics, loss, losses, grad_norm, info, batch.task),
        non_finite=replace(non_finite, num_skipped=non_finite.num_skipped + ~finite),
    )
    return state, replay_state


def _when(condition: Bool[Array, ""], f: Callable[[T], T], value: T) -> T:
    """f(value) if the condition holds, else `value`, in place.

    A loop of one or no round: XLA copies what goes through a `lax.cond` or a `where` of a whole tree (60 of 240 ms of
    CPU time an update; 2026-11-21, 2-core AMD EPYC), but updates a loop's carry where it is.
    """
    return jax.lax.fori_loop(0, condition.astype(jnp.int32), lambda _, carry: f(carry), value)


def _optimizer(config: LearnerConfig) -> optax.GradientTransformation:
    """Adam (thesis Table 5.1), after clipping by the global norm if configured."""
    adam = optax.adam(config.learning_rate, eps=config.adam_eps)
    if config.max_grad_norm is None:
        return adam
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), adam)


def _no_metrics(num_tasks: int) -> MetricSums:
    scalar = jnp.zeros((), jnp.float32)
    per_task = jnp.zeros((num_tasks,), jnp.float32)
    sums = MetricSums(
        num_updates=jnp.zeros((), jnp.int32),
        loss=scalar,
        priority=scalar,
        td_error=scalar,
        q_mean=scalar,
        q_max=jnp.full((), -jnp.inf, jnp.float32),
        grad_norm=scalar,
        grad_norm_max=scalar,
        importance_weight=scalar,
        task_samples=per_task,
        task_loss=per_task,
        task_priority=per_task,
        task_td_error=per_task,
    )
    return jax.tree.map(jnp.copy, sums)  # donation refuses a buffer that stands in two places


def _add_metrics(
    sums: MetricSums,
    loss: Float[Array, ""],
    losses: AgentLoss,
    grad_norm: Float[Array, ""],
    info: SampleInfo,
    task: Int[Array, "B"],
) -> MetricSums:
    magnitude = jnp.abs(losses.td_error)
    return MetricSums(
        num_updates=sums.num_updates + 1,
        loss=sums.loss + loss,
        priority=sums.priority + losses.priority.mean(),
        td_error=sums.td_error + magnitude.mean(),
        q_mean=sums.q_mean + losses.q_tm1.mean(),
        q_max=jnp.maximum(sums.q_max, losses.q_tm1.max()),
        grad_norm=sums.grad_norm + grad_norm,
        grad_norm_max=jnp.maximum(sums.grad_norm_max, grad_norm),
        importance_weight=sums.importance_weight + info.weights.mean(),
        task_samples=sums.task_samples.at[task].add(1.0),
        task_loss=sums.task_loss.at[task].add(losses.loss),
        task_priority=sums.task_priority.at[task].add(losses.priority),
        task_td_error=sums.task_td_error.at[task].add(magnitude),
    )


def _save_non_finite(record: NonFinite, directory: Path) -> NonFiniteError:
    update = int(record.update)
    file = directory / f"nonfinite_batch_{update}.npz"
    arrays = {f.name: getattr(record.batch, f.name) for f in fields(record.batch)}
    np.savez(file, loss=record.loss, weights=record.weights, **arrays)
    bad = int(np.sum(~np.isfinite(record.loss)))
    return NonFiniteError(
        f"update {update}: {bad} of {record.loss.size} losses are NaN or infinite"
        f"{'' if bad else ', but the gradient is not finite'}; {int(record.num_skipped)} updates were skipped since "
        f"the last read and the parameters are as before them. The batch is saved in {file}; load it with numpy, "
        "look for extreme rewards or weights, and lower learner.learning_rate or set learner.max_grad_norm"
    )
