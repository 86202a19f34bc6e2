"""IMPALA's residual network, with the mean over all positions of its last features: for a GPU."""

from jaxtyping import Array, Float

from learner.config import AgentConfig
from learner.encoders.impala import residual_stack


def impoola(x: Float[Array, "B H W C"], config: AgentConfig) -> Float[Array, "B 32"]:
    """Source: Trumpp et al. 2025 (Impoola)."""
    return residual_stack(x, config).mean(axis=(1, 2))


ENCODER = impoola
