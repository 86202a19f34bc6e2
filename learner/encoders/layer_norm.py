"""The nature encoder with layer normalization before every rectifier."""

from jaxtyping import Array, Float

from learner.config import AgentConfig
from learner.conv import conv_stack


def layer_norm(x: Float[Array, "B H W C"], config: AgentConfig) -> Float[Array, "B F"]:
    """Every position is normalized over its channels: the form of PQN's published code (pqn_atari.py).

    Source: Gallici et al. 2024 (PQN): with it, bootstrapped and off-policy updates converge without a target network.
    Their dense layer is normalized too; here that one is the caller's.
    """
    return conv_stack(x, config, layer_norm=True).reshape(x.shape[0], -1)


ENCODER = layer_norm
