"""Updates of PPO and PQN against the equations in float64, and their promises: in place, finite.

The agents are the real ones with a linear network, whose numbers are worked out in numpy.
"""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gvz.core.errors import NonFiniteError
from learner import rollout_step
from learner.agents.base import AgentSpec, SampleLosses
from learner.agents.configs.ppo import PPOConfig
from learner.agents.configs.pqn import PQNConfig
from learner.agents.ppo import PPO
from learner.agents.pqn import PQN
from learner.config import OnPolicyConfig
from learner.on_policy import OnPolicyParts
from learner.rollouts import Rollout, RolloutSpec
from learner.store import Store
from learner.train_step import LearnerState, read_metrics

pytestmark = pytest.mark.isa

L, T, A, GAMMA, LAMBDA = 3, 8, 3, 0.9, 0.7
W = T + 1
SPEC = AgentSpec(obs_shape=(1, 4, 1), num_actions=A, num_tasks=2, v_min=-1.0, v_max=1.0)
CONFIG = OnPolicyConfig(
    rollout_steps=T,
    num_epochs=3,
    num_minibatches=1,
    total_updates=6,
    learning_rate=0.1,
    learning_rate_decay=True,
    max_grad_norm=0.25,
    average_ema=0.8,
)
NAMES = ("easy", "hard")


def rollout_spec(num_extras: int) -> RolloutSpec:
    return RolloutSpec(
        num_lanes=L, capacity=L * W, frame_shape=(1, 4, 1), num_tasks=2, stack_size=1, num_extras=num_extras
    )


@dataclass(frozen=True)
class LinearPPO(PPO):
    """Logits and value are w . (pixels, 1)."""

    def init(self, key):
        return {"w": 0.5 * jax.random.normal(key, (A + 1, 5))}

    def policy(self, params, obs):
        outputs = _features(obs) @ params["w"].T
        return outputs[:, :A], outputs[:, A]


@dataclass(frozen=True)
class LinearPQN(PQN):
    """Q(s, a) = w_a . (pixels, 1)."""

    def init(self, key):
        return {"w": 0.5 * jax.random.normal(key, (A, 5))}

    def q_values(self, params, obs):
        return _features(obs) @ params["w"].T


def _features(obs):
    pixels = obs.frames.reshape(-1, 4).astype(jnp.float32) / 255
    return jnp.concatenate([pixels, jnp.ones((len(pixels), 1))], axis=1)


AGENTS = {
    "ppo": LinearPPO(PPOConfig(discount=GAMMA, td_lambda=LAMBDA, value_clip=0.1), SPEC),
    "pqn": LinearPQN(PQNConfig(discount=GAMMA, td_lambda=LAMBDA), SPEC),
}
PPO_, PQN_ = AGENTS["ppo"], AGENTS["pqn"]


@cache
def made_up_windows(num_extras: int) -> Store:
    """Windows whose episodes terminate and time out; window b plays task b % 2."""
    rng, K = np.random.default_rng(3), L * W
    last = rng.random(K) < 0.25
    terminated = last & (rng.random(K) < 0.5)
    extras = rng.normal(size=(K, num_extras)).astype(np.float32)
    extras[:, 1:] = np.log(rng.uniform(0.1, 0.6, (K, num_extras - 1)))
    return Store(
        frames=rng.integers(0, 256, (K, 4), dtype=np.uint8),
        action=rng.integers(0, A, K).astype(np.int32),
        reward=rng.normal(size=K).astype(np.float32),
        task=np.repeat(np.arange(L) % 2, W).astype(np.int32),
        first=np.roll(last, 1),
        last=last,
        terminated=terminated,
        vector=np.zeros((K, 0), np.float32),
        extras=extras,
        heads=np.zeros(L, np.int32),
    )


class Float64Learner:
    """The same in float64 from the papers' equations; gradients by central differences of the loss."""

    def __init__(self, w: np.ndarray, windows: Store, loss):
        self.w, self.average, self.num_updates = w.astype(np.float64), w.astype(np.float64), 0
        self.mean, self.square = np.zeros_like(self.w), np.zeros_like(self.w)
        self.loss = loss
        value = windows.extras[:, 0].astype(np.float64).reshape(L, W)
        reward = windows.reward.astype(np.float64).reshape(L, W)
        last, terminated = windows.last.reshape(L, W), windows.terminated.reshape(L, W)
        returns = np.zeros((L, T))
        for b in range(L):
            for t in reversed(range(T)):
                g = reward[b, t + 1]
                if not terminated[b, t + 1]:
                    end = last[b, t + 1] or t == T - 1
                    rest = value[b, t + 1] if end else returns[b, t + 1]
                    g += GAMMA * ((1 - LAMBDA) * value[b, t + 1] + LAMBDA * rest)
                returns[b, t] = g
        taken = ~last[:, :-1]
        pixels = windows.frames.reshape(L, W, 4)[:, :-1][taken] / 255.0
        self.phi = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
        self.action = windows.action.reshape(L, W)[:, :-1][taken]
        self.extras = windows.extras.reshape(L, W, -1)[:, :-1][taken].astype(np.float64)
        self.returns = returns[taken]
        self.task = windows.task.reshape(L, W)[:, :-1][taken]

    def update(self) -> tuple[np.ndarray, float]:
        """One gradient step; returns the losses of its samples and the norm of its gradient."""
        losses, gradient = self.loss(self, self.w), np.zeros_like(self.w)
        for i in np.ndindex(self.w.shape):
            step = np.zeros_like(self.w)
            step[i] = 1e-6
            gradient[i] = (self.loss(self, self.w + step).mean() - self.loss(self, self.w - step).mean()) / 2e-6
        norm = float(np.linalg.norm(gradient))
        clipped = gradient * min(1.0, 0.25 / norm)
        rate = 0.1 * (1 - self.num_updates / 6)
        self.num_updates += 1
        k = self.num_updates
        self.mean = 0.9 * self.mean + 0.1 * clipped  # Kingma and Ba 2015, Algorithm 1
        self.square = 0.999 * self.square + 0.001 * clipped**2
        self.w = self.w - rate * (self.mean / (1 - 0.9**k)) / (np.sqrt(self.square / (1 - 0.999**k)) + 1e-5)
        self.average = 0.8 * self.average + 0.2 * self.w
        return losses, norm


def ppo_loss(learner: Float64Learner, w: np.ndarray, config: PPOConfig = PPO_.config) -> np.ndarray:
    """Schulman et al. 2017, eq. 7 and 9; normalized advantages and clipped values as in OpenAI's code."""
    outputs = learner.phi @ w.T
    logits, v = outputs[:, :A], outputs[:, A]
    p = np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
    v_old, log_p_old = learner.extras.T
    advantage = learner.returns - v_old
    if config.normalize_advantages:
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    ratio = p[np.arange(len(p)), learner.action] / np.exp(log_p_old)
    surrogate = np.minimum(ratio * advantage, np.clip(ratio, 1 - config.clip, 1 + config.clip) * advantage)
    near = v_old + np.clip(v - v_old, -config.value_clip, config.value_clip)
    squared = np.maximum((v - learner.returns) ** 2, (near - learner.returns) ** 2) / 2
    return -surrogate + config.value_weight * squared + config.entropy_weight * (p * np.log(p)).sum(1)


def pqn_loss(learner: Float64Learner, w: np.ndarray) -> np.ndarray:
    """Gallici et al. 2024, Algorithm 1."""
    q = (learner.phi * w[learner.action]).sum(1)
    return (learner.returns - q) ** 2 / 2


def fresh_state(agent, config=CONFIG) -> LearnerState:
    return jax.jit(lambda key: rollout_step.init(agent, rollout_spec(extras_of(agent)), config, key))(jax.random.key(0))


def extras_of(agent) -> int:
    return 1 if isinstance(agent, PQN) else 2


@cache
def compiled(agent, config=CONFIG):
    return rollout_step.make_update(agent, rollout_spec(extras_of(agent)), config)


@pytest.mark.parametrize(("name", "loss"), [("ppo", ppo_loss), ("pqn", pqn_loss)])
def test_updates_are_those_of_the_equations_in_float64(name: str, loss, tmp_path: Path):
    """Returns with ends and time-outs, steps that nobody took, loss, clipping, Adam, learning rate, metrics."""
    agent = AGENTS[name]
    state, windows = fresh_state(agent), made_up_windows(extras_of(agent))
    assert windows.last.any()
    assert (windows.last & ~windows.terminated).any()
    oracle = Float64Learner(np.asarray(state.params["w"]), windows, loss)
    state = compiled(agent)(state, windows, np.int32(3))
    seen = [oracle.update() for _ in range(3)]
    np.testing.assert_allclose(state.params["w"], oracle.w, rtol=1e-4, atol=2e-5)
    state = compiled(agent)(state, windows, np.int32(2))
    seen += [oracle.update() for _ in range(2)]
    np.testing.assert_allclose(state.params["w"], oracle.w, rtol=1e-4, atol=2e-5)
    np.testing.assert_allclose(state.average_params["w"], oracle.average, rtol=1e-4, atol=2e-5)
    assert np.abs(oracle.average - oracle.w).max() > 0.01, "the average is another thing than the last parameters"
    assert int(state.num_updates) == 5
    norms = [norm for _, norm in seen]
    assert max(norms) > 0.25, "gradients are clipped"
    metrics, state = read_metrics(state, NAMES, tmp_path)
    losses, tasks = np.concatenate([losses for losses, _ in seen]), np.tile(oracle.task, 5)
    wanted = {
        "loss": losses.mean(),
        "grad_norm": np.mean(norms),
        "grad_norm_max": np.max(norms),
        **{f"loss/{task}": losses[tasks == i].mean() for i, task in enumerate(NAMES)},
        **{f"sample_share/{task}": np.mean(tasks == i) for i, task in enumerate(NAMES)},
    }
    for key, value in wanted.items():
        np.testing.assert_allclose(metrics[key], value, rtol=1e-3, atol=1e-5, err_msg=key)
    assert metrics.keys() - wanted.keys() == set(state.metrics.agent)
    assert float(state.metrics.loss) == 0.0


@pytest.mark.parametrize("name", ["adam", "radam"])
def test_both_optimizers_divide_by_their_epsilon_too(name: Literal["adam", "radam"]):
    """Where all gradients are 1, both moments are 1, and an epsilon of 1 halves a step: of RAdam from the sixth on."""
    steps = []
    for eps in (1e-16, 1.0):
        adam = rollout_step.optimizer(replace(CONFIG, optimizer=name, adam_eps=eps, max_grad_norm=None))
        step = one = jnp.ones(())
        state = adam.init(one)
        for _ in range(6):
            step, state = adam.update(one, state)
        steps.append(step)
    np.testing.assert_allclose(steps[1], steps[0] / 2, rtol=1e-4)


def test_settings_of_ppos_loss_are_those_of_its_configuration(tmp_path: Path):
    config = replace(
        PPO_.config, clip=0.1, value_clip=0.3, value_weight=0.7, entropy_weight=0.3, normalize_advantages=False
    )
    agent, windows = LinearPPO(config, SPEC), made_up_windows(2)
    state = fresh_state(agent)
    w = np.asarray(state.params["w"], np.float64)
    metrics, _ = read_metrics(compiled(agent)(state, windows, np.int32(1)), NAMES, tmp_path)
    wanted = ppo_loss(Float64Learner(w, windows, None), w, config).mean()
    np.testing.assert_allclose(metrics["loss"], wanted, rtol=1e-4)


def test_a_minibatch_of_one_step_learns_from_its_advantage(tmp_path: Path):
    """It has no deviation to be divided by. The policy that acted had the same probabilities: the ratio is 1."""
    config = replace(CONFIG, num_minibatches=L * T, max_grad_norm=None)
    agent = LinearPPO(replace(PPO_.config, value_weight=0.0, entropy_weight=0.0, value_clip=None), SPEC)
    assert agent.config.normalize_advantages
    no, state = np.zeros(L * W, bool), fresh_state(agent, config)
    windows = replace(made_up_windows(2), frames=np.zeros((L * W, 4), np.uint8), last=no, terminated=no, first=no)
    log_p = jax.nn.log_softmax(state.params["w"][:A, 4])
    extras = np.stack([np.arange(L * W), np.asarray(log_p)[windows.action]], axis=1).astype(np.float32)
    windows = replace(windows, extras=extras)
    oracle = Float64Learner(np.asarray(state.params["w"]), windows, None)
    metrics, _ = read_metrics(compiled(agent, config)(state, windows, np.int32(1)), NAMES, tmp_path)
    advantages = oracle.returns - oracle.extras[:, 0]
    assert np.abs(advantages).min() > 0.05
    assert np.isclose(-metrics["policy_loss"], advantages, rtol=1e-4).sum() == 1
    p = np.exp(np.asarray(log_p, np.float64))
    wanted = [abs(a) * np.linalg.norm(np.eye(A)[i] - p) for a, i in zip(advantages, oracle.action, strict=True)]
    assert np.isclose(metrics["grad_norm"], wanted, rtol=1e-3).sum() == 1


@pytest.mark.parametrize("name", AGENTS)
def test_metrics_of_agents_are_of_the_steps_that_were_taken(name: str, tmp_path: Path):
    """Those that nobody took would have the largest values: their frames are white, and all weights are positive."""
    agent, windows = AGENTS[name], made_up_windows(extras_of(AGENTS[name]))
    windows = replace(windows, frames=np.where(windows.last[:, None], np.uint8(255), windows.frames // 2))
    state = fresh_state(agent)
    w = np.abs(np.asarray(state.params["w"], np.float64))
    state = replace(state, params=jax.tree.map(jnp.abs, state.params))
    metrics, _ = read_metrics(compiled(agent)(state, windows, np.int32(1)), NAMES, tmp_path)
    oracle = Float64Learner(w, windows, None)
    outputs, taken = oracle.phi @ w.T, (np.arange(len(oracle.phi)), oracle.action)
    if name == "ppo":
        logits, v = outputs[:, :A], outputs[:, A]
        p = np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
        ratio = p[taken] / np.exp(oracle.extras[:, 1])
        wanted = {
            "entropy": -(p * np.log(p)).sum(1).mean(),
            "value_mean": v.mean(),
            "td_error": np.abs(oracle.returns - v).mean(),
            "kl": (ratio - 1 - np.log(ratio)).mean(),
            "clipped_share": (np.abs(ratio - 1) > 0.2).mean(),
        }
    else:
        q = outputs[taken]
        wanted = {"td_error": np.abs(oracle.returns - q).mean(), "q_mean": q.mean(), "q_max": q.max()}
    for key, value in wanted.items():
        np.testing.assert_allclose(metrics[key], value, rtol=1e-4, atol=1e-5, err_msg=key)


def test_samples_are_counted_on_where_float32_no_longer_tells_one_more():
    state = fresh_state(PQN_)
    state = replace(state, metrics=replace(state.metrics, task_samples=jnp.full(2, 2.0**24)))
    state = compiled(PQN_)(state, made_up_windows(1), np.int32(1))
    assert (np.asarray(state.metrics.task_samples) > 2.0**24).all()


@dataclass(frozen=True)
class Counts(LinearPQN):
    """Records which steps it is given: the number that stands in the extras."""

    def losses(self, params, batch):
        number = batch.extras[:, 0]
        return SampleLosses(
            0.0 * number * params["w"][0, 0], {"sum": number, "squares": number**2, "number_max": number}
        )


@pytest.mark.parametrize("num_minibatches", [1, 2, 6])
def test_every_epoch_goes_through_every_step_once(num_minibatches: int, tmp_path: Path):
    agent, config = Counts(PQNConfig(), SPEC), replace(CONFIG, num_minibatches=num_minibatches)
    number = np.arange(L * W, dtype=np.float32)
    no = np.zeros(L * W, bool)
    windows = replace(made_up_windows(1), extras=number[:, None], last=no, terminated=no, first=no)
    state = compiled(agent, config)(fresh_state(agent, config), windows, np.int32(config.updates_per_rollout))
    metrics, state = read_metrics(state, NAMES, tmp_path)
    steps = number.reshape(L, W)[:, :-1]
    assert int(state.num_updates) == 3 * num_minibatches
    np.testing.assert_allclose([metrics["sum"], metrics["squares"]], [steps.mean(), (steps**2).mean()], rtol=1e-6)
    assert metrics["number_max"] == steps.max()


def test_every_epoch_and_every_rollout_has_an_order_of_its_own(tmp_path: Path):
    agent, config = Counts(PQNConfig(), SPEC), replace(CONFIG, num_minibatches=2)
    windows = replace(
        made_up_windows(1), extras=np.arange(L * W, dtype=np.float32)[:, None], last=np.zeros(L * W, bool)
    )

    def learnt(state: LearnerState, num_updates: int) -> float:
        state = compiled(agent, config)(jax.tree.map(jnp.copy, state), windows, np.int32(num_updates))
        return num_updates * read_metrics(state, NAMES, tmp_path)[0]["squares"]

    state = fresh_state(agent, config)
    first, first_epoch, next_too = (learnt(state, num_updates) for num_updates in (1, 2, 3))
    assert abs(first - (next_too - first_epoch)) > 1e-3
    _, later = read_metrics(
        compiled(agent, config)(jax.tree.map(jnp.copy, state), windows, np.int32(2)), NAMES, tmp_path
    )
    assert abs(first - learnt(later, 1)) > 1e-3


def test_a_rollout_in_minibatches_is_learnt_from_in_another_order_each_time():
    agent, config = PQN_, replace(CONFIG, num_minibatches=6)
    ends = []
    for seed in (0, 0, 1):
        state = replace(fresh_state(agent, config), key=jax.random.key(seed))
        ends.append(np.asarray(compiled(agent, config)(state, made_up_windows(1), np.int32(18)).params["w"]))
    np.testing.assert_array_equal(ends[0], ends[1])
    assert np.abs(ends[0] - ends[2]).max() > 1e-6


def test_the_last_rollout_is_learnt_from_until_the_run_has_its_gradient_steps(monkeypatch, tmp_path: Path):
    """4 steps, and 3 for each rollout. Actors then get the last parameters, evaluation their average."""
    parts = OnPolicyParts(agent=PQN_, config=replace(CONFIG, total_updates=4), spec=rollout_spec(1))
    learner = parts.make(jax.random.key(0), NAMES, tmp_path)
    rollout = Rollout(made_up_windows(1), np.zeros(1, np.int64))
    monkeypatch.setattr(learner, "can_update", lambda: True)
    monkeypatch.setattr(learner._rollouts, "take", lambda _: rollout)
    assert [learner.update() for _ in range(3)] == [3, 1, 0]
    state = learner.arrays()["learner"]
    assert int(state.num_updates) == 4
    jax.tree.map(np.testing.assert_array_equal, learner.params, state.average_params)
    np.testing.assert_array_equal(learner.acting_params(), state.params["w"].ravel())
    assert learner.epsilon(25_000) == PQN_.epsilon(25_000) < learner.epsilon(0)


def test_the_state_is_donated():
    state = fresh_state(PQN_)
    compiled(PQN_)(state, made_up_windows(1), np.int32(3))
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(state))


def test_a_loss_that_is_not_finite_changes_nothing_is_saved_and_raised(tmp_path: Path):
    windows = made_up_windows(1)
    reward = windows.reward.copy()
    reward[5] = np.inf
    state = fresh_state(PQN_)
    before = jax.device_get((state.params, state.opt_state))
    state = compiled(PQN_)(state, replace(windows, reward=reward), np.int32(3))
    jax.tree.map(np.testing.assert_array_equal, jax.device_get((state.params, state.opt_state)), before)
    with pytest.raises(NonFiniteError, match=r"update 1: \d+ of 24 losses are NaN or infinite; 3 updates were skipped"):
        read_metrics(state, NAMES, tmp_path)
    with np.load(tmp_path / "nonfinite_batch_1.npz") as saved:
        assert np.isinf(saved["targets.returns"]).any()
        assert saved["obs.frames"].shape == (24, 1, 4, 1)
