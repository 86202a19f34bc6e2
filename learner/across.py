"""What a gradient step on several devices asks of the others: sums, means and extremes over their parts of a batch.

Functions that run on one device or on each of several take an `Across`. On one device it does nothing at all, so that
the compiled program is the same as without it.
"""

from dataclasses import dataclass
from typing import TypeVar

import jax
from jaxtyping import PRNGKeyArray

AXIS = "devices"
"""of the mesh (`learner.sharding`)"""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Across:
    """The devices of all processes that do a gradient step together, each with its own part of the batch.

    Its methods take a pytree of arrays and may be called under `shard_map` over `AXIS` alone, if there are several.
    """

    num_devices: int = 1

    @property
    def alone(self) -> bool:
        return self.num_devices == 1

    def mean(self, tree: T) -> T:
        return tree if self.alone else jax.lax.pmean(tree, AXIS)

    def sum(self, tree: T) -> T:
        return tree if self.alone else jax.lax.psum(tree, AXIS)

    def max(self, tree: T) -> T:
        return tree if self.alone else jax.lax.pmax(tree, AXIS)

    def min(self, tree: T) -> T:
        return tree if self.alone else jax.lax.pmin(tree, AXIS)

    def own_key(self, key: PRNGKeyArray) -> PRNGKeyArray:
        """A key of this device alone, made of one that all devices have."""
        return key if self.alone else jax.random.fold_in(key, jax.lax.axis_index(AXIS))


ALONE = Across()
"""one device"""
