"""Two convolutions of fixed sizes, then all features side by side: for a CPU."""

from dataclasses import replace

from jaxtyping import Array, Float

from learner.config import AgentConfig
from learner.conv import conv_stack


def small(x: Float[Array, "B H W C"], config: AgentConfig) -> Float[Array, "B F"]:
    """16 and 32 channels; F is h * w * 32. Source: Mnih et al. 2013, section 4.1, without its dense layer."""
    config = replace(config, conv_channels=(16, 32), conv_kernels=(8, 4), conv_strides=(4, 2))
    return conv_stack(x, config, where="encoder small: kernels").reshape(x.shape[0], -1)


ENCODER = small
