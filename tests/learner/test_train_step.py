"""The train step against the equations in float64, and its promises: one compilation, in place, no NaN kept."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gvz.core.errors import NonFiniteError
from learner import losses, replay, sum_tree, train_step
from learner.agents.base import AgentLoss, AgentSpec, Evaluation, make_agent
from learner.agents.configs.rainbow import RainbowConfig
from learner.config import LearnerConfig, ReplayConfig
from learner.replay import ReplaySpec, ReplayState
from learner.store import StepArrays

pytestmark = pytest.mark.isa

LANES, TASKS, B = 2, 2, 8
SPEC = AgentSpec(obs_shape=(8, 8, 2), num_actions=3, num_tasks=TASKS, v_min=-3.0, v_max=3.0)
RAINBOW = RainbowConfig(conv_channels=(3,), conv_kernels=(4,), conv_strides=(2,), hidden_units=6, num_atoms=5)
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
REPLAY_CONFIG = ReplayConfig(importance_sampling_exponent=0.3, importance_sampling_exponent_end=0.8)
ONES = np.ones(TASKS, np.float32)
NAMES = ("easy", "hard")


@dataclass(frozen=True)
class OneWeight:
    """Its loss is `reward * w` with derivative `1 / sqrt(w)` added: the smallest agent that can go wrong."""

    spec: AgentSpec = SPEC

    def init(self, key):
        del key
        return {"w": jnp.ones(())}

    def epsilon(self, env_steps):
        del env_steps
        return 0.0

    def act(self, params, key, obs, epsilon):
        del params, key, epsilon
        return jnp.zeros(B, jnp.int32), jnp.zeros((B, 0))

    def evaluate(self, params, obs):
        del obs
        return Evaluation(jnp.zeros(B, jnp.int32), params["w"] * jnp.ones((B, 3)))

    def loss(self, online_params, target_params, key, batch):
        del key
        w, away = online_params["w"], online_params["w"] - target_params["w"]
        value = batch.r_t * w + jnp.sqrt(jnp.maximum(w, 0.0))
        return AgentLoss(value + 0.0 * away, jnp.abs(batch.r_t), w * jnp.ones(B), batch.r_t)


@dataclass(frozen=True)
class LinearQ:
    """Q(s, a) = w_a . (two pixels, 1): DQN's loss, whose gradient is worked out by hand."""

    spec: AgentSpec = SPEC

    def init(self, key):
        return {"w": jax.random.normal(key, (3, 3))}

    def q_values(self, params, obs):
        pixels = obs.frames[:, 2, 5].astype(jnp.float32) / 255  # of the two stacked frames
        return jnp.concatenate([pixels, jnp.ones((len(pixels), 1))], axis=1) @ params["w"].T

    def epsilon(self, env_steps):
        del env_steps
        return 0.0

    def act(self, params, key, obs, epsilon):
        del key, epsilon
        action = self.q_values(params, obs).argmax(1).astype(jnp.int32)
        return action, jnp.zeros((len(action), 0))

    def evaluate(self, params, obs):
        q = self.q_values(params, obs)
        return Evaluation(q.argmax(1), q)

    def loss(self, online_params, target_params, key, batch):
        del key
        q_tm1 = losses.take_action(self.q_values(online_params, batch.obs_tm1), batch.a_tm1)
        target = batch.r_t + batch.discount_t * self.q_values(target_params, batch.obs_t).max(1)
        td = jax.lax.stop_gradient(target) - q_tm1
        return AgentLoss(losses.huber(td), jnp.abs(td), q_tm1, td)


@cache
def filled_replay() -> dict[str, np.ndarray]:
    """50 records a lane: lane 0 plays task 0, lane 1 plays task 1; episodes of 10."""
    rng, N = np.random.default_rng(0), 100
    t = np.arange(N) // LANES
    block = StepArrays(
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
    """The filled replay with other fields of its own, or of its store."""
    filled = filled_replay()
    own = {name: value for name, value in changes.items() if hasattr(filled, name)}
    stored = replace(filled.store, **{name: value for name, value in changes.items() if name not in own})
    return jax.tree.map(jnp.array, replace(filled, store=stored, **own))


def fresh_state(agent=AGENT, config: LearnerConfig = LEARNER) -> train_step.LearnerState:
    return _init(agent, config)(jax.random.key(0))


@cache
def _init(agent, config: LearnerConfig):
    return jax.jit(lambda key: train_step.init(agent, REPLAY, config, key))


@cache
def compiled(num_updates: int = 1, agent=AGENT, config: LearnerConfig = LEARNER):
    return train_step.make_train_step(agent, REPLAY, config, REPLAY_CONFIG, num_updates)


def raw(state):
    """Leaves as numpy, keys as their bits."""

    def is_key(leaf: jax.Array) -> bool:
        return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)

    return [np.asarray(jax.random.key_data(x) if is_key(x) else x) for x in jax.tree.leaves(state)]


LANE_SLOTS = REPLAY.lane_capacity
DRAWN = {3: 1.0, 17: 3.0, LANE_SLOTS + 8: 2.0, LANE_SLOTS + 20: 2.0}
"""priorities by slot: each of the 8 equal parts of their sum lies in one of them, so every batch is known"""


class Float64Learner:
    """What a learner of `LinearQ` must be after each update, in float64, from the papers' equations alone."""

    def __init__(self, w: np.ndarray, task_weights: np.ndarray, config: LearnerConfig):
        self.w, self.target, self.average = (w.astype(np.float64) for _ in range(3))
        self.task_weights, self.config = task_weights, config
        self.mean, self.square, self.num_updates = np.zeros_like(self.w), np.zeros_like(self.w), 0
        self.max_priority = 1.0
        slots = np.array(list(DRAWN))
        self.slots = np.repeat(slots, [int(share) for share in DRAWN.values()])
        lane, t = self.slots // LANE_SLOTS, self.slots % LANE_SLOTS
        stored = filled_replay().store
        pixel = stored.frames.reshape(-1, 8, 8)[:, 2, 5] / 255.0

        def features(t):
            before = np.where(t % 10 == 0, t, t - 1)  # an episode's first frame is repeated
            return np.stack([pixel[lane * LANE_SLOTS + before], pixel[lane * LANE_SLOTS + t], np.ones(B)], axis=1)

        reward = stored.reward.astype(np.float64)
        one_step = t % 10 == 8  # the next record is the episode's last
        length = np.where(one_step, 1, 2)
        self.r_t = reward[self.slots + 1] + np.where(one_step, 0.0, 0.9 * reward[self.slots + length])
        self.discount_t = np.where((t + length) % 10 == 9, 0.0, 0.9**length)
        self.phi_tm1, self.phi_t, self.a_tm1, self.task = (
            features(t),
            features(t + length),
            stored.action[self.slots],
            lane,
        )
        self.probability = np.array([DRAWN[slot] for slot in self.slots]) / B

    def update(self) -> dict[str, np.ndarray]:
        """One update; returns what the metrics are made of."""
        beta = 0.3 + 0.5 * self.num_updates / 10  # annealed linearly over total_updates
        importance = (1 / (100 * self.probability)) ** beta  # eq. 4.13; any number of transitions gives the same
        importance /= importance.max()
        q_tm1 = (self.phi_tm1 * self.w[self.a_tm1]).sum(1)
        td = self.r_t + self.discount_t * (self.phi_t @ self.target.T).max(1) - q_tm1
        loss = np.where(np.abs(td) < 1, td**2 / 2, np.abs(td) - 0.5)
        weights = importance * self.task_weights[self.task]
        gradient = np.zeros_like(self.w)
        for i in range(B):
            gradient[self.a_tm1[i]] -= weights[i] * np.clip(td[i], -1, 1) * self.phi_tm1[i] / B
        norm = np.linalg.norm(gradient)
        clipped = gradient * min(1.0, 0.5 / norm)
        self.num_updates += 1
        k = self.num_updates
        self.mean = 0.9 * self.mean + 0.1 * clipped  # Kingma and Ba 2015, Algorithm 1
        self.square = 0.999 * self.square + 0.001 * clipped**2
        step = (self.mean / (1 - 0.9**k)) / (np.sqrt(self.square / (1 - 0.999**k)) + self.config.adam_eps)
        self.w = self.w - 0.1 * (step + self.config.weight_decay * self.w)  # Loshchilov and Hutter 2019, Algorithm 2
        if (ema := self.config.target_ema) is not None:
            self.target = ema * self.target + (1 - ema) * self.w
        elif k % 3 == 0:
            self.target = self.w.copy()
        if (ema := self.config.average_ema) is not None:
            self.average = ema * self.average + (1 - ema) * self.w
        self.leaves = np.zeros(REPLAY.num_slots)
        self.leaves[self.slots] = (np.abs(td) + 0.01) ** 0.6  # eq. 4.11, 4.12
        self.max_priority = max(self.max_priority, self.leaves.max())
        mean_loss = (weights * loss).mean()
        return {"loss": loss, "mean": mean_loss, "td": td, "q": q_tm1, "norm": norm, "importance": importance}


@pytest.mark.parametrize("changes", [{}, {"target_ema": 0.7, "average_ema": 0.9, "weight_decay": 0.2}])
def test_updates_are_those_of_the_equations_in_float64(tmp_path: Path, changes: dict):
    """Batch, n-step return, importance and task weights, Huber loss, clipping, Adam, target, priorities, metrics."""
    task_weights, agent = np.float32([1.0, 2.5]), LinearQ()
    config = replace(LEARNER, learning_rate=0.1, adam_eps=0.01, **changes)
    state, updates = fresh_state(agent, config), 7
    oracle, seen = Float64Learner(np.asarray(state.params["w"]), task_weights, config), []
    slots, priorities = np.array(list(DRAWN)), np.float32(list(DRAWN.values()))
    tree = jax.device_get(sum_tree.set(sum_tree.init(REPLAY.num_slots), slots, priorities))
    max_priority = np.float32(1.0)
    for _ in range(updates):
        stored = fresh_replay(tree=tree, max_priority=max_priority)
        state, stored = compiled(agent=agent, config=config)(state, stored, task_weights)
        max_priority = np.asarray(stored.max_priority)
        seen.append(oracle.update())
        np.testing.assert_allclose(state.params["w"], oracle.w, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(state.target_params["w"], oracle.target, rtol=1e-4, atol=1e-5)
        if state.average_params is not None:
            np.testing.assert_allclose(state.average_params["w"], oracle.average, rtol=1e-4, atol=1e-5)
        leaves = np.asarray(sum_tree.get(stored.tree, np.arange(REPLAY.num_slots)))
        np.testing.assert_allclose(leaves, oracle.leaves, rtol=1e-3, atol=1e-5)
        np.testing.assert_allclose(max_priority, oracle.max_priority, rtol=1e-4)
    assert int(state.num_updates) == updates
    norms = [n["norm"] for n in seen]
    assert min(norms) < 0.5 < max(norms), "some gradients are clipped and some are not"
    assert {abs(td) < 1 for n in seen for td in n["td"]} == {True, False}, "both sides of the Huber loss"

    metrics, state = train_step.read_metrics(state, NAMES, tmp_path)
    loss, td, q = (np.concatenate([n[name] for n in seen]) for name in ("loss", "td", "q"))
    wanted = {
        "loss": np.mean([n["mean"] for n in seen]),
        "priority": np.abs(td).mean(),
        "td_error": np.abs(td).mean(),
        "q_mean": q.mean(),
        "q_max": q.max(),
        "grad_norm": np.mean(norms),
        "grad_norm_max": np.max(norms),
        "importance_weight": np.mean([n["importance"] for n in seen]),
    }
    tasks = np.tile(oracle.task, updates)
    for i, name in enumerate(NAMES):
        wanted[f"sample_share/{name}"] = np.mean(tasks == i)
        wanted[f"loss/{name}"] = loss[tasks == i].mean()
        wanted[f"priority/{name}"] = wanted[f"td_error/{name}"] = np.abs(td[tasks == i]).mean()
    assert metrics.keys() == wanted.keys()
    for name, value in wanted.items():
        np.testing.assert_allclose(metrics[name], value, rtol=1e-3, atol=1e-5, err_msg=name)
    zero = jnp.zeros(())
    assert not any(np.any(leaf) for leaf in jax.tree.leaves(replace(state.metrics, q_max=zero, grad_norm_max=zero)))


def test_one_call_of_many_updates_equals_many_calls_of_one():
    state, stored = fresh_state(), fresh_replay()
    for _ in range(4):
        state, stored = compiled()(state, stored, ONES)
    together = compiled(4)(fresh_state(), fresh_replay(), ONES)
    for one, other in zip(raw((state, stored)), raw(together), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6)


def test_the_same_seed_gives_the_same_bits_and_every_update_has_a_key_of_its_own():
    runs = []
    for _ in range(2):
        state, stored = fresh_state(), fresh_replay()
        keys = [raw(state.key)[0].tolist()]
        for _ in range(3):
            state, stored = compiled()(state, stored, ONES)
            keys.append(raw(state.key)[0].tolist())
        assert len(set(map(tuple, keys))) == 4
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
    frames = stored.store.frames.unsafe_buffer_pointer()
    new_state, new_stored = compiled()(state, stored, ONES)
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves((state, stored)))
    assert new_stored.store.frames.unsafe_buffer_pointer() == frames, "frames stay where they are"
    assert int(new_state.num_updates) == 1


def test_tasks_of_weight_zero_change_nothing():
    state = fresh_state()
    before = jax.device_get(state.params)
    state, _ = compiled()(state, fresh_replay(), 0 * ONES)
    jax.tree.map(np.testing.assert_array_equal, state.params, before)


def test_a_non_finite_loss_is_skipped_saved_and_raised(tmp_path: Path):
    rewards = filled_replay().store.reward.copy()
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
        assert set(saved) == {"loss", "weights", "a_tm1", "r_t", "discount_t"} | {
            f"{obs}.{name}" for obs in ("obs_tm1", "obs_t") for name in ("frames", "vector", "actions", "task")
        }
        assert np.isnan(saved["r_t"]).any()
        np.testing.assert_array_equal(np.isnan(saved["r_t"]), np.isnan(saved["loss"]))
        assert saved["obs_t.frames"].shape == (B, 8, 8, 2)
        assert saved["obs_t.frames"].any()


def test_a_non_finite_gradient_of_a_finite_loss_is_caught_too(tmp_path: Path):
    agent = OneWeight()
    state = replace(fresh_state(agent), params={"w": jnp.zeros(())})  # the root's slope is infinite at 0
    state, _ = compiled(agent=agent)(state, fresh_replay(), ONES)
    assert float(state.params["w"]) == 0.0
    with pytest.raises(NonFiniteError, match=r"update 1: 0 of 8 losses .*, but the gradient is not finite; 1 updates"):
        train_step.read_metrics(state, NAMES, tmp_path)


def test_samples_are_counted_on_where_float32_no_longer_tells_one_more():
    state = fresh_state()
    state = replace(state, metrics=replace(state.metrics, task_samples=jnp.full(TASKS, 2.0**24)))
    state, _ = compiled()(state, fresh_replay(), ONES)
    assert (np.asarray(state.metrics.task_samples) > 2.0**24).all()


def test_metrics_without_updates_and_without_samples_have_no_entries_of_them(tmp_path: Path):
    metrics, _ = train_step.read_metrics(fresh_state(), NAMES, tmp_path)
    assert metrics["loss"] == 0.0
    assert not {"q_max", "grad_norm_max", "loss/easy", "priority/hard"} & metrics.keys()
    assert metrics["sample_share/easy"] == 0.0


def test_updates_of_one_call_default_to_one_on_a_cpu():
    assert train_step.default_num_updates(LEARNER) == 1
    assert train_step.default_num_updates(replace(LEARNER, num_updates_per_call=5)) == 5
