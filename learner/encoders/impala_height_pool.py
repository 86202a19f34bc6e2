"""IMPALA's residual network, with the mean over the height of its last features: for a GPU."""

from jaxtyping import Array, Float

from learner.config import AgentConfig
from learner.encoders.impala import residual_stack


def impala_height_pool(x: Float[Array, "B H W C"], config: AgentConfig) -> Float[Array, "B F"]:
    """F is w * 32. Why the height alone is pooled: `height_pool`."""
    return residual_stack(x, config).mean(axis=1).reshape(x.shape[0], -1)


ENCODER = impala_height_pool
