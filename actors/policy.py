"""What chooses actions in an actor: the learner's exported acting function, or chance."""

import itertools
import math
from typing import Protocol

import numpy as np

from gvz.transport.messages import ParamsHeader

_CALLS_PER_BLOCK = 256


class Policy(Protocol):
    """Chooses an action for every game of an actor in one call."""

    num_calls: int
    """acting steps so far; with the seed it determines every random choice"""

    def set_params(self, params: np.ndarray, header: ParamsHeader) -> None:
        """Acts by `params` float32[P] from now on, which nobody may change any more."""
        ...

    def act(self, obs: np.ndarray, task: np.ndarray, /) -> np.ndarray:
        """obs uint8[B, H, W, stack_size * C], task int32[B] -> action int32[B]."""
        ...


class RandomPolicy:
    """Uniformly random actions, drawn for many calls at once: to make a generator costs more than to use it."""

    def __init__(self, num_actions: int, batch_size: int, seed: int):
        self.num_calls = 0
        self._num_actions = num_actions
        self._seed = seed
        self._block = -1
        self._actions = np.empty((_CALLS_PER_BLOCK, batch_size), np.int32)

    def set_params(self, params: np.ndarray, header: ParamsHeader) -> None:
        """Chance has no parameters."""

    def act(self, _obs: np.ndarray, _task: np.ndarray, /) -> np.ndarray:
        block, call = divmod(self.num_calls, _CALLS_PER_BLOCK)
        if block != self._block:
            rng = np.random.default_rng((self._seed, block))
            self._actions = rng.integers(self._num_actions, size=self._actions.shape, dtype=np.int32)
            self._block = block
        self.num_calls += 1
        return self._actions[call]


class ExportedPolicy:
    """An acting function that was serialized with `jax.export` for a CPU.

    Its signature is f(params list of f32 leaves, obs u8[B,H,W,stack*C], task i32[B], key u32[2], epsilon f32[])
    -> i32[B]. The leaves are cut from the flat vector in order. The key of a call is the seed's key folded with the
    number of calls.

    Raises:
        ValueError: the function is for other parameters or other observations.
    """

    def __init__(self, serialized: bytes, num_params: int, obs_shape: tuple[int, int, int, int], seed: int):
        import jax
        import jax.export

        exported = jax.export.deserialize(bytearray(serialized))
        self._shapes = [aval.shape for aval in exported.in_avals[:-4]]
        self._ends = list(itertools.accumulate(math.prod(shape) for shape in self._shapes))
        if self._ends[-1] != num_params:
            raise ValueError(f"acting function: it takes {self._ends[-1]} parameters, want {num_params}")
        self._jax = jax
        self._cpu = jax.devices("cpu")[0]
        self._seed_key = jax.device_put(np.array(jax.random.PRNGKey(seed)), self._cpu)
        self._act = jax.jit(
            lambda params, obs, task, key, num_calls, epsilon: exported.call(
                params, obs, task, jax.random.fold_in(key, num_calls), epsilon
            )
        )
        self.num_calls = 0
        # compiles now, and shows now whether the function fits this actor's games
        self.set_params(np.zeros(num_params, np.float32), ParamsHeader(version=0, num_updates=0))
        self.act(np.zeros(obs_shape, np.uint8), np.zeros(obs_shape[0], np.int32))
        self.num_calls = 0

    def set_params(self, params: np.ndarray, header: ParamsHeader) -> None:
        leaves = np.split(params, self._ends[:-1])
        leaves = [leaf.reshape(shape) for leaf, shape in zip(leaves, self._shapes, strict=True)]
        self._params = self._jax.device_put(leaves, self._cpu)
        self._epsilon = self._jax.device_put(np.float32(header.epsilon), self._cpu)

    def act(self, obs: np.ndarray, task: np.ndarray, /) -> np.ndarray:
        num_calls = np.uint32(self.num_calls % 2**32)
        action = np.asarray(self._act(self._params, obs, task, self._seed_key, num_calls, self._epsilon))
        self.num_calls += 1
        return action


def make_policy(
    serialized: bytes, *, num_actions: int, num_params: int, obs_shape: tuple[int, int, int, int], seed: int
) -> Policy:
    """The policy of an actor: the exported function, or chance if `serialized` is empty.

    Args:
        serialized: bytes of `jax.export.Exported.serialize()`.
        num_actions: number of actions.
        num_params: length of the flat parameter vector.
        obs_shape: (B, H, W, stack_size * C).
        seed: 31-bit seed of every choice.
    """
    if not serialized:
        return RandomPolicy(num_actions, obs_shape[0], seed)
    return ExportedPolicy(serialized, num_params, obs_shape, seed)
