"""Returns, advantages and PPO's losses: hand-worked numbers, the forward view in float64, and rlax."""

from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from learner import losses, returns

T, B = 9, 40


def column(*values: float) -> jnp.ndarray:
    return jnp.array(values, jnp.float32)[:, None]


def no(steps: int) -> jnp.ndarray:
    return jnp.zeros((steps, 1), bool)


def rollout(seed: int = 0) -> dict[str, np.ndarray]:
    """Some episodes end, by either way, at any step. Where one goes on, v_t is the next step's v_tm1."""
    rng = np.random.default_rng(seed)
    ends = rng.choice(3, (T, B), p=[0.6, 0.2, 0.2])
    v_tm1, v_t = rng.normal(size=(2, T, B)).astype(np.float32)
    v_t[:-1] = np.where(ends[:-1] == 0, v_tm1[1:], v_t[:-1])
    r_t = rng.normal(size=(T, B)).astype(np.float32)
    return {"r_t": r_t, "v_tm1": v_tm1, "v_t": v_t, "terminated": ends == 1, "truncated": ends == 2}


def episodes(b: dict[str, np.ndarray]):
    """(game, first step, step after the last) of every piece of an episode."""
    for game in range(B):
        first = 0
        for t in range(T):
            if b["terminated"][t, game] or b["truncated"][t, game] or t == T - 1:
                yield game, first, t + 1
                first = t + 1


def forward_view(r, v, terminated: bool, discount: float, lambda_: float) -> float:
    """The weighted mean of all n-step returns of one piece from its first step on (Sutton and Barto 2018, eq. 12.3)."""
    n_step, rewards = [], 0.0
    for n in range(1, len(r) + 1):
        rewards += discount ** (n - 1) * r[n - 1]
        bootstrap = 0.0 if terminated and n == len(r) else v[n - 1]
        n_step.append(rewards + discount**n * bootstrap)
    weights = [(1 - lambda_) * lambda_**n for n in range(len(r) - 1)]
    return float(np.dot([*weights, 1 - sum(weights)], n_step))


# --- lambda returns -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("end", "wanted"),
    [
        # 3 + 30/2 = 18; 2 + (20/2 + 18/2)/2 = 11.5; 1 + (10/2 + 11.5/2)/2 = 6.375
        (None, [6.375, 11.5, 18.0]),
        # the second step ends it for good: 2; 1 + (10/2 + 2/2)/2 = 4
        ("terminated", [4.0, 2.0, 18.0]),
        # or by time-out: 2 + 20/2 = 12; 1 + (10/2 + 12/2)/2 = 6.5
        ("truncated", [6.5, 12.0, 18.0]),
    ],
)
def test_lambda_returns_are_the_hand_worked_numbers(end: str | None, wanted: list[float]):
    ends = {name: no(3).at[1].set(name == end) for name in ("terminated", "truncated")}
    found = returns.lambda_returns(column(1, 2, 3), column(10, 20, 30), **ends, discount=0.5, lambda_=0.5)
    np.testing.assert_allclose(found[:, 0], wanted)


@pytest.mark.parametrize("lambda_", [0.0, 0.65, 1.0])
def test_lambda_returns_are_the_forward_view_of_every_episode(lambda_: float):
    b = rollout()
    found = returns.lambda_returns(b["r_t"], b["v_t"], b["terminated"], b["truncated"], 0.9, lambda_)
    pieces = list(episodes(b))
    assert len(pieces) > 3 * B
    for game, first, after in pieces:
        for t in range(first, after):
            r, v = (b[name][t:after, game].astype(np.float64) for name in ("r_t", "v_t"))
            wanted = forward_view(r, v, b["terminated"][after - 1, game], 0.9, lambda_)
            np.testing.assert_allclose(found[t, game], wanted, rtol=1e-4, atol=1e-5)


def test_no_gradient_flows_into_targets_and_advantages():
    b = rollout()
    ends = (b["terminated"], b["truncated"], 0.9, 0.65)
    assert not jax.grad(lambda v: returns.lambda_returns(b["r_t"], v, *ends).sum())(b["v_t"]).any()
    assert not jax.grad(lambda v: returns.generalized_advantages(b["r_t"], v, v, *ends)[0].sum())(b["v_t"]).any()
    one, constants = jnp.ones(1), (jnp.zeros(1), jnp.full(1, -3.0))
    for loss in (returns.value_loss, returns.clipped_surrogate_loss):
        assert not np.any(jax.grad(lambda x, loss=loss: loss(one, *x, 0.5).sum())(constants))


# --- generalized advantages ---------------------------------------------------------------------------------------


def test_advantages_are_the_hand_worked_numbers():
    # deltas 1 + 4/2 - 2 = 1 and 3 + 6/2 - 4 = 2; 1 + 0.5 * 0.5 * 2 = 1.5
    advantages, targets = returns.generalized_advantages(
        column(1, 3), column(2, 4), column(4, 6), no(2), no(2), discount=0.5, lambda_=0.5
    )
    np.testing.assert_allclose(advantages[:, 0], [1.5, 2.0])
    np.testing.assert_allclose(targets[:, 0], [3.5, 6.0])


# --- PPO ----------------------------------------------------------------------------------------------------------


def test_clipped_surrogate_is_the_hand_worked_number_and_has_no_gradient_where_it_is_clipped():
    log_p, advantages = jnp.log(jnp.array([1.5, 1.5, 0.5, 0.5, 1.1])), jnp.array([2.0, -2.0, 2.0, -2.0, 2.0])

    def loss(log_p):
        return returns.clipped_surrogate_loss(log_p, jnp.zeros(5), advantages, 0.2)

    np.testing.assert_allclose(loss(log_p), [-2.4, 3.0, -1.0, 1.6, -2.2], rtol=1e-6)
    gradient = jax.grad(lambda log_p: loss(log_p).sum())(log_p)
    np.testing.assert_allclose(gradient, [0.0, 3.0, -1.0, 0.0, -2.2], rtol=1e-6)


def test_value_loss_takes_the_larger_of_both_squares_if_it_is_clipped():
    v, target, old = jnp.array([3.0, 3.0]), jnp.array([4.0, 0.0]), jnp.array([1.0, 1.0])
    np.testing.assert_allclose(returns.value_loss(v, target), [0.5, 4.5])
    # v may move from 1 to 1.5: (4 - 1.5)^2 / 2 = 3.125 is larger than 0.5, (0 - 1.5)^2 / 2 smaller than 4.5
    np.testing.assert_allclose(returns.value_loss(v, target, old, clip=0.5), [3.125, 4.5])
    gradient = jax.grad(lambda v: returns.value_loss(v, target, old, clip=0.5).sum())(v)
    np.testing.assert_allclose(gradient, [0.0, 3.0])
    with pytest.raises(ValueError, match=r"value_loss\.v_old: got None, want the values at the time of acting"):
        returns.value_loss(v, target, clip=0.5)


def test_entropy_is_scipys():
    logits = np.random.default_rng(0).normal(scale=3, size=(6, 4)).astype(np.float32)
    wanted = stats.entropy(np.exp(logits.astype(np.float64)), axis=1)
    np.testing.assert_allclose(returns.entropy(jnp.asarray(logits)), wanted, rtol=1e-5)


# --- rlax ---------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore:Rlax:PendingDeprecationWarning")
def test_returns_and_ppo_agree_with_rlax(rlax: ModuleType):
    b = rollout(1)
    discount_t, lambda_t = 0.9 * (1.0 - b["terminated"]), 0.65 * (1.0 - b["truncated"])
    theirs = jax.vmap(rlax.lambda_returns, in_axes=1, out_axes=1)(b["r_t"], discount_t, b["v_t"], lambda_t)
    ours = returns.lambda_returns(b["r_t"], b["v_t"], b["terminated"], b["truncated"], 0.9, 0.65)
    np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5)

    # rlax's advantages know no time-out inside a rollout: they are given one episode at a time.
    ours, _ = returns.generalized_advantages(**b, discount=0.9, lambda_=0.65)
    for game, first, after in list(episodes(b))[:20]:
        values = np.append(b["v_tm1"][first:after, game], b["v_t"][after - 1, game])
        piece = (b["r_t"][first:after, game], discount_t[first:after, game].astype(np.float32), 0.65, values)
        theirs = rlax.truncated_generalized_advantage_estimation(*map(jnp.asarray, piece))
        np.testing.assert_allclose(ours[first:after, game], theirs, rtol=1e-4, atol=1e-5)

    rng = np.random.default_rng(2)
    logits, old = jnp.asarray(rng.normal(size=(2, 50, 3)), jnp.float32)
    actions, advantages = jnp.asarray(rng.integers(0, 3, 50)), jnp.asarray(rng.normal(size=50), jnp.float32)
    log_p, log_p_old = (losses.take_action(jax.nn.log_softmax(x), actions) for x in (logits, old))
    np.testing.assert_allclose(
        returns.clipped_surrogate_loss(log_p, log_p_old, advantages, 0.2).mean(),
        rlax.clipped_surrogate_pg_loss(jnp.exp(log_p - log_p_old), advantages, 0.2),
        rtol=1e-5,
    )
    np.testing.assert_allclose(-returns.entropy(logits).mean(), rlax.entropy_loss(logits, jnp.ones(50)), rtol=1e-5)
