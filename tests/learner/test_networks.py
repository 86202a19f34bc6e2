"""The Q-network: sizes against the thesis, noise against its definition, dueling against eq. 4.10."""

import itertools
from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from learner.agents.base import AgentSpec
from learner.agents.configs.rainbow import RainbowConfig
from learner.agents.rainbow import Rainbow
from learner.networks import NoisyDense, add_noise, draw_noise, initial_logits
from learner.observation import Observation

FLAT = RainbowConfig(double=False, dueling=False, noisy="off", distributional=False)
TINY = replace(
    FLAT, conv_channels=(3,), conv_kernels=(4,), conv_strides=(2,), hidden_units=6, num_atoms=5, noisy_sigma=0.5
)
OBS = (10, 10, 2)


def spec(obs_shape: tuple[int, int, int], num_tasks: int) -> AgentSpec:
    return AgentSpec(obs_shape=obs_shape, num_actions=3, num_tasks=num_tasks, v_min=-1.0, v_max=1.0)


def shapes(
    config: RainbowConfig, obs_shape: tuple[int, int, int] = (84, 84, 12), num_tasks: int = 1
) -> dict[str, dict]:
    params = jax.eval_shape(Rainbow(config, spec(obs_shape, num_tasks)).init, jax.random.key(0))["params"]
    return {layer: {name: leaf.shape for name, leaf in leaves.items()} for layer, leaves in params.items()}


def count(tree: dict[str, dict]) -> int:
    return sum(int(np.prod(shape)) for layer in tree.values() for shape in layer.values())


@cache
def tiny(config: RainbowConfig):
    """A small network: made-up parameters, apply(params, obs, noise=None), an observation of two tasks."""
    rng = np.random.default_rng(0)
    agent = Rainbow(config, spec(OBS, 2))
    frames = jnp.asarray(rng.integers(0, 256, (4, *OBS), dtype=np.uint8))
    shapes = jax.eval_shape(agent.init, jax.random.key(0))
    params = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(0, 0.3, leaf.shape), leaf.dtype), shapes)
    return params, jax.jit(agent.outputs), replace(agent.spec.zeros(4), frames=frames, task=jnp.array([0, 1, 0, 1]))


def of_task(obs: Observation, task: int) -> Observation:
    return replace(obs, task=jnp.full(4, task))


def test_dqn_has_the_thesis_layers():
    # 4.1.5: three convolutions with a falling kernel size, flattened to 7 * 7 * 64, one hidden layer, one output each.
    assert shapes(FLAT) == {
        "conv_0": {"kernel": (8, 8, 12, 32), "bias": (32,)},
        "conv_1": {"kernel": (4, 4, 32, 64), "bias": (64,)},
        "conv_2": {"kernel": (3, 3, 64, 64), "bias": (64,)},
        "q_hidden": {"kernel": (512, 3136), "bias": (512,)},
        "q_output": {"kernel": (3, 512), "bias": (3,)},
    }


@pytest.mark.parametrize(
    ("config", "wanted"),
    [
        (FLAT, 94_368 + 1_606_144 + 1_539),
        (replace(FLAT, hidden_units=4096), 94_368 + 12_849_152 + 12_291),
        (replace(FLAT, dueling=True), 94_368 + 2 * 1_606_144 + 1_539 + 513),
        (replace(FLAT, noisy="factorized"), 94_368 + 2 * (1_606_144 + 1_539)),
        (replace(FLAT, distributional=True), 94_368 + 1_606_144 + 51 * 1_539),
        (RainbowConfig(), 94_368 + 2 * (2 * 1_606_144 + 51 * (1_539 + 513))),
    ],
    ids=["dqn", "hidden 4096", "dueling", "noisy", "distributional", "rainbow"],
)
def test_parameter_counts_are_the_sums_worked_by_hand(config: RainbowConfig, wanted: int):
    # Convolutions have 24,608 + 32,832 + 36,928 = 94,368, the hidden layer 3136 * 512 + 512 = 1,606,144 parameters.
    assert count(shapes(config)) == wanted


def test_task_conditioning_appends_a_one_hot_of_the_task():
    config = replace(TINY, task_conditioned=True)
    assert shapes(config, OBS, num_tasks=2)["q_hidden"]["kernel"] == (6, 4 * 4 * 3 + 2)
    params, apply, obs = tiny(config)
    plain = [apply(params, of_task(obs, z)) for z in (0, 1)]
    assert float(jnp.abs(plain[0] - plain[1]).max()) > 1e-4
    # Without the rows that the one-hot selects, the task makes no difference.
    hidden = params["params"]["q_hidden"]
    deaf = params["params"] | {"q_hidden": hidden | {"kernel": hidden["kernel"].at[:, -2:].set(0.0)}}
    np.testing.assert_array_equal(*[apply({"params": deaf}, of_task(obs, z)) for z in (0, 1)])


def test_without_task_conditioning_the_task_is_ignored():
    params, apply, obs = tiny(TINY)
    np.testing.assert_array_equal(apply(params, of_task(obs, 0)), apply(params, of_task(obs, 1)))


def test_weights_start_he_uniform_and_biases_zero_below_the_output_and_all_sigmas_as_configured():
    config = replace(FLAT, noisy="factorized", noisy_sigma=0.25)
    params = jax.jit(Rainbow(config, spec((84, 84, 12), 1)).init)(jax.random.key(0))
    for name, fan_in in (("conv_0", 768), ("conv_1", 512), ("conv_2", 576), ("q_hidden", 3136)):
        kernel, bound = np.asarray(params["params"][name]["kernel"]), np.sqrt(6 / fan_in)
        assert np.abs(kernel).max() <= bound
        assert abs(kernel.std() / (bound / np.sqrt(3)) - 1) < 0.03, name
        assert not np.any(params["params"][name]["bias"])
    assert not np.any(params["params"]["q_output"]["kernel"])
    for layer, name in itertools.product(("q_hidden", "q_output"), ("kernel_sigma", "bias_sigma")):
        assert (np.asarray(params["params"][layer][name]) == 0.25).all()


@pytest.mark.parametrize(
    ("v_min", "v_max", "mean"),
    [(-6.95, 14.07, 0.0), (-7.48, 60.67, 0.0), (-16.09, 1.0, 0.0), (-2.0, 2.0, 0.0), (-1.0, 1.0, 0.999)],
)
def test_initial_logits_are_the_line_whose_distribution_has_the_mean(v_min: float, v_max: float, mean: float):
    logits, atoms = np.array(initial_logits(v_min, v_max, 51, mean)), np.linspace(v_min, v_max, 51)
    masses = np.exp(logits - logits.max())
    masses /= masses.sum()
    assert masses @ atoms == pytest.approx(mean, abs=1e-9)
    np.testing.assert_allclose(np.diff(logits, 2), 0.0, atol=1e-9)  # no distribution of this mean has more entropy
    assert logits.sum() == pytest.approx(0.0, abs=1e-6)


def test_two_atoms_share_the_mass_by_the_mean():
    low, high = np.exp(initial_logits(-1.0, 3.0, 2, 0.0))
    assert high / (low + high) == pytest.approx(0.25)


def test_dueling_takes_off_the_mean_advantage():
    config = replace(TINY, dueling=True, distributional=True)
    params, apply, obs = tiny(config)
    logits = apply(params, obs)
    assert logits.shape == (4, 3, 5)
    # The mean over actions of V + A - mean A is V: no advantage can change it, and no value a difference of actions.
    p = params["params"]
    louder = p | {"advantage_output": jax.tree.map(lambda w: 3 * w, p["advantage_output"])}
    changed = apply({"params": louder}, obs)
    assert float(jnp.abs(changed - logits).max()) > 0.01
    np.testing.assert_allclose(changed.mean(1), logits.mean(1), rtol=1e-4, atol=1e-5)
    higher = p | {"value_output": p["value_output"] | {"bias": p["value_output"]["bias"] + 2}}
    np.testing.assert_allclose(apply({"params": higher}, obs), logits + 2, rtol=1e-5, atol=1e-5)


def test_pixels_are_scaled_to_one():
    params, apply, obs = tiny(TINY)
    p = jax.tree.map(np.asarray, params["params"])
    # A white image is all ones, and its convolution the kernel's sum at each of 4 x 4 positions.
    features = np.tile(np.maximum(p["conv_0"]["kernel"].sum(axis=(0, 1, 2)) + p["conv_0"]["bias"], 0), 16)
    hidden = np.maximum(p["q_hidden"]["kernel"] @ features + p["q_hidden"]["bias"], 0)
    q = p["q_output"]["kernel"] @ hidden + p["q_output"]["bias"]
    white = replace(obs, frames=jnp.full((4, *OBS), 255, jnp.uint8))
    np.testing.assert_allclose(apply(params, white)[0, :, 0], q, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("noisy", ["factorized", "independent"])
def test_noise_moves_weights_by_sigma_times_epsilon(noisy):
    layer = {
        "kernel": jnp.zeros((200, 300)),
        "bias": jnp.zeros(200),
        "kernel_sigma": jnp.full((200, 300), 2.0),
        "bias_sigma": jnp.full(200, 3.0),
    }
    params = {"params": {"hidden": layer, "other": layer, "conv": {"kernel": jnp.ones((1, 1, 1, 1))}}}
    moved = jax.jit(add_noise, static_argnums=2)(params, jax.random.key(3), noisy)["params"]
    np.testing.assert_array_equal(moved["conv"]["kernel"], params["params"]["conv"]["kernel"])
    eps_w, eps_b = np.asarray(moved["hidden"]["kernel"] / 2.0), np.asarray(moved["hidden"]["bias"] / 3.0)
    others = np.asarray(moved["other"]["kernel"] / 2.0)
    assert abs(np.corrcoef(eps_w.ravel(), others.ravel())[0, 1]) < 0.1, "each layer has noise of its own"
    if noisy == "independent":
        assert np.linalg.matrix_rank(eps_w) == 200
        assert np.abs(np.corrcoef(eps_b, eps_w.T)[0, 1:]).max() < 0.5, "no weight's noise is that of its bias"
        assert abs(eps_w.std() - 1) < 0.02
    else:
        # f(e_out) f(e_in)^T has rank 1, and its bias noise is f(e_out): every column is a multiple of eps_b.
        assert np.linalg.matrix_rank(eps_w) == 1
        f_in = eps_w[0] / eps_b[0]
        np.testing.assert_allclose(eps_w, np.outer(eps_b, f_in), rtol=1e-4, atol=1e-5)
        # E[f(e)^2] = E|e| = sqrt(2 / pi)
        assert abs((f_in**2).mean() - np.sqrt(2 / np.pi)) < 0.1
    assert abs(eps_w.mean()) < 0.1


def test_noise_per_row_is_eq_4_14_row_by_row():
    layer = NoisyDense(7, sigma=0.3)
    x = np.random.default_rng(0).normal(size=(3, 5)).astype(np.float32)
    variables = jax.jit(layer.init)(jax.random.key(1), x)
    noise = np.random.default_rng(1).normal(size=(3, 5 + 7)).astype(np.float32)
    y = jax.jit(layer.apply)(variables, x, noise)
    p = jax.tree.map(np.asarray, variables["params"])
    for row in range(3):
        f_in, f_out = noise[row, :5], noise[row, 5:]
        kernel = p["kernel"] + p["kernel_sigma"] * np.outer(f_out, f_in)
        np.testing.assert_allclose(y[row], kernel @ x[row] + p["bias"] + p["bias_sigma"] * f_out, rtol=1e-4, atol=1e-5)


def test_a_row_of_noise_is_the_noise_that_moves_the_parameters():
    params, apply, obs = tiny(replace(TINY, noisy="factorized", dueling=True))
    key = jax.random.key(0)
    noise = {
        name: jnp.repeat(e, 4, axis=0) for name, e in jax.jit(draw_noise, static_argnums=2)(params, key, 1).items()
    }
    moved = jax.jit(add_noise, static_argnums=2)(params, key, "factorized")
    np.testing.assert_allclose(apply(params, obs, noise), apply(moved, obs), rtol=1e-4, atol=1e-5)


def test_noise_is_different_for_every_key_and_row_and_nothing_without_sigma():
    params, apply, obs = tiny(replace(TINY, noisy="factorized", dueling=True))
    draw = jax.jit(draw_noise, static_argnums=2)
    one, other = draw(params, jax.random.key(0), 4), draw(params, jax.random.key(1), 4)
    assert set(one) == {"value_hidden", "value_output", "advantage_hidden", "advantage_output"}
    drawn = np.concatenate([np.concatenate([np.asarray(e).ravel() for e in noise.values()]) for noise in (one, other)])
    assert len(np.unique(drawn)) == len(drawn)
    quiet = jax.tree_util.tree_map_with_path(lambda path, w: w * ("sigma" not in jax.tree_util.keystr(path)), params)
    np.testing.assert_allclose(apply(quiet, obs, one), apply(params, obs), atol=1e-6)
    assert float(np.abs(np.asarray(apply(params, obs, one)) - apply(params, obs, other)).max()) > 1e-3


@pytest.mark.parametrize("num_rows", [1, 2, 3])
def test_factorized_noise_is_the_signed_root_of_normal_draws(num_rows: int):
    params = {"params": {"layer": {"kernel": jnp.zeros((2, 3)), "kernel_sigma": jnp.zeros((2, 3))}}}
    found = jax.jit(draw_noise, static_argnums=2)(params, jax.random.key(3), num_rows)["layer"]
    e = np.asarray(jax.random.normal(jax.random.key(3), (num_rows, 5)), np.float64)
    np.testing.assert_allclose(found, np.sign(e) * np.sqrt(np.abs(e)), rtol=1e-5)


def test_bfloat16_activations_keep_float32_parameters_and_outputs():
    config = replace(TINY, dueling=True, noisy="factorized", distributional=True)
    params, apply, obs = tiny(config)
    half_params, half_apply, _ = tiny(replace(config, activation_dtype="bfloat16"))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(half_params))
    logits = half_apply(params, obs)
    assert logits.dtype == jnp.float32
    np.testing.assert_allclose(logits, apply(params, obs), atol=0.05)
    assert float(jnp.abs(logits - apply(params, obs)).max()) > 0


def test_large_values_from_bfloat16_activations_are_no_multiples_of_a_sixteenth():
    """A sum in bfloat16 has 8 digits: between 8 and 16 they are 1/16 apart, more than actions are."""
    config = replace(TINY, dueling=False, noisy="off", distributional=False, activation_dtype="bfloat16")
    params, apply, obs = tiny(config)
    params["params"]["q_output"]["bias"] = jnp.full_like(params["params"]["q_output"]["bias"], 12.0)
    values = np.asarray(apply(params, obs))
    assert ((values > 8) & (values < 16)).all()
    assert (values != values.astype(jnp.bfloat16)).mean() > 0.5
