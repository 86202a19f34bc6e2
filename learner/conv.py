"""Valid strided convolution in three forms with the same parameters, and stacks of it.

XLA's own convolution, `direct`, is right on a GPU. To learn on a CPU, the few large matrix products of `shifted` are
much faster, above all for the first layer (few input channels, large kernel, large stride). To act on one core,
`paired` is: direct, but two images at a time, so that they stay in its cache.
"""

from functools import partial
from typing import Literal

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from gvz.core.errors import ConfigError
from learner.config import AgentConfig, ConvForm


def conv2d(
    x: Float[Array, "B H W C"],
    kernel: Float[Array, "k k C F"],
    stride: int,
    form: Literal["direct", "shifted", "paired"],
) -> Float[Array, "B h w F"]:
    """Convolution without padding; h = (H - k) // stride + 1."""
    if form == "shifted":
        return _shifted(x, kernel, stride)
    if form == "paired" and len(x) > 2:
        return jax.lax.map(lambda image: conv2d(image[None], kernel, stride, "direct")[0], x, batch_size=2)
    return jax.lax.conv_general_dilated(
        x, kernel, (stride, stride), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


def _shifted(x: Array, kernel: Array, stride: int) -> Array:
    """One matrix product, with the k x k window's sum done by shifts before or after it.

    With s = stride and q = ceil(k / s), the image becomes a grid of s x s blocks (s*s*C channels), the kernel a q x q
    kernel of stride 1 over blocks. What is moved by the q * q shifts is whichever is smaller: outputs (project every
    block onto q*q*F outputs, then add up shifted parts) or inputs (put q*q shifted blocks side by side, then project).
    """
    b, height, width, c = x.shape
    k, _, _, f = kernel.shape
    s, q = stride, -(-k // stride)
    out_h, out_w = (height - k) // s + 1, (width - k) // s + 1
    grid_h, grid_w = out_h + q - 1, out_w + q - 1
    pad_h, pad_w = max(0, grid_h * s - height), max(0, grid_w * s - width)
    x = jnp.pad(x[:, : grid_h * s, : grid_w * s], ((0, 0), (0, pad_h), (0, pad_w), (0, 0)))
    x = x.reshape(b, grid_h, s, grid_w, s * c).swapaxes(2, 3).reshape(b, grid_h, grid_w, s * s * c)
    kernel = jnp.pad(kernel, ((0, q * s - k), (0, q * s - k), (0, 0), (0, 0)))
    kernel = kernel.reshape(q, s, q, s, c, f).transpose(1, 3, 4, 0, 2, 5).reshape(s * s * c, q, q, f)
    if f < s * s * c:
        return _project(x, kernel, out_h, out_w)
    windows = jnp.stack([x[:, i : i + out_h, j : j + out_w] for i, j in _shifts(kernel)], axis=-1)
    return jnp.einsum("bhwcq,cqf->bhwf", windows, kernel.reshape(s * s * c, q * q, f))


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _project(x: Array, kernel: Array, out_h: int, out_w: int) -> Array:
    """Blocks [b grid_h grid_w c] on outputs [b out_h out_w f], by a kernel [c q q f]: products, then sums of shifts.

    JAX's own gradient first adds up q * q padded arrays and transposes them, which takes more time than the products.
    """
    parts = jnp.einsum("bhwc,cijf->bhwijf", x, kernel)
    return sum(parts[:, i : i + out_h, j : j + out_w, i, j] for i, j in _shifts(kernel))  # pyright: ignore


def _shifts(kernel: Array) -> list[tuple[int, int]]:
    _, q, _, _ = kernel.shape
    return [(i, j) for i in range(q) for j in range(q)]


def _project_forward(x: Array, kernel: Array, out_h: int, out_w: int) -> tuple[Array, tuple[Array, Array]]:
    return _project(x, kernel, out_h, out_w), (x, kernel)


def _project_backward(out_h: int, out_w: int, saved: tuple[Array, Array], dy: Array) -> tuple[Array, Array]:
    """Gradients of x and the kernel: those of the shifted outputs are side by side, not added up."""
    x, kernel = saved
    _, grid_h, grid_w, c = x.shape
    around = [((0, 0), (i, grid_h - out_h - i), (j, grid_w - out_w - j), (0, 0)) for i, j in _shifts(kernel)]
    dparts = jnp.concatenate([jnp.pad(dy, pads) for pads in around], axis=-1)
    dkernel = jnp.einsum("bhwc,bhwp->cp", x, dparts).reshape(kernel.shape)
    return jnp.einsum("bhwp,cp->bhwc", dparts, kernel.reshape(c, -1)), dkernel


_project.defvjp(_project_forward, _project_backward)


class Conv(nn.Module):
    """Convolution with bias, He-uniform kernel `[k, k, C, F]` whatever the form, so checkpoints fit all forms.

    Attributes:
        features: output channels F.
        kernel_size: k.
        stride: stride, pixels.
        form: how it is computed; auto is shifted on a CPU and direct elsewhere.
    """

    features: int
    kernel_size: int
    stride: int
    form: ConvForm = "auto"

    @nn.compact
    def __call__(self, x: Float[Array, "B H W C"]) -> Float[Array, "B h w F"]:
        k = self.kernel_size
        kernel = self.param("kernel", nn.initializers.he_uniform(), (k, k, x.shape[-1], self.features))
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        kernel, bias = kernel.astype(x.dtype), bias.astype(x.dtype)[None, None, None]
        if self.form != "auto":
            return conv2d(x, kernel, self.stride, self.form) + bias
        y = jax.lax.platform_dependent(
            x,
            kernel,
            cpu=lambda x, w: conv2d(x, w, self.stride, "shifted"),
            default=lambda x, w: conv2d(x, w, self.stride, "direct"),
        )
        return y + bias


def conv_stack(
    x: Float[Array, "B H W C"], config: AgentConfig, *, layer_norm: bool = False, where: str = "agent.conv_kernels"
) -> Float[Array, "B h w F"]:
    """The configured convolutions conv_0, conv_1, ..., a rectifier after each. Call it in an `@nn.compact` method.

    Args:
        x: images.
        config: reads conv_channels, conv_kernels, conv_strides and conv_form.
        layer_norm: normalize every position over its channels before the rectifier, in layers norm_0, norm_1, ...
        where: what the kernels are called in the error.

    Raises:
        ConfigError: an image becomes smaller than a kernel.
    """
    layers = zip(config.conv_channels, config.conv_kernels, config.conv_strides, strict=True)
    for i, (features, kernel, stride) in enumerate(layers):
        height, width = x.shape[1:3]
        if min(height, width) < kernel:
            raise ConfigError(
                f"{where}[{i}]: got {kernel}, want at most {min(height, width)}, the size of the "
                f"{height}x{width} image that reaches this layer; use smaller kernels or strides, or larger frames"
            )
        x = Conv(features, kernel, stride, config.conv_form, name=f"conv_{i}")(x)
        if layer_norm:
            x = nn.LayerNorm(dtype=x.dtype, name=f"norm_{i}")(x)
        x = nn.relu(x)
    return x
