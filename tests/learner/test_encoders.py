"""Encoders: the contract for everything discovered, and slow float64 convolutions, pools and norms in numpy."""

from dataclasses import replace
from pathlib import Path

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gvz.core.errors import ConfigError
from gvz.core.registry import discover
from learner.agents.configs.dqn import DQNConfig
from learner.config import AgentConfig
from learner.encoders.base import make_encoder
from tests.learner import reference

NAMES = [name for name, module in discover("learner.encoders").items() if hasattr(module, "ENCODER")]
CONFIG = DQNConfig(conv_channels=(4, 5), conv_kernels=(4, 3), conv_strides=(2, 1), conv_form="direct")
POINTWISE = replace(CONFIG, conv_channels=(6,), conv_kernels=(1,), conv_strides=(1,))
"""every feature sees one pixel, so that moving pixels moves features"""


class Network(nn.Module):
    encoder: str
    config: AgentConfig

    @nn.compact
    def __call__(self, x):
        return make_encoder(self.encoder)(x, self.config)


def images(*shape: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(size=shape).astype(np.float32)


def made_up(network: Network, x: np.ndarray, sd: float = 0.3):
    """Parameters that are all random, biases and scales too."""
    rng = np.random.default_rng(1)
    shapes = jax.eval_shape(network.init, jax.random.key(0), x)
    return jax.tree.map(lambda leaf: jnp.asarray(rng.normal(0, sd, leaf.shape), leaf.dtype), shapes)


def features(name: str, config: AgentConfig, x: np.ndarray) -> np.ndarray:
    network = Network(name, config)
    return np.asarray(jax.jit(network.apply)(made_up(network, x), x))


def in_float64(params):
    return {layer: {k: np.asarray(v, np.float64) for k, v in leaves.items()} for layer, leaves in params.items()}


def test_every_encoder_of_the_package_is_found():
    pooled = {"global_pool", "height_pool", "impala_height_pool", "impoola"}
    assert set(NAMES) == pooled | {"impala", "layer_norm", "nature", "small"}


@pytest.mark.parametrize("name", NAMES)
def test_every_encoder_gives_a_row_of_features_and_learns_in_its_first_layer(name: str):
    network, x = Network(name, CONFIG), images(2, 24, 28, 3)
    params = made_up(network, x)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(params))
    first = next(layer for layer, leaves in params["params"].items() if leaves["kernel"].shape[2] == 3)

    def loss(params, x):
        y = network.apply(params, x)
        assert (y.ndim, y.shape[0], y.dtype) == (2, 2, x.dtype)
        return (jnp.arange(1.0, y.shape[1] + 1)[None] * y**2).sum()

    gradient = jax.jit(jax.grad(loss))(params, x)["params"]
    assert float(jnp.abs(gradient[first]["kernel"]).max()) > 0
    for layer, leaves in gradient.items():
        assert float(jnp.abs(leaves["bias"]).max()) > 0, f"nothing is learned in {layer}"
    jax.eval_shape(loss, params, jnp.asarray(x, jnp.bfloat16))


@pytest.mark.parametrize(
    ("name", "image", "wanted"),
    [
        ("nature", (84, 84), 7 * 7 * 64),
        ("small", (48, 84), 4 * 9 * 32),
        ("layer_norm", (84, 84), 7 * 7 * 64),
        ("height_pool", (48, 84), 7 * 64),
        ("global_pool", (48, 84), 64),
        ("impala", (84, 84), 11 * 11 * 32),
        ("impala", (48, 84), 6 * 11 * 32),
        ("impala_height_pool", (84, 84), 11 * 32),
        ("impoola", (84, 84), 32),
    ],
)
def test_numbers_of_features_are_those_worked_by_hand(name: str, image: tuple[int, int], wanted: int):
    network, x = Network(name, DQNConfig()), jax.ShapeDtypeStruct((3, *image, 12), jnp.float32)
    features, _ = jax.eval_shape(network.init_with_output, jax.random.key(0), x)
    assert features.shape == (3, wanted)


def test_layer_norm_is_the_float64_oracle():
    x = images(2, 13, 15, 3)
    p = in_float64(made_up(Network("layer_norm", CONFIG), x)["params"])
    y = x.astype(np.float64)
    for i, stride in enumerate(CONFIG.conv_strides):
        y = reference.convolve(y, p[f"conv_{i}"]["kernel"], p[f"conv_{i}"]["bias"], stride)
        y = (y - y.mean(-1, keepdims=True)) / np.sqrt(y.var(-1, keepdims=True) + 1e-6)
        y = np.maximum(y * p[f"norm_{i}"]["scale"] + p[f"norm_{i}"]["bias"], 0)
    np.testing.assert_allclose(features("layer_norm", CONFIG, x), y.reshape(2, -1), rtol=1e-4, atol=1e-4)
    pooled = {"height_pool": y.mean(1).reshape(2, -1), "global_pool": y.mean((1, 2))}
    for name, wanted in pooled.items():
        np.testing.assert_allclose(features(name, CONFIG, x), wanted, rtol=1e-4, atol=1e-4, err_msg=name)


@pytest.mark.parametrize(
    ("name", "forgets_height", "forgets_width"),
    [("layer_norm", False, False), ("height_pool", True, False), ("global_pool", True, True)],
)
def test_a_pool_forgets_its_axes_and_no_other(name: str, forgets_height: bool, forgets_width: bool):
    x = images(2, 6, 7, 3)
    rng = np.random.default_rng(4)
    plain = features(name, POINTWISE, x)
    for axis, forgets in ((1, forgets_height), (2, forgets_width)):
        moved = features(name, POINTWISE, np.take(x, rng.permutation(x.shape[axis]), axis))
        assert np.allclose(moved, plain, atol=1e-5) == forgets, f"axis {axis}"


def test_small_has_its_own_sizes_whatever_is_configured():
    x = jax.ShapeDtypeStruct((1, 48, 84, 4), jnp.float32)
    params = jax.eval_shape(Network("small", CONFIG).init, jax.random.key(0), x)["params"]
    assert {name: leaves["kernel"].shape for name, leaves in params.items()} == {
        "conv_0": (8, 8, 4, 16),
        "conv_1": (4, 4, 16, 32),
    }


def padded(x: np.ndarray, value: float) -> np.ndarray:
    return np.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)), constant_values=value)


def max_pool(x: np.ndarray) -> np.ndarray:
    """3x3 by 2, TensorFlow's SAME: an even size is padded at its end only."""
    rows, columns = (-(-n // 2) for n in x.shape[1:3])
    x = padded(x, -np.inf)
    top, left = x.shape[1] % 2 == 0, x.shape[2] % 2 == 0
    out = np.empty((len(x), rows, columns, x.shape[3]))
    for i in range(rows):
        for j in range(columns):
            out[:, i, j] = x[:, 2 * i + top : 2 * i + top + 3, 2 * j + left : 2 * j + left + 3].max((1, 2))
    return out


def impala_oracle(params, x: np.ndarray) -> np.ndarray:
    def conv(name: str, x: np.ndarray) -> np.ndarray:
        return reference.convolve(padded(x, 0.0), params[name]["kernel"], params[name]["bias"], 1)

    for i in range(3):
        x = max_pool(conv(f"stage_{i}_conv", x))
        for j in range(2):
            y = conv(f"stage_{i}_block_{j}_conv_0", np.maximum(x, 0))
            x = x + conv(f"stage_{i}_block_{j}_conv_1", np.maximum(y, 0))
    return np.maximum(x, 0)


@pytest.mark.parametrize("size", [(12, 9), (11, 16)], ids=str)
def test_impala_is_the_float64_oracle(size: tuple[int, int]):
    x = images(2, *size, 3)
    network = Network("impala", CONFIG)
    params = made_up(network, x, sd=0.1)
    wanted = impala_oracle(in_float64(params["params"]), x.astype(np.float64))
    assert wanted.shape == (2, -(-size[0] // 8), -(-size[1] // 8), 32)
    tolerance = {"rtol": 1e-4, "atol": 1e-4 * np.abs(wanted).max()}
    np.testing.assert_allclose(jax.jit(network.apply)(params, x), wanted.reshape(2, -1), **tolerance)
    for name, pooled in (("impala_height_pool", wanted.mean(1).reshape(2, -1)), ("impoola", wanted.mean((1, 2)))):
        np.testing.assert_allclose(Network(name, CONFIG).apply(params, x), pooled, **tolerance, err_msg=name)


@pytest.mark.parametrize("name", ["nature", "layer_norm", "height_pool", "global_pool"])
def test_frames_too_small_for_the_configured_kernels_are_refused(name: str):
    x = jax.ShapeDtypeStruct((1, 35, 36, 4), jnp.float32)
    with pytest.raises(ConfigError, match=r"agent\.conv_kernels\[2\]: got 3, want at most 2, .* 2x3 image"):
        jax.eval_shape(Network(name, DQNConfig()).init, jax.random.key(0), x)


def test_frames_too_small_for_the_small_encoder_are_refused():
    x = jax.ShapeDtypeStruct((1, 19, 84, 4), jnp.float32)
    with pytest.raises(ConfigError, match=r"encoder small: kernels\[1\]: got 4, want at most 3, .* 3x20 image"):
        jax.eval_shape(Network("small", CONFIG).init, jax.random.key(0), x)


def test_an_encoder_is_found_by_its_path(tmp_path: Path):
    file = tmp_path / "corner.py"
    file.write_text("def corner(x, config):\n    return x[:, 0, 0]\n\n\nENCODER = corner\n")
    assert make_encoder(str(file)) is make_encoder(str(file))
    np.testing.assert_array_equal(Network(str(file), CONFIG).apply({}, images(2, 3, 4, 5)), images(2, 3, 4, 5)[:, 0, 0])


def test_an_unknown_encoder_is_refused_with_the_nearest():
    with pytest.raises(ConfigError, match=r"agent\.encoder: got 'natur' \(did you mean 'nature'\?\), want one of "):
        make_encoder("natur")
