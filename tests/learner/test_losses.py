"""Losses against hand-worked numbers, a float64 numpy oracle, rlax, and finite differences."""

from types import ModuleType

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from jax.test_util import check_grads

from learner import losses
from tests.learner import reference


def random_batch(seed: int, B: int = 7, A: int = 4, N: int = 11) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    return {
        "q_tm1": rng.normal(size=(B, A)).astype(np.float32),
        "q_t": rng.normal(size=(B, A)).astype(np.float32),
        "selector": rng.normal(size=(B, A)).astype(np.float32),  # of double Q-learning
        "logits_tm1": rng.normal(size=(B, A, N)).astype(np.float32),
        "logits_t": rng.normal(size=(B, A, N)).astype(np.float32),
        "a_tm1": rng.integers(0, A, B).astype(np.int32),
        "r_t": rng.normal(scale=3, size=B).astype(np.float32),
        "discount_t": (rng.integers(0, 2, B) * 0.99**3).astype(np.float32),
        "atoms": np.linspace(-5, 5, N, dtype=np.float32),
    }


def means(b: dict) -> np.ndarray:
    """Of the distributions at t."""
    return np.asarray(losses.expectation(jax.nn.softmax(b["logits_t"]), b["atoms"]))


# --- Q-learning ---------------------------------------------------------------------------------------------------


def test_q_learning_td_is_the_hand_worked_number():
    # r + gamma max Q' - Q(s, a): 1 + 0.9 * 4 - 2 = 2.6; terminated: -1 + 0 - 5 = -6.
    # A selector that prefers action 1 lets the target value that at -1: 1 + 0.9 * -1 - 2 = -1.9.
    td = losses.q_learning_td(
        q_tm1=jnp.array([[2.0, 7.0], [3.0, 5.0], [2.0, 7.0]]),
        a_tm1=jnp.array([0, 1, 0]),
        r_t=jnp.array([1.0, -1.0, 1.0]),
        discount_t=jnp.array([0.9, 0.0, 0.9]),
        q_t_value=jnp.array([[4.0, -1.0], [100.0, 200.0], [4.0, -1.0]]),
        q_t_selector=jnp.array([[4.0, -1.0], [100.0, 200.0], [0.0, 0.5]]),
    )
    np.testing.assert_allclose(td, [2.6, -6.0, -1.9], rtol=1e-6)


@pytest.mark.parametrize("double", [False, True])
def test_td_equals_the_float64_oracle(double: bool):
    for seed in range(20):
        b = random_batch(seed)
        args = (b["q_tm1"], b["a_tm1"], b["r_t"], b["discount_t"], b["q_t"], b["selector" if double else "q_t"])
        td = losses.q_learning_td(*map(jnp.asarray, args))
        np.testing.assert_allclose(td, reference.td(*args), rtol=1e-5, atol=1e-5)


def test_no_gradient_flows_into_the_td_target():
    b = {name: jnp.asarray(value) for name, value in random_batch(0).items()}

    def loss(q_tm1, q_t):
        return losses.q_learning_td(q_tm1, b["a_tm1"], b["r_t"], b["discount_t"], q_t, q_t).sum()

    into_tm1, into_t = jax.grad(loss, argnums=(0, 1))(b["q_tm1"], b["q_t"])
    assert float(jnp.abs(into_t).max()) == 0.0
    np.testing.assert_array_equal(into_tm1, -jax.nn.one_hot(b["a_tm1"], 4))


def test_huber_is_quadratic_inside_and_linear_outside():
    td = jnp.array([0.0, 0.5, -0.5, 1.0, 3.0, -3.0])
    np.testing.assert_allclose(losses.huber(td), [0.0, 0.125, 0.125, 0.5, 2.5, 2.5], rtol=1e-6)
    slope = jax.vmap(jax.grad(lambda x: losses.huber(x[None])[0]))(td)
    np.testing.assert_allclose(slope, [0.0, 0.5, -0.5, 1.0, 1.0, -1.0], rtol=1e-6)


# --- the categorical distribution ---------------------------------------------------------------------------------


def test_support_is_the_thesis_formula():
    wanted = [-10 + (i - 1) * 20 / 50 for i in range(1, 52)]
    np.testing.assert_allclose(losses.support(-10.0, 10.0, 51), wanted, atol=1e-6)


def test_projection_of_hand_worked_examples():
    atoms = jnp.array([-1.0, 0.0, 1.0])
    # 0.25 lies a quarter of the way from 0 to 1; -3 and 7 clip to the ends; on an atom nothing moves.
    moved = jnp.array([[0.25, 0.25, 0.25], [-3.0, 7.0, 0.0], [-1.0, 0.0, 1.0]])
    p = jnp.array([[0.2, 0.3, 0.5], [0.2, 0.3, 0.5], [0.2, 0.3, 0.5]])
    wanted = [[0.0, 0.75, 0.25], [0.2, 0.5, 0.3], [0.2, 0.3, 0.5]]
    np.testing.assert_allclose(losses.project(moved, p, atoms), wanted, atol=1e-7)


@pytest.mark.isa
@settings(max_examples=60)
@given(
    seed=st.integers(0, 2**31),
    r=st.floats(-30, 30, width=32),
    discount=st.floats(0, 1, width=32),
    low=st.floats(-20, 0, width=32),
    span=st.floats(0.5, 40, width=32),
)
def test_projection_keeps_mass_and_equals_the_oracle(seed: int, r: float, discount: float, low: float, span: float):
    atoms = np.linspace(low, low + span, 21, dtype=np.float32)
    p = np.random.default_rng(seed).dirichlet(np.ones(21)).astype(np.float32)
    moved = r + discount * atoms
    projected = np.asarray(losses.project(jnp.asarray(moved[None]), jnp.asarray(p[None]), jnp.asarray(atoms))[0])
    np.testing.assert_allclose(projected, reference.project(moved, p, atoms), atol=5e-5)
    assert abs(projected.sum() - 1) < 1e-4
    if moved.min() >= low and moved.max() <= low + span:
        assert abs(projected @ atoms - p @ moved) < 1e-3 * span


@pytest.mark.isa
@pytest.mark.parametrize("double", [False, True])
def test_categorical_loss_equals_the_float64_oracle(double: bool):
    for seed in range(20):
        b = random_batch(seed)
        selector = b["selector"] if double else means(b)
        args = (b["logits_tm1"], b["a_tm1"], b["r_t"], b["discount_t"], b["logits_t"], b["atoms"], selector)
        ours = losses.categorical_q_learning(*map(jnp.asarray, args))
        np.testing.assert_allclose(np.stack(ours), reference.categorical(*args), rtol=1e-4, atol=1e-5)


def test_categorical_loss_of_a_terminal_reward_on_an_atom_is_its_negative_log_probability():
    atoms = jnp.array([-1.0, 0.0, 1.0])
    logits = jnp.log(jnp.array([[[0.2, 0.3, 0.5]]]))
    loss, kl = losses.categorical_q_learning(
        logits, jnp.array([0]), jnp.array([1.0]), jnp.array([0.0]), jnp.zeros((1, 1, 3)), atoms, jnp.zeros((1, 1))
    )
    np.testing.assert_allclose(loss, [-np.log(0.5)], rtol=1e-6)
    np.testing.assert_allclose(kl, [-np.log(0.5)], rtol=1e-6)  # a point mass has no entropy


def test_kl_is_zero_for_a_perfect_prediction_while_cross_entropy_is_the_entropy():
    atoms = jnp.array([-1.0, 0.0, 1.0])
    p = jnp.array([0.2, 0.3, 0.5])
    logits = jnp.log(p)[None, None]
    loss, kl = losses.categorical_q_learning(
        logits, jnp.array([0]), jnp.array([0.0]), jnp.array([1.0]), logits, atoms, jnp.zeros((1, 1))
    )
    np.testing.assert_allclose(loss, [-(p * jnp.log(p)).sum()], rtol=1e-6)
    assert float(kl[0]) < 1e-6


def test_cross_entropy_and_kl_have_one_gradient_and_none_into_the_target():
    b = {name: jnp.asarray(value) for name, value in random_batch(3).items()}

    def total(which: int, logits_tm1: jax.Array, logits_t: jax.Array) -> jax.Array:
        rest = (b["a_tm1"], b["r_t"], b["discount_t"])
        selector = losses.expectation(jax.nn.softmax(logits_t), b["atoms"])
        return losses.categorical_q_learning(logits_tm1, *rest, logits_t, b["atoms"], selector)[which].sum()

    grads = [jax.grad(total, argnums=(1, 2))(which, b["logits_tm1"], b["logits_t"]) for which in (0, 1)]
    np.testing.assert_allclose(grads[0][0], grads[1][0], atol=1e-7)
    assert float(jnp.abs(grads[0][1]).max()) == 0.0
    assert float(jnp.abs(grads[0][0]).max()) > 0.0


def test_gradients_equal_finite_differences():
    with jax.enable_x64(True):
        b = random_batch(5)
        b = {name: jnp.asarray(v, jnp.float64 if v.dtype == np.float32 else v.dtype) for name, v in b.items()}
        rest = (b["a_tm1"], b["r_t"], b["discount_t"])

        def td_loss(q):
            return losses.huber(losses.q_learning_td(q, *rest, b["q_t"], b["selector"]))

        def categorical_loss(logits):
            return losses.categorical_q_learning(logits, *rest, b["logits_t"], b["atoms"], b["selector"])[0]

        check_grads(td_loss, (b["q_tm1"],), order=1, modes=["rev"], rtol=1e-6)
        check_grads(categorical_loss, (b["logits_tm1"],), order=1, modes=["rev"], rtol=1e-6)


# --- rlax, an independent public implementation -------------------------------------------------------------------


@pytest.mark.isa
# Importing rlax touches names that jax has deprecated, and rlax points from its own cross-entropy to distrax's.
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore:Rlax:PendingDeprecationWarning")
def test_losses_agree_with_rlax(rlax: ModuleType):
    for seed in range(5):
        b = {name: jnp.asarray(value) for name, value in random_batch(seed).items()}
        rest = (b["a_tm1"], b["r_t"], b["discount_t"])
        atoms = jnp.tile(b["atoms"], (7, 1))
        pairs = {
            "q_learning": (
                losses.q_learning_td(b["q_tm1"], *rest, b["q_t"], b["q_t"]),
                jax.vmap(rlax.q_learning)(b["q_tm1"], *rest, b["q_t"]),
            ),
            "double_q_learning": (
                losses.q_learning_td(b["q_tm1"], *rest, b["q_t"], b["selector"]),
                jax.vmap(rlax.double_q_learning)(b["q_tm1"], *rest, b["q_t"], b["selector"]),
            ),
            "huber": (losses.huber(b["r_t"]), rlax.huber_loss(b["r_t"])),
            "categorical_q_learning": (
                losses.categorical_q_learning(b["logits_tm1"], *rest, b["logits_t"], b["atoms"], means(b))[0],
                jax.vmap(rlax.categorical_q_learning)(atoms, b["logits_tm1"], *rest, atoms, b["logits_t"]),
            ),
            "categorical_double_q_learning": (
                losses.categorical_q_learning(b["logits_tm1"], *rest, b["logits_t"], b["atoms"], b["selector"])[0],
                jax.vmap(rlax.categorical_double_q_learning)(
                    atoms, b["logits_tm1"], *rest, atoms, b["logits_t"], b["selector"]
                ),
            ),
        }
        for name, (ours, theirs) in pairs.items():
            np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-5, err_msg=name)


def test_shapes_that_do_not_belong_together_are_refused():
    b = {name: jnp.asarray(value) for name, value in random_batch(0).items()}
    with pytest.raises(AssertionError, match="equal_shape"):
        losses.q_learning_td(b["q_tm1"], b["a_tm1"], b["r_t"], b["discount_t"], b["q_t"][:, :2], b["q_t"])
    with pytest.raises(AssertionError, match="rank"):
        losses.q_learning_td(b["q_tm1"], b["q_tm1"], b["r_t"], b["discount_t"], b["q_t"], b["q_t"])  # pyright: ignore
