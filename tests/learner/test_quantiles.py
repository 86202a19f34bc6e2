"""Quantile regression and Munchausen targets: hand-worked numbers, float64 loops, rlax, and finite differences."""

from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from learner import losses
from tests.learner import reference

B, A, N, M = 6, 4, 5, 7


def random_batch(seed: int) -> dict[str, jnp.ndarray]:
    rng = np.random.default_rng(seed)
    batch = {
        "z_tm1": rng.normal(size=(B, A, N)),
        "z_t": rng.normal(size=(B, A, M)),
        "fractions": rng.uniform(size=(B, N)),
        "q_tm1": rng.normal(size=(B, A)),
        "selector": rng.normal(size=(B, A)),
        "r_t": rng.normal(scale=3, size=B),
        "discount_t": rng.integers(0, 2, B) * 0.99**3,
    }
    floats = {name: jnp.asarray(value, jnp.float32) for name, value in batch.items()}
    return floats | {"a_tm1": jnp.asarray(rng.integers(0, A, B), jnp.int32)}


def quantile_huber_oracle(z_tm1, fractions, targets, kappa: float) -> np.ndarray:
    z_tm1, fractions, targets = (np.asarray(x, np.float64) for x in (z_tm1, fractions, targets))
    found = np.zeros(len(z_tm1))
    for b in range(len(z_tm1)):
        for z, fraction in zip(z_tm1[b], fractions[b], strict=True):
            for target in targets[b]:
                u = target - z
                size = u**2 / 2 if abs(u) <= kappa else kappa * (abs(u) - kappa / 2)
                found[b] += abs(fraction - (1.0 if u < 0 else 0.0)) * size / kappa / len(targets[b])
    return found


def munchausen_oracle(b, alpha: float, temperature: float, lowest: float) -> np.ndarray:
    b = {name: np.asarray(value, np.float64 if value.dtype == jnp.float32 else None) for name, value in b.items()}
    found = np.zeros((B, b["z_t"].shape[2]))
    for i in range(B):
        pi_tm1 = reference.softmax(b["q_tm1"][i] / temperature)
        pi_t = reference.softmax(b["z_t"][i].mean(axis=1) / temperature)
        bonus = alpha * min(0.0, max(lowest, temperature * np.log(pi_tm1[b["a_tm1"][i]])))
        for j in range(found.shape[1]):
            value = sum(pi_t[a] * (b["z_t"][i, a, j] - temperature * np.log(pi_t[a])) for a in range(A))
            found[i, j] = b["r_t"][i] + bonus + b["discount_t"][i] * value
    return found


# --- quantile regression ------------------------------------------------------------------------------------------


def test_midpoints_are_the_middles_of_equal_shares():
    np.testing.assert_allclose(losses.quantile_midpoints(4), [[0.125, 0.375, 0.625, 0.875]])


def test_quantile_huber_is_the_hand_worked_number():
    # u = 0.5 - 0 and 3 - 0: 0.25 * (0.125 + 2.5) / 2; u = 0.5 - 2 and 3 - 2: (0.25 * 1.0 + 0.75 * 0.5) / 2.
    loss = losses.quantile_huber(jnp.array([[0.0, 2.0]]), jnp.array([[0.25, 0.75]]), jnp.array([[0.5, 3.0]]))
    np.testing.assert_allclose(loss, [0.25 * 2.625 / 2 + 0.625 / 2], rtol=1e-6)


@pytest.mark.parametrize("kappa", [0.3, 1.0, 2.0])
def test_quantile_huber_is_the_float64_oracle(kappa: float):
    for seed in range(5):
        b = random_batch(seed)
        z_tm1, targets = b["z_tm1"][:, 0], 2 * b["z_t"][:, 0]
        for fractions in (b["fractions"], losses.quantile_midpoints(N)):
            wanted = quantile_huber_oracle(z_tm1, np.broadcast_to(fractions, (B, N)), targets, kappa)
            np.testing.assert_allclose(losses.quantile_huber(z_tm1, fractions, targets, kappa), wanted, rtol=1e-5)


def test_descending_the_loss_finds_the_quantiles():
    # Of the numbers 0..99 the quantiles 0.1, 0.5, 0.9 lie where a tenth, half and nine tenths are smaller.
    fractions, targets = jnp.array([[0.1, 0.5, 0.9]]), jnp.arange(100.0)[None]
    slope = jax.grad(lambda z: losses.quantile_huber(z, fractions, targets, 0.01).sum())
    z = jax.lax.fori_loop(0, 3000, lambda _, z: z - slope(z), jnp.full((1, 3), 30.0))
    np.testing.assert_allclose(z[0], [9.5, 49.5, 89.5], atol=1.0)


def test_quantile_target_bootstraps_from_the_chosen_action():
    z_t = jnp.array([[[1.0, 3.0], [2.0, 4.0]], [[5.0, 5.0], [0.0, 0.0]]])
    r_t, discount_t = jnp.array([1.0, 1.0]), jnp.array([0.5, 0.0])
    own, other = z_t.mean(axis=2), jnp.array([[1.0, 0.0], [1.0, 0.0]])
    for selector, wanted in ((own, [[2.0, 3.0], [1.0, 1.0]]), (other, [[1.5, 2.5], [1.0, 1.0]])):
        np.testing.assert_allclose(losses.quantile_target(r_t, discount_t, z_t, selector), wanted)


def test_quantile_loss_equals_finite_differences_and_stops_at_the_target():
    b = random_batch(3)
    with jax.enable_x64(True):
        wide = {name: jnp.asarray(np.asarray(v), jnp.float64) for name, v in b.items() if name != "a_tm1"}
        args = (wide["fractions"], wide["z_t"][:, 0])
        check_grads(lambda z: losses.quantile_huber(z, *args), (wide["z_tm1"][:, 0],), order=1, modes=["rev"])

    def loss(z_t):
        target = losses.quantile_target(b["r_t"], b["discount_t"], z_t, z_t.mean(2))
        munchausen = losses.munchausen_target(z_t.mean(2), b["a_tm1"], b["r_t"], b["discount_t"], z_t, z_t.mean(2))
        return sum(losses.quantile_huber(b["z_tm1"][:, 0], b["fractions"], t).sum() for t in (target, munchausen))

    assert not jax.grad(loss)(b["z_t"]).any()


@pytest.mark.isa
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore:Rlax:PendingDeprecationWarning")
@pytest.mark.parametrize("double", [False, True])
def test_quantile_q_learning_agrees_with_rlax(rlax: ModuleType, double: bool):
    for seed in range(5):
        b = random_batch(seed)
        choice = b["selector"] if double else b["z_t"].mean(2)
        target = losses.quantile_target(b["r_t"], b["discount_t"], b["z_t"], choice)
        ours = losses.quantile_huber(losses.take_action(b["z_tm1"], b["a_tm1"]), b["fractions"], target)
        # Theirs is [quantiles, actions], and the selector is a distribution too: all of its quantiles at its mean.
        selector = jnp.repeat(b["selector"][:, :, None], M, axis=2) if double else b["z_t"]
        theirs = jax.vmap(rlax.quantile_q_learning, in_axes=(0, 0, 0, 0, 0, 0, 0, None))(
            b["z_tm1"].swapaxes(1, 2),
            b["fractions"],
            b["a_tm1"],
            b["r_t"],
            b["discount_t"],
            selector.swapaxes(1, 2),
            b["z_t"].swapaxes(1, 2),
            1.0,
        )
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


# --- Munchausen ---------------------------------------------------------------------------------------------------


def test_munchausen_target_is_the_hand_worked_number():
    # Of two equal actions ln pi = -ln 2, and the soft value of two zeros is ln 2: 1 - ln 2 + 0.5 ln 2.
    zeros = jnp.zeros((1, 2))
    args = (zeros, jnp.array([0]), jnp.array([1.0]), jnp.array([0.5]), zeros[:, :, None], zeros)
    target = losses.munchausen_target(*args, alpha=1.0, temperature=1.0, lowest=-10.0)
    np.testing.assert_allclose(target, [[1 - 0.5 * np.log(2)]], rtol=1e-6)
    clipped = losses.munchausen_target(*args, alpha=0.5, temperature=1.0, lowest=-0.4)
    np.testing.assert_allclose(clipped, [[1 - 0.5 * 0.4 + 0.5 * np.log(2)]], rtol=1e-6)


@pytest.mark.isa
@pytest.mark.parametrize(("alpha", "temperature", "lowest"), [(0.9, 0.03, -1.0), (1.0, 2.0, -10.0), (0.3, 0.5, -0.2)])
def test_munchausen_target_is_the_float64_oracle(alpha: float, temperature: float, lowest: float):
    for seed in range(5):
        b = random_batch(seed)
        args = (b["q_tm1"], b["a_tm1"], b["r_t"], b["discount_t"])
        for z_t in (b["z_t"], b["z_t"][:, :, :1]):  # quantiles, and Munchausen-DQN
            found = losses.munchausen_target(*args, z_t, z_t.mean(2), alpha, temperature, lowest)
            wanted = munchausen_oracle(b | {"z_t": z_t}, alpha, temperature, lowest)
            np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("temperature", [0.03, 2.0])
def test_a_masked_action_changes_nothing_in_munchausens_target(temperature: float):
    """Whatever its value is, the target is that of the same batch without this action."""
    b = random_batch(3)
    args = (jnp.minimum(b["a_tm1"], A - 2), b["r_t"], b["discount_t"])
    fewer_z, fewer_q = b["z_t"][:, :-1], b["q_tm1"][:, :-1]
    wanted = losses.munchausen_target(fewer_q, *args, fewer_z, fewer_z.mean(2), temperature=temperature)
    q_tm1, q_t = (q.at[:, -1].set(-jnp.inf) for q in (b["q_tm1"], b["z_t"].mean(2)))
    found = losses.munchausen_target(q_tm1, *args, b["z_t"].at[:, -1].set(50.0), q_t, temperature=temperature)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)


def test_without_bonus_and_temperature_munchausen_is_quantile_q_learning():
    b = random_batch(0)
    found = losses.munchausen_target(
        b["q_tm1"], b["a_tm1"], b["r_t"], b["discount_t"], b["z_t"], b["z_t"].mean(2), alpha=0.0, temperature=1e-6
    )
    wanted = losses.quantile_target(b["r_t"], b["discount_t"], b["z_t"], b["z_t"].mean(2))
    np.testing.assert_allclose(found, wanted, atol=1e-4)


def test_shapes_that_do_not_belong_together_are_refused():
    b = random_batch(0)
    with pytest.raises(AssertionError, match="equal_shape"):
        losses.quantile_target(b["r_t"], b["discount_t"], b["z_t"], b["selector"][:, :2])
    with pytest.raises(AssertionError, match="equal_shape"):
        losses.munchausen_target(
            b["q_tm1"][:, :2], *(b[name] for name in ("a_tm1", "r_t", "discount_t", "z_t", "q_tm1"))
        )
