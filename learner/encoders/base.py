"""What an encoder is: a function from images to features. Its layers become layers of the network that calls it.

A further encoder is one file that sets `ENCODER` to such a function. Beside this file its name is its file name;
anywhere else, its path.
"""

from typing import Protocol

from jaxtyping import Array, Float

from gvz.core.registry import find
from learner.config import AgentConfig


class Encoder(Protocol):
    """Called inside a flax `@nn.compact` method; the layers that it makes have the names that it gives them."""

    def __call__(self, x: Float[Array, "B H W C"], config: AgentConfig) -> Float[Array, "B F"]:
        """Features of images whose pixels are 0..1, in the images' dtype.

        Raises:
            ConfigError: the images are too small. Shapes are known when the network is traced, so it comes then.
        """
        ...


def make_encoder(name: str) -> Encoder:
    """The encoder that `name` names: a module in learner/encoders, or the path of a Python file.

    Raises:
        ConfigError: there is none; names those there are, and the nearest.
    """
    return find("learner.encoders", "ENCODER", name, "agent.encoder", "x", "config")
