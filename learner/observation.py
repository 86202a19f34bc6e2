"""What an agent observes, as one structure for acting, learning and evaluation."""

from dataclasses import dataclass
from typing import no_type_check

import jax
from jaxtyping import Array, Bool, Float, Int, UInt8


@jax.tree_util.register_dataclass
@no_type_check
@dataclass(frozen=True, kw_only=True, slots=True)
class Observation:
    """A batch of observations. What a run does not use has no columns, and so costs nothing.

    `no_type_check`: jax also builds it of shapes alone and with further axes.
    """

    frames: UInt8[Array, "B H W SC"]
    """the last S frames of C channels, oldest first; at an episode's start its first frame repeated"""
    vector: Float[Array, "B V"]
    """the game variables that the agent may see, as the game counts them"""
    actions: Int[Array, "B K"]
    """the last K actions, oldest first; -1 before the episode's first"""
    task: Int[Array, " B"]
    """index into the run's table of tasks"""
    mask: Bool[Array, "B A"] | None = None
    """the actions that the task allows; None where it is all of them"""
