"""Convolutions and rectifiers as configured, then all features side by side: the thesis's network."""

from jaxtyping import Array, Float

from learner.config import AgentConfig
from learner.conv import conv_stack


def nature(x: Float[Array, "B H W C"], config: AgentConfig) -> Float[Array, "B F"]:
    """F is h * w * c of the last convolution. Source: Mnih et al. 2015, Methods; thesis 4.1.5."""
    return conv_stack(x, config).reshape(x.shape[0], -1)


ENCODER = nature
