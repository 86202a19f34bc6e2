"""The train step against the same update done by hand, and its promises: one compilation, in place, no NaN kept."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gvz.errors import NonFiniteError
from learner import replay, sum_tree, train_step
from learner.agents.base import AgentLoss, AgentSpec, Evaluation, make_agent
from learner.config import AgentConfig, LearnerConfig, ReplayConfig
from learner.replay import ReplaySpec, ReplayState

LANES, TASKS, B = 2, 2, 8
SPEC = AgentSpec(obs_shape=(8, 8, 2), num_actions=3, num_tasks=TASKS, v_min=-3.0, v_max=3.0)
RAINBOW = AgentConfig(conv_channels=(3,), conv_kernels=(4,), conv_strides=(2,), hidden_units=6, num_atoms=5)
AGENT = make_agent(RAINBOW, SPEC)
REPLAY = ReplaySpec(
    num_lanes=LANES,
    capacity=256,
    frame_shape=(8, 8, 1),
    num_tasks=TASKS,
    stack_size=2,
    n_steps=2,
    discount=0.9,
    priority_exponent=0.6,
    min_priority=0.01,
    prioritized=True,
    num_newest=0,
)
LEARNER = LearnerConfig(batch_size=B, total_updates=10, target_period_updates=3, learning_rate=1e-3, max_grad_norm=0.5)
REPLAY_CONFIG = ReplayConfig()
ONES = np.ones(TASKS, np.float32)
NAMES = ("easy", "hard")


@dataclass(frozen=True)
class OneWeight:
    """Its loss is `reward * w` with derivative `1 / sqrt(w)` added: the smallest agent that can go wrong."""

    spec: AgentSpec = SPEC

    def init(self, key):
        del key
        return {"w": jnp.ones(())}

    def act(self, params, key, obs, task, epsilon):
        del params, key, task, epsilon
        return jnp.zeros(obs.shape[0], jnp.int32)

    def evaluate(self, params, obs, task):
        del task
        return Evaluation(jnp.zeros(obs.shape[0], jnp.int32), params["w"] * jnp.ones((obs.shape[0], 3)))

    def loss(self, online_params, target_params, key, batch):
        del key
        w, away = online_params["w"], online_params["w"] - target_params["w"]
        value = batch.r_t * w + jnp.sqrt(jnp.maximum(w, 0.0))
        return AgentLoss(value + 0.0 * away, jnp.abs(batch.r_t), w * jnp.ones(B), batch.r_t)


@cache
def filled_replay() -> dict[str, np.ndarray]:
    """50 records a lane: lane 0 plays task 0, lane 1 plays task 1; episodes of 10."""
    rng, N = np.random.default_rng(0), 100
    t = np.arange(N) // LANES
    block = replay.StepArrays(
        frames=jnp.asarray(rng.integers(0, 256, (N, 8, 8, 1), dtype=np.uint8)),
        action=jnp.asarray(rng.integers(0, 3, N), jnp.int32),
        reward=jnp.asarray(rng.normal(size=N), jnp.float32),
        lane=jnp.asarray(np.arange(N) % LANES, jnp.int32),
        task=jnp.asarray(np.arange(N) % LANES, jnp.int32),
        first=jnp.asarray(t % 10 == 0),
        terminated=jnp.asarray(t % 10 == 9),
        truncated=jnp.zeros(N, bool),
        num_valid=jnp.int32(N),
    )
    state = jax.jit(replay.init, static_argnums=0)(REPLAY)
    return jax.device_get(jax.jit(replay.add, static_argnums=0)(REPLAY, state, block))


def fresh_replay(**changes) -> ReplayState:
    return jax.tree.map(jnp.array, replace(filled_replay(), **changes))


def fresh_state(agent=AGENT, config: LearnerConfig = LEARNER) -> train_step.LearnerState:
    return _init(agent, config)(jax.random.key(0))


@cache
def _init(agent, config: LearnerConfig):
    return jax.jit(lambda key: train_step.init(agent, REPLAY, config, key))


@cache
def compiled(num_updates: int = 1, agent=AGENT, config: LearnerConfig = LEARNER):
    return train_step.make_train_step(agent, REPLAY, config, REPLAY_CONFIG, num_updates)


@jax.jit
def update_by_hand(params, target_params, opt_state, replay_state, key, beta, task_weights):
    """One update in plain steps, with optax used the plain way."""
    key, key_sample, key_loss = jax.random.split(key, 3)
    batch, info = replay.sample(REPLAY, replay_state, key_sample, B, beta)

    def mean_loss(params):
        result = AGENT.loss(params, target_params, key_loss, batch)
        return (info.weights * task_weights[batch.task] * result.loss).mean(), result

    (loss, result), grads = jax.value_and_grad(mean_loss, has_aux=True)(params)
    grad_norm = jnp.linalg.norm(jnp.concatenate([leaf.ravel() for leaf in jax.tree.leaves(grads)]))
    optimizer = optax.chain(optax.clip_by_global_norm(0.5), optax.adam(1e-3, eps=1e-7))
    deltas, opt_state = optimizer.update(grads, opt_state)
    params = optax.apply_updates(params, deltas)
    replay_state = replay.update_priorities(REPLAY, replay_state, info.slots, result.priority)
    return params, opt_state, replay_state, key, (loss, result, grad_norm, info, batch.task)


def leaves_close(a, b, **tolerance):
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, **({"rtol": 2e-4, "atol": 2e-6} | tolerance)), a, b)


def raw(state):
    """Leaves as numpy, keys as their bits."""

    def is_key(leaf: jax.Array) -> bool:
        return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)

    return [np.asarray(jax.random.key_data(x) if is_key(x) else x) for x in jax.tree.leaves(state)]


def test_updates_equal_those_done_by_hand(tmp_path: Path):
    task_weights = np.float32([1.0, 2.5])
    state, stored = fresh_state(), fresh_replay()
    params, target, opt_state, key = state.params, state.target_params, state.opt_state, state.key
    params, target, opt_state = jax.tree.map(jnp.array, (params, target, opt_state))
    by_hand, seen = fresh_replay(), []
    for update in range(7):
        beta = 0.4 + 0.6 * update / 10  # annealed linearly over total_updates
        params, opt_state, by_hand, key, numbers = update_by_hand(
            params, target, opt_state, by_hand, key, jnp.float32(beta), task_weights
        )
        if (update + 1) % 3 == 0:
            target = params
        seen.append(jax.device_get(numbers))
        state, stored = compiled()(state, stored, task_weights)
    leaves_close(state.params, params)
    leaves_close(state.target_params, target)
    leaves_close(stored.tree, by_hand.tree)
    np.testing.assert_allclose(stored.max_priority, by_hand.max_priority, rtol=1e-4)
    assert int(state.num_updates) == 7

    metrics, state = train_step.read_metrics(state, NAMES, tmp_path)
    tasks = np.concatenate([n[4] for n in seen])
    losses_seen, priorities, td_errors = (
        np.concatenate([getattr(n[1], name) for n in seen]) for name in ("loss", "priority", "td_error")
    )
    wanted = {
        "loss": np.mean([n[0] for n in seen]),
        "priority": priorities.mean(),
        "td_error": np.abs(td_errors).mean(),
        "q_mean": np.mean([n[1].q_tm1 for n in seen]),
        "q_max": np.max([n[1].q_tm1 for n in seen]),
        "grad_norm": np.mean([n[2] for n in seen]),
        "grad_norm_max": np.max([n[2] for n in seen]),
        "importance_weight": np.mean([n[3].weights for n in seen]),
    }
    for i, name in enumerate(NAMES):
        wanted[f"sample_share/{name}"] = np.mean(tasks == i)
        wanted[f"loss/{name}"] = losses_seen[tasks == i].mean()
        wanted[f"priority/{name}"] = priorities[tasks == i].mean()
        wanted[f"td_error/{name}"] = np.abs(td_errors[tasks == i]).mean()
    assert metrics.keys() == wanted.keys()
    for name, value in wanted.items():
        np.testing.assert_allclose(metrics[name], value, rtol=1e-3, atol=1e-5, err_msg=name)
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(replace(state.metrics, q_max=jnp.zeros(()))))


def test_one_call_of_many_updates_equals_many_calls_of_one():
    state, stored = fresh_state(), fresh_replay()
    for _ in range(4):
        state, stored = compiled()(state, stored, ONES)
    together = compiled(4)(fresh_state(), fresh_replay(), ONES)
    for one, other in zip(raw((state, stored)), raw(together), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


def test_the_same_seed_gives_the_same_bits():
    runs = []
    for _ in range(2):
        state, stored = fresh_state(), fresh_replay()
        for _ in range(3):
            state, stored = compiled()(state, stored, ONES)
        runs.append(raw((state, stored)))
    for one, other in zip(*runs, strict=True):
        np.testing.assert_array_equal(one, other)


def test_target_is_copied_exactly_every_period():
    state, stored = fresh_state(), fresh_replay()
    at_start = jax.device_get(state.target_params)
    for update in range(1, 7):
        state, stored = compiled()(state, stored, ONES)
        if update in (3, 6):
            jax.tree.map(np.testing.assert_array_equal, state.params, state.target_params)
            at_start = jax.device_get(state.params)
        else:
            jax.tree.map(np.testing.assert_array_equal, state.target_params, at_start)


def test_nothing_compiles_and_nothing_is_transferred_after_the_first_call():
    state, stored = fresh_state(), fresh_replay()
    weights = [jnp.asarray(ONES * scale) for scale in (1.0, 2.0, 3.0)]
    step = train_step.make_train_step(AGENT, REPLAY, LEARNER, REPLAY_CONFIG, 1)
    compilations = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda event, _duration, **_: compilations.append(event) if "backend_compile" in event else None
    )
    state, stored = step(state, stored, weights[0])
    assert compilations, "the first call compiles, or this test sees nothing"
    compilations.clear()
    with jax.transfer_guard("disallow"):
        for i in range(10):
            state, stored = step(state, stored, weights[i % 3])
    assert compilations == []


def test_states_are_donated():
    state, stored = fresh_state(), fresh_replay()
    frames = stored.frames.unsafe_buffer_pointer()
    new_state, new_stored = compiled()(state, stored, ONES)
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves((state, stored)))
    assert new_stored.frames.unsafe_buffer_pointer() == frames, "frames stay where they are"
    assert int(new_state.num_updates) == 1


def test_tasks_of_weight_zero_change_nothing():
    state = fresh_state()
    before = jax.device_get(state.params)
    state, _ = compiled()(state, fresh_replay(), 0 * ONES)
    jax.tree.map(np.testing.assert_array_equal, state.params, before)


def test_a_non_finite_loss_is_skipped_saved_and_raised(tmp_path: Path):
    rewards = filled_replay().reward.copy()
    rewards[:40] = np.nan
    state, stored = fresh_state(), fresh_replay(reward=rewards)
    before = raw((state.params, state.opt_state, state.target_params))
    state, stored = compiled()(state, stored, ONES)
    for one, other in zip(raw((state.params, state.opt_state, state.target_params)), before, strict=True):
        np.testing.assert_array_equal(one, other)
    assert np.isfinite(np.asarray(stored.tree.nodes)).all()
    assert float(sum_tree.total(stored.tree)) > 0
    for _ in range(2):
        state, stored = compiled()(state, stored, ONES)
    file = tmp_path / "nonfinite_batch_1.npz"
    with pytest.raises(NonFiniteError, match=r"update 1: \d of 8 losses are NaN or infinite; 3 updates were skipped"):
        train_step.read_metrics(state, NAMES, tmp_path)
    with np.load(file) as saved:
        assert set(saved) == {"loss", "weights", "obs_tm1", "a_tm1", "r_t", "discount_t", "obs_t", "task"}
        assert np.isnan(saved["r_t"]).any()
        np.testing.assert_array_equal(np.isnan(saved["r_t"]), np.isnan(saved["loss"]))
        assert saved["obs_t"].shape == (B, 8, 8, 2)
        assert saved["obs_t"].any()


def test_a_non_finite_gradient_of_a_finite_loss_is_caught_too(tmp_path: Path):
    agent = OneWeight()
    state = replace(fresh_state(agent), params={"w": jnp.zeros(())})  # the root's slope is infinite at 0
    state, _ = compiled(agent=agent)(state, fresh_replay(), ONES)
    assert float(state.params["w"]) == 0.0
    with pytest.raises(NonFiniteError, match=r"update 1: 0 of 8 losses .*, but the gradient is not finite; 1 updates"):
        train_step.read_metrics(state, NAMES, tmp_path)


def test_metrics_without_updates_and_without_samples_have_no_entries_of_them(tmp_path: Path):
    metrics, _ = train_step.read_metrics(fresh_state(), NAMES, tmp_path)
    assert metrics["loss"] == 0.0
    assert not {"q_max", "grad_norm_max", "loss/easy", "priority/hard"} & metrics.keys()
    assert metrics["sample_share/easy"] == 0.0


def test_updates_of_one_call_default_to_one_on_a_cpu():
    assert train_step.default_num_updates(LEARNER) == 1
    assert train_step.default_num_updates(replace(LEARNER, num_updates_per_call=5)) == 5
