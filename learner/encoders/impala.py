"""IMPALA's residual network: for a GPU. Its max-pooling and 3x3 convolutions at full size are slow on a CPU."""

import flax.linen as nn
import jax.numpy as jnp
from jaxtyping import Array, Float

from learner.config import AgentConfig
from learner.conv import Conv


def impala(x: Float[Array, "B H W C"], config: AgentConfig) -> Float[Array, "B F"]:
    """All features side by side; F is h * w * 32 with h = H / 8 and w = W / 8, rounded up."""
    return residual_stack(x, config).reshape(x.shape[0], -1)


def residual_stack(x: Float[Array, "B H W C"], config: AgentConfig) -> Float[Array, "B h w 32"]:
    """Three stages of 16, 32 and 32 channels: convolution, max-pooling by 2, two residual blocks. Then a rectifier.

    The dense layer that follows in the paper is the caller's hidden layer. `config` gives the convolutions' form only.

    Source: Espeholt et al. 2018, Figure 3, right. Differs: kernels start He-uniform.
    """
    for i, features in enumerate((16, 32, 32)):
        x = _conv(x, features, config, f"stage_{i}_conv")
        x = nn.max_pool(x, (3, 3), (2, 2), "SAME")
        for j in range(2):
            y = _conv(nn.relu(x), features, config, f"stage_{i}_block_{j}_conv_0")
            x = x + _conv(nn.relu(y), features, config, f"stage_{i}_block_{j}_conv_1")
    return nn.relu(x)


def _conv(x: Array, features: int, config: AgentConfig, name: str) -> Array:
    """3x3 convolution that keeps height and width."""
    padded = jnp.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    return Conv(features, 3, 1, config.conv_form, name=name)(padded)


ENCODER = impala
