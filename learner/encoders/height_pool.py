"""The layer-normalized encoder, with the mean over the height of its last features."""

from jaxtyping import Array, Float

from learner.config import AgentConfig
from learner.conv import conv_stack


def height_pool(x: Float[Array, "B H W C"], config: AgentConfig) -> Float[Array, "B F"]:
    """Keeps the azimuth of what is seen, which aim needs, and forgets how high it stands; F is w * c.

    Pooling in place of flattening is Impoola's. It gained most in games that are not centred on the agent: where a
    feature is seen mattered little there. Here an enemy's column is the direction to turn, so columns stay apart.

    With layer normalization, though the pooling papers have none: a mean adds up positions, and without normalization
    those of large contrast (a bright wall) would drown the others. It also makes `layer_norm`, this encoder and
    `global_pool` one comparison, in which only the pooling differs.

    Source: Trumpp et al. 2025 (Impoola); Sokar and Castro 2025 (global average pooling in Rainbow and others);
    Gallici et al. 2024 (layer normalization). Pooling over the height alone is ours.
    """
    return conv_stack(x, config, layer_norm=True).mean(axis=1).reshape(x.shape[0], -1)


ENCODER = height_pool
