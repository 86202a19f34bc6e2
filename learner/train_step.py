"""One jitted, donated call: sample -> loss -> update -> priorities.

Everything the loop needs lives on the device in two pytrees, `LearnerState` and the replay's state; nothing comes to
the host between log periods. `read_metrics` is the only reader. `learner.rollout_step` makes its gradient steps, and
reads its metrics, by the functions here.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from gvz.core.errors import NonFiniteError
from learner import replay
from learner.across import ALONE, Across
from learner.agents.base import AgentLoss, OffPolicyAgent, Params, SampleLosses
from learner.config import LearnerConfig, ReplayConfig
from learner.replay import ReplaySpec, ReplayState, SampleInfo, Transitions


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True, slots=True)
class MetricSums:
    """What has been added up since the last read: of updates, or in task_... of the samples of each task.

    A name that ends in _max stands for the largest number seen.
    """

    num_updates: Int[Array, ""]
    loss: Float[Array, ""]
    priority: Float[Array, ""]
    td_error: Float[Array, ""]
    """of magnitudes, as `task_td_error`"""
    q_mean: Float[Array, ""]
    q_max: Float[Array, ""]
    grad_norm: Float[Array, ""]
    grad_norm_max: Float[Array, ""]
    importance_weight: Float[Array, ""]
    task_samples: Float[Array, " Z"]
    task_loss: Float[Array, " Z"]
    task_priority: Float[Array, " Z"]
    task_td_error: Float[Array, " Z"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True, slots=True)
class NonFinite:
    """The first batch whose loss or gradient was not finite, kept for the host to save."""

    num_skipped: Int[Array, ""]
    """updates skipped so far for this reason; 0 while all is well"""
    update: Int[Array, ""]
    """number of the first such update"""
    batch: Any
    """a pytree of arrays"""
    loss: Float[Array, " B"]
    weights: Float[Array, " B"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True, slots=True)
class LearnerState:
    """All that a learner remembers between updates, beside its records."""

    params: Params
    target_params: Params
    """None if the agent learns from rollouts"""
    average_params: Params | None
    """moving average of the parameters, if one is kept"""
    opt_state: optax.OptState
    key: PRNGKeyArray
    num_updates: Int[Array, ""]
    metrics: Any
    """`MetricSums`, or that of `learner.rollout_step`"""
    non_finite: NonFinite


T = TypeVar("T")
LossesT = TypeVar("LossesT", AgentLoss, SampleLosses)
TrainStep = Callable[[LearnerState, ReplayState, Float[Array, " Z"]], tuple[LearnerState, ReplayState]]


def init(
    agent: OffPolicyAgent, replay_spec: ReplaySpec, learner_config: LearnerConfig, key: PRNGKeyArray
) -> LearnerState:
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
        average_params=None if learner_config.average_ema is None else params,
        opt_state=_optimizer(learner_config).init(params),
        key=key_state,
        num_updates=jnp.int32(0),
        metrics=_no_metrics(replay_spec.num_tasks),
        non_finite=no_non_finite(batch, batch_size),
    )
    return jax.tree.map(jnp.copy, state)  # donation refuses a buffer that stands in two places


def averaged(average_params: Params | None, params: Params, ema: float | None) -> Params | None:
    """The moving average of the parameters after a gradient step, if one is kept."""
    return None if ema is None or average_params is None else optax.incremental_update(params, average_params, 1 - ema)


def make_train_step(
    agent: OffPolicyAgent,
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
    train_step = of_one_device(agent, replay_spec, learner_config, replay_config, num_updates)
    return jax.jit(train_step, donate_argnums=(0, 1))


def of_one_device(
    agent: OffPolicyAgent,
    replay_spec: ReplaySpec,
    learner_config: LearnerConfig,
    replay_config: ReplayConfig,
    num_updates: int,
    across: Across = ALONE,
) -> TrainStep:
    """What `make_train_step` jits, and what each of several devices does: sizes and batch are those of one device."""

    def update(
        state: LearnerState, replay_state: ReplayState, task_weights: Float[Array, " Z"]
    ) -> tuple[LearnerState, ReplayState]:
        """One gradient step (thesis Algorithm 1 with prioritized replay)."""
        key, *keys = jax.random.split(state.key, 3)
        key_sample, key_loss = map(across.own_key, keys)
        progress = jnp.minimum(state.num_updates / learner_config.total_updates, 1.0)
        start, end = replay_config.importance_sampling_exponent, replay_config.importance_sampling_exponent_end
        is_exponent = start + progress * (end - start)
        batch, info = replay.sample(
            replay_spec, replay_state, key_sample, learner_config.batch_size, is_exponent, across
        )
        weights = info.weights * task_weights[batch.task]

        def weighted_loss(params: Params) -> tuple[Float[Array, ""], AgentLoss]:
            losses = agent.loss(params, state.target_params, key_loss, batch)
            return jnp.mean(weights * losses.loss), losses

        optimizer = _optimizer(learner_config)
        state, loss, losses, grad_norm = gradient_step(
            state, optimizer, weighted_loss, batch, weights, hold_gradient=True, across=across
        )
        if (ema := learner_config.target_ema) is not None:
            target_params = optax.incremental_update(state.params, state.target_params, 1 - ema)
        else:
            due = state.num_updates % learner_config.target_period_updates == 0
            target_params = _when(due, lambda _: state.params, state.target_params)
        average_params = averaged(state.average_params, state.params, learner_config.average_ema)
        priority = jnp.where(jnp.isfinite(losses.priority), losses.priority, 0.0)
        replay_state = replay.update_priorities(replay_spec, replay_state, info.slots, priority, across)
        metrics = _add_metrics(state.metrics, loss, losses, grad_norm, info, batch.task, across)
        state = replace(state, target_params=target_params, average_params=average_params, key=key, metrics=metrics)
        return state, replay_state

    def train_step(
        state: LearnerState, replay_state: ReplayState, task_weights: Float[Array, " Z"]
    ) -> tuple[LearnerState, ReplayState]:
        def one(carry: tuple[LearnerState, ReplayState], _: None):
            return update(*carry, task_weights), None

        return jax.lax.scan(one, (state, replay_state), length=num_updates)[0]

    return train_step


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
        (metrics, the state with empty sums). Without updates there are no largest numbers, and a task without samples
        has its share of them alone.

    Raises:
        NonFiniteError: a loss or gradient was NaN or infinite since the last read; the batch is saved.
    """
    check_finite(state, diagnostics_dir)
    sums: dict[str, Any] = {f.name: getattr(state.metrics, f.name) for f in fields(state.metrics)}
    sums = jax.device_get(sums | sums.pop("agent", {}))
    num_updates, samples = int(sums.pop("num_updates")), sums.pop("task_samples")
    tasks = {name.removeprefix("task_"): x for name, x in sums.items() if x.ndim == 1}
    means = {name: x for name, x in sums.items() if x.ndim == 0 and not name.endswith("_max")}
    metrics = {name: float(x) / max(num_updates, 1) for name, x in means.items()}
    if num_updates > 0:
        metrics |= {name: float(x) for name, x in sums.items() if name.endswith("_max")}
    for i, name in enumerate(task_names):
        metrics[f"sample_share/{name}"] = float(samples[i]) / max(float(samples.sum()), 1.0)
        if samples[i] > 0:
            metrics |= {f"{what}/{name}": float(x[i]) / float(samples[i]) for what, x in tasks.items()}
    return metrics, replace(state, metrics=no_sums(state.metrics))


def check_finite(state: LearnerState, diagnostics_dir: Path) -> None:
    """Raises NonFiniteError as `read_metrics` does. Waits for the device."""
    if jax.device_get(state.non_finite.num_skipped) > 0:
        raise _save_non_finite(jax.device_get(state.non_finite), diagnostics_dir)


def no_non_finite(batch: Any, batch_size: int) -> NonFinite:
    """No such update yet; `batch` is one of the right shapes."""
    zeros = jnp.zeros(batch_size, jnp.float32)
    return NonFinite(num_skipped=jnp.int32(0), update=jnp.int32(-1), batch=batch, loss=zeros, weights=zeros)


def no_sums(sums: T) -> T:
    """The same sums of nothing; the largest number of none is -inf."""

    def start(path: tuple[Any, ...], leaf: Array) -> Array:
        is_max = jax.tree_util.keystr(path, simple=True).endswith("_max")
        return jnp.full(leaf.shape, -jnp.inf if is_max else 0, leaf.dtype)

    return jax.tree_util.tree_map_with_path(start, sums)


def of_each_task(values: Float[Array, " B"] | float, task: Int[Array, " B"], num_tasks: int) -> Float[Array, " Z"]:
    """The sum of a batch's values by task. Where a batch is added sample by sample, a count ends at 2^24 in float32."""
    return jnp.where(task[None, :] == jnp.arange(num_tasks)[:, None], values, 0.0).sum(axis=1)


def gradient_step(
    state: LearnerState,
    optimizer: optax.GradientTransformation,
    mean_loss: Callable[[Params], tuple[Float[Array, ""], LossesT]],
    batch: Any,
    weights: Float[Array, " B"],
    *,
    hold_gradient: bool,
    across: Across = ALONE,
) -> tuple[LearnerState, Float[Array, ""], LossesT, Float[Array, ""]]:
    """One gradient step, which is skipped and noted if its loss or its gradient is not finite.

    Args:
        state: before it.
        optimizer: of its parameters.
        mean_loss: parameters -> (what is made smaller, the samples' losses).
        batch: what is kept with a loss or gradient that is not finite, a pytree of arrays.
        weights: of the samples; kept likewise.
        hold_gradient: do not let XLA compute multiples of the gradient ahead of the loop that `_when` is. The results
            differ in the last digits.
        across: the devices whose losses and gradients are averaged.

    Returns:
        (state with new params, opt_state, num_updates and non_finite; loss; the samples' losses; norm of the gradient).
    """
    (loss, losses), grads = jax.value_and_grad(mean_loss, has_aux=True)(state.params)
    loss, grads = across.mean((loss, grads))
    grad_norm = jnp.sqrt(sum(jnp.vdot(leaf, leaf) for leaf in jax.tree.leaves(grads)))
    finite = jnp.isfinite(loss) & jnp.isfinite(grad_norm)

    def apply_gradient(trained: tuple[Params, optax.OptState]) -> tuple[Params, optax.OptState]:
        (params, opt_state), here = trained, grads
        if hold_gradient:
            (params, opt_state), here = jax.lax.optimization_barrier((trained, grads))
        deltas, opt_state = optimizer.update(here, opt_state, params)
        return optax.apply_updates(params, deltas), opt_state

    params, opt_state = _when(finite, apply_gradient, (state.params, state.opt_state))
    num_updates = state.num_updates + 1
    bad = NonFinite(num_skipped=jnp.int32(0), update=num_updates, batch=batch, loss=losses.loss, weights=weights)
    non_finite = _when(~finite & (state.non_finite.num_skipped == 0), lambda _: bad, state.non_finite)
    non_finite = replace(non_finite, num_skipped=non_finite.num_skipped + ~finite)
    state = replace(state, params=params, opt_state=opt_state, num_updates=num_updates, non_finite=non_finite)
    return state, loss, losses, grad_norm


def _when(condition: Bool[Array, ""], f: Callable[[T], T], value: T) -> T:
    """f(value) if the condition holds, else `value`, in place.

    A loop of one or no round: XLA copies what goes through a `lax.cond` or a `where` of a whole tree (60 of 240 ms of
    CPU time an update; 2026-11-21, 2-core AMD EPYC), but updates a loop's carry where it is.
    """
    return jax.lax.fori_loop(0, condition.astype(jnp.int32), lambda _, carry: f(carry), value)


def _optimizer(config: LearnerConfig) -> optax.GradientTransformation:
    """Adam (thesis Table 5.1), with decoupled weight decay and after clipping by the global norm if configured."""
    adam = optax.adamw(config.learning_rate, eps=config.adam_eps, weight_decay=config.weight_decay)
    if config.weight_decay == 0.0:
        adam = optax.adam(config.learning_rate, eps=config.adam_eps)
    if config.max_grad_norm is None:
        return adam
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), adam)


def _no_metrics(num_tasks: int) -> MetricSums:
    names = {f.name for f in fields(MetricSums)} - {"num_updates"}
    sums = {name: jnp.zeros(num_tasks if name.startswith("task_") else (), jnp.float32) for name in names}
    return no_sums(MetricSums(num_updates=jnp.int32(0), **sums))


def _add_metrics(
    sums: MetricSums,
    loss: Float[Array, ""],
    losses: AgentLoss,
    grad_norm: Float[Array, ""],
    info: SampleInfo,
    task: Int[Array, " B"],
    across: Across,
) -> MetricSums:
    magnitude = jnp.abs(losses.td_error)

    def mean(values: Float[Array, " B"]) -> Float[Array, ""]:
        return across.mean(values.mean())

    def per_task(sums: Float[Array, " Z"], values: Float[Array, " B"] | float) -> Float[Array, " Z"]:
        return sums + across.sum(of_each_task(values, task, len(sums)))

    return MetricSums(
        num_updates=sums.num_updates + 1,
        loss=sums.loss + loss,
        priority=sums.priority + mean(losses.priority),
        td_error=sums.td_error + mean(magnitude),
        q_mean=sums.q_mean + mean(losses.q_tm1),
        q_max=jnp.maximum(sums.q_max, across.max(losses.q_tm1.max())),
        grad_norm=sums.grad_norm + grad_norm,
        grad_norm_max=jnp.maximum(sums.grad_norm_max, grad_norm),
        importance_weight=sums.importance_weight + mean(info.weights),
        task_samples=per_task(sums.task_samples, 1.0),
        task_loss=per_task(sums.task_loss, losses.loss),
        task_priority=per_task(sums.task_priority, losses.priority),
        task_td_error=per_task(sums.task_td_error, magnitude),
    )


def _save_non_finite(record: NonFinite, directory: Path) -> NonFiniteError:
    update = int(record.update)
    file = directory / f"nonfinite_batch_{update}.npz"
    leaves = jax.tree_util.tree_leaves_with_path(record.batch)
    arrays = {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}
    np.savez(file, loss=record.loss, weights=record.weights, **arrays)
    bad = int(np.sum(~np.isfinite(record.loss)))
    return NonFiniteError(
        f"update {update}: {bad} of {record.loss.size} losses are NaN or infinite"
        f"{'' if bad else ', but the gradient is not finite'}; {int(record.num_skipped)} updates were skipped since "
        f"the last read and the parameters are as before them. The batch is saved in {file}; load it with numpy, "
        "look for extreme rewards or weights, and lower learner.learning_rate or set learner.max_grad_norm"
    )
