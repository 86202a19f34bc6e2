"""The Q-network: convolutions, then one or two streams of (noisy) dense layers. May import jax, flax, learner.conv.

One module with switches serves every agent. Parameters are float32; activations may be bfloat16; outputs are
float32. Noise is explicit: a layer is noisy only when it is given a key.
"""

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, UInt8

from gvz.errors import ConfigError
from learner.config import AgentConfig, Noisy
from learner.conv import Conv


class NoisyDense(nn.Module):
    """Dense layer y = (b + W x) + (b_noisy * eps_b + (W_noisy * eps_w) x). Source: thesis eq. 4.14.

    Factorized noise is eps_w = f(e_in) f(e_out)^T, eps_b = f(e_out), f(e) = sign(e) sqrt|e|, e ~ N(0, 1); the noisy
    product is then ((x * f(e_in)) W_noisy) * f(e_out), a second matrix product without a noisy copy of the weights,
    and every row of the batch may have noise of its own. Independent noise draws every entry of eps_w, eps_b.

    Source: Fortunato et al. 2018, sections 3 (a) and (b). Differs: sigma starts at `noisy_sigma` in both forms (the
    paper has 0.017 for independent and 0.5 / sqrt(inputs) for factorized noise, 0.009 and 0.022 for this network's
    layers of 3136 and 512 inputs; the thesis's text asks for 0.017), and the means start He-uniform (thesis 4.1.5).

    Attributes:
        features: number of outputs.
        noisy: form of the noise; off makes it a plain dense layer.
        sigma: initial value of every noisy weight and bias.
    """

    features: int
    noisy: Noisy
    sigma: float

    @nn.compact
    def __call__(
        self, x: Float[Array, "B P"], key: PRNGKeyArray | None, *, noise_per_sample: bool = False
    ) -> Float[Array, "B Q"]:
        """Applies the layer.

        Args:
            x: inputs.
            key: draws the noise; None uses the means alone.
            noise_per_sample: a draw for every row (factorized only), else one for the whole batch.
        """
        shape = (x.shape[-1], self.features)
        kernel = self.param("kernel", nn.initializers.he_uniform(), shape).astype(x.dtype)
        bias = self.param("bias", nn.initializers.zeros, shape[1:]).astype(x.dtype)[None]
        y = x @ kernel + bias
        if self.noisy == "off":
            return y
        sigma = nn.initializers.constant(self.sigma)
        kernel_sigma = self.param("kernel_sigma", sigma, shape).astype(x.dtype)
        bias_sigma = self.param("bias_sigma", sigma, shape[1:]).astype(x.dtype)[None]
        if key is None:
            return y
        key_in, key_out = jax.random.split(key)
        if self.noisy == "independent":
            eps_w = jax.random.normal(key_in, shape, x.dtype)
            eps_b = jax.random.normal(key_out, (1, self.features), x.dtype)
            return y + x @ (kernel_sigma * eps_w) + bias_sigma * eps_b
        rows = x.shape[0] if noise_per_sample else 1
        eps_in = _signed_sqrt(jax.random.normal(key_in, (rows, shape[0]), x.dtype))
        eps_out = _signed_sqrt(jax.random.normal(key_out, (rows, shape[1]), x.dtype))
        return y + ((x * eps_in) @ kernel_sigma + bias_sigma) * eps_out


def _signed_sqrt(e: Array) -> Array:
    return jnp.sign(e) * jnp.sqrt(jnp.abs(e))


class QNetwork(nn.Module):
    """Stacked frames (and the task) to logits `[B, A, N]`; N = 1 and the logit is Q(s, a) if not distributional.

    Architecture: thesis 4.1.5 (convolutions, rectifiers, one hidden dense layer), Figure 4.2 and eq. 4.10 (dueling:
    a hidden layer per stream; the advantage's mean is taken off, per atom if distributional, as in Rainbow).

    Attributes:
        config: the agent's configuration; reads the network's fields only.
        num_actions: A.
        num_tasks: length of the one-hot task vector appended to the features if `task_conditioned`.
    """

    config: AgentConfig
    num_actions: int
    num_tasks: int

    @nn.compact
    def __call__(
        self,
        obs: UInt8[Array, "B H W C"],
        task: Int[Array, "B"],
        key: PRNGKeyArray | None = None,
        *,
        noise_per_sample: bool = False,
    ) -> Float[Array, "B A N"]:
        config, dtype = self.config, jnp.dtype(self.config.activation_dtype)
        x = obs.astype(dtype) / 255
        for i, (channels, kernel, stride) in enumerate(
            zip(config.conv_channels, config.conv_kernels, config.conv_strides, strict=True)
        ):
            x = nn.relu(Conv(channels, kernel, stride, config.conv_form, name=f"conv_{i}")(x))
        x = x.reshape(x.shape[0], -1)
        if config.task_conditioned:
            x = jnp.concatenate([x, jax.nn.one_hot(task, self.num_tasks, dtype=dtype)], axis=-1)
        num_atoms = config.num_atoms if config.distributional else 1
        if not config.dueling:
            q = self._stream("q", x, self.num_actions * num_atoms, key, noise_per_sample)
            return q.reshape(-1, self.num_actions, num_atoms).astype(jnp.float32)
        value = self._stream("value", x, num_atoms, key, noise_per_sample)[:, None, :]  # [B, 1, N]
        advantage = self._stream("advantage", x, self.num_actions * num_atoms, key, noise_per_sample)
        advantage = advantage.reshape(-1, self.num_actions, num_atoms)  # [B, A, N]
        return (value + advantage - advantage.mean(axis=1, keepdims=True)).astype(jnp.float32)

    def _stream(self, name: str, x: Array, outputs: int, key: PRNGKeyArray | None, noise_per_sample: bool) -> Array:
        """Hidden layer, rectifier, output layer; each layer's noise has a key of its own."""
        config = self.config
        if key is None:
            keys = (None, None)
        else:
            keys = tuple(jax.random.split(jax.random.fold_in(key, 1 if name == "advantage" else 0)))
        for layer, features, layer_key in zip(("hidden", "output"), (config.hidden_units, outputs), keys, strict=True):
            dense = NoisyDense(features, config.noisy, config.noisy_sigma, name=f"{name}_{layer}")
            x = dense(x, layer_key, noise_per_sample=noise_per_sample)
            x = nn.relu(x) if layer == "hidden" else x
        return x


def check_fits(config: AgentConfig, height: int, width: int) -> None:
    """Follows an image through the convolutions.

    Raises:
        ConfigError: the image becomes smaller than a kernel.
    """
    for i, (kernel, stride) in enumerate(zip(config.conv_kernels, config.conv_strides, strict=True)):
        if min(height, width) < kernel:
            raise ConfigError(
                f"agent.conv_kernels[{i}]: got {kernel}, want at most {min(height, width)}, the size of the "
                f"{height}x{width} image that reaches this layer; use smaller kernels or strides, or larger frames"
            )
        height, width = (height - kernel) // stride + 1, (width - kernel) // stride + 1
