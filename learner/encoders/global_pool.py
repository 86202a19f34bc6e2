"""The layer-normalized encoder, with the mean over all positions of its last features."""

from jaxtyping import Array, Float

from learner.config import AgentConfig
from learner.conv import conv_stack


def global_pool(x: Float[Array, "B H W C"], config: AgentConfig) -> Float[Array, "B F"]:
    """F is c of the last convolution: what is seen, not where.

    Source: Trumpp et al. 2025 (Impoola), on the nature encoder; layer normalization as in `height_pool`.
    """
    return conv_stack(x, config, layer_norm=True).mean(axis=(1, 2))


ENCODER = global_pool
