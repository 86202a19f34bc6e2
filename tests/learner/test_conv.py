"""Both forms of the convolution are one function with one set of parameters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from learner.conv import Conv, conv2d
from tests.learner.reference import convolve

# (image, channels, kernel, stride, features): the thesis's three layers, and shapes that do not divide evenly
LAYERS = [
    (84, 12, 8, 4, 32),
    (20, 32, 4, 2, 64),
    (9, 64, 3, 1, 64),
    (43, 3, 5, 3, 6),
    (11, 2, 3, 4, 5),
    (6, 1, 6, 2, 2),
]


def gradients(x: np.ndarray, kernel: np.ndarray, stride: int, g: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the sum of g times `convolve`, into x and into the kernel: one window after the other, in float64."""
    dx, dkernel = np.zeros(x.shape), np.zeros(kernel.shape)
    k = len(kernel)
    for i, j in np.ndindex(*g.shape[1:3]):
        window = np.s_[:, i * stride : i * stride + k, j * stride : j * stride + k]
        dx[window] += np.tensordot(g[:, i, j].astype(np.float64), kernel.astype(np.float64), axes=(1, 3))
        dkernel += np.tensordot(x[window].astype(np.float64), g[:, i, j].astype(np.float64), axes=(0, 0))
    return dx, dkernel


@pytest.mark.parametrize("layer", LAYERS, ids=str)
def test_forms_agree_to_float32_rounding_forward_and_backward(layer: tuple[int, int, int, int, int]):
    size, channels, k, stride, features = layer
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2, size, size, channels)).astype(np.float32)
    kernel = rng.normal(size=(k, k, channels, features)).astype(np.float32)
    wanted = convolve(x, kernel, 0, stride)
    g = rng.normal(size=wanted.shape).astype(np.float32)

    @jax.jit
    def both(x, kernel, g):
        def run(form):
            y, pull = jax.vjp(lambda x, kernel: conv2d(x, kernel, stride, form), x, kernel)
            return y, *pull(g)

        return run("direct"), run("shifted")

    direct, shifted = both(x, kernel, g)
    rounding = 3e-6 * np.sqrt(k * k * channels)
    np.testing.assert_allclose(shifted[0], wanted, atol=rounding * 2, rtol=1e-5)
    for name, a, b in zip(("output", "into x", "into kernel"), direct, shifted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=2e-6 * np.abs(a).max(), err_msg=name)


@settings(max_examples=8)
@given(
    size=st.integers(3, 14),
    k=st.integers(1, 6),
    stride=st.integers(1, 5),
    channels=st.integers(1, 3),
    features=st.integers(1, 8),
)
def test_shifted_and_its_gradients_equal_the_defining_sums(
    size: int, k: int, stride: int, channels: int, features: int
):
    k = min(k, size)
    rng = np.random.default_rng(size * 1000 + k * 100 + stride)
    x = rng.normal(size=(1, size, size + 2, channels)).astype(np.float32)
    kernel = rng.normal(size=(k, k, channels, features)).astype(np.float32)
    wanted = convolve(x, kernel, 0, stride)
    g = rng.normal(size=wanted.shape).astype(np.float32)

    @jax.jit
    def shifted(x, kernel, g):
        y, pull = jax.vjp(lambda x, kernel: conv2d(x, kernel, stride, "shifted"), x, kernel)
        return y, *pull(g)

    y, dx, dkernel = shifted(x, kernel, g)
    np.testing.assert_allclose(y, wanted, atol=1e-4)
    wanted_dx, wanted_dkernel = gradients(x, kernel, stride, g)
    np.testing.assert_allclose(dx, wanted_dx, atol=1e-4)
    np.testing.assert_allclose(dkernel, wanted_dkernel, atol=1e-4)


@pytest.mark.parametrize("num_images", [1, 2, 5, 8])
def test_paired_equals_the_defining_sum_for_any_number_of_images(num_images: int):
    rng = np.random.default_rng(num_images)
    x = rng.normal(size=(num_images, 9, 11, 3)).astype(np.float32)
    kernel = rng.normal(size=(4, 4, 3, 5)).astype(np.float32)
    y = jax.jit(conv2d, static_argnums=(2, 3))(x, kernel, 2, "paired")
    np.testing.assert_allclose(y, convolve(x, kernel, 0, 2), atol=1e-4)


def test_every_form_has_the_same_parameters():
    x = jax.ShapeDtypeStruct((1, 20, 20, 3), jnp.float32)
    forms = ("auto", "direct", "shifted", "paired")
    trees = [jax.eval_shape(Conv(6, 4, 2, form).init, jax.random.key(0), x) for form in forms]
    assert all(tree == trees[0] for tree in trees)
    assert {name: leaf.shape for name, leaf in trees[0]["params"].items()} == {"kernel": (4, 4, 3, 6), "bias": (6,)}


def test_auto_is_shifted_on_a_cpu_and_direct_elsewhere():
    x = jax.ShapeDtypeStruct((1, 20, 20, 3), jnp.float32)
    conv = Conv(6, 4, 2, "auto")
    params = jax.eval_shape(conv.init, jax.random.key(0), x)
    apply = jax.jit(conv.apply)
    for platform, has_convolution in (("cpu", False), ("cuda", True)):
        exported = jax.export.export(apply, platforms=[platform])(params, x)
        assert ("stablehlo.convolution" in exported.mlir_module()) == has_convolution, platform
