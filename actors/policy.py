"""What chooses actions: the learner's exported acting function, chance, or the learner's process that is asked."""

import itertools
import math
from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np

from gvz.transport.inference import RequestWriter
from gvz.transport.messages import ParamsHeader

_CALLS_PER_BLOCK = 256


class Policy(Protocol):
    """Chooses the actions of a batch of games."""

    num_calls: int
    """acting steps so far"""
    params_version: int
    """of the parameters that chose the last actions"""

    def set_params(self, params: Any, header: ParamsHeader) -> None:
        """Acts by `params` float32[P] from now on, which nobody may change any more."""
        ...

    def act(self, obs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The arrays of an `ObservationBatch` -> (action int32[B], extras float32[B, E])."""
        ...


class RandomPolicy:
    """Uniformly random actions among the allowed, drawn for many calls at once: making a generator is slow.

    Attributes:
        num_calls: acting steps so far; with the seed it determines every random choice.
    """

    def __init__(self, num_actions: int, batch_size: int, seed: int):
        self.num_calls, self.params_version = 0, 0
        self._num_actions = num_actions
        self._seed = seed
        self._block = -1
        self._draws = np.empty((_CALLS_PER_BLOCK, batch_size), np.int32)
        self._extras = np.empty((batch_size, 0), np.float32)

    def set_params(self, params: np.ndarray, header: ParamsHeader) -> None:
        """Ignored: random play has no parameters."""

    def act(self, obs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The arrays of an `ObservationBatch` -> (action int32[B], extras float32[B, 0])."""
        block, call = divmod(self.num_calls, _CALLS_PER_BLOCK)
        if block != self._block:
            rng = np.random.default_rng((self._seed, block))
            if "mask" in obs:  # below a multiple of every number of allowed actions: none is drawn more often
                self._draws = rng.integers(math.lcm(*range(1, self._num_actions + 1)), size=self._draws.shape)
            else:
                self._draws = rng.integers(self._num_actions, size=self._draws.shape, dtype=np.int32)
            self._block = block
        self.num_calls += 1
        actions = self._draws[call]
        if "mask" in obs:
            allowed_first = np.argsort(~obs["mask"], axis=1, kind="stable")
            chosen = actions % obs["mask"].sum(axis=1)
            actions = allowed_first[np.arange(len(chosen)), chosen]
        return actions.astype(np.int32), self._extras


class ExportedPolicy:
    """An acting function that was serialized with `jax.export` for a CPU (`learner.export.export_policy`).

    The leaves of its parameters are cut from the flat vector in order. The key of a call is the seed's key folded with
    the number of calls, which is the attribute `num_calls`. With a `fold`, what it makes of the leaves is acted by for
    a stretch of calls. Its key is that of the stretch's first call, so a run that is resumed within a stretch goes on
    with the same noise.

    Args:
        serialized: the acting function.
        num_params: P.
        obs: arrays of observations, with valid values.
        seed: 31 bits.
        fold: a function that was serialized likewise (`learner.export.export_fold`); empty: none.
        fold_period_steps: calls in a stretch.

    Raises:
        ValueError: the function is for other parameters or other observations.
    """

    def __init__(
        self,
        serialized: bytes,
        num_params: int,
        obs: Mapping[str, np.ndarray],
        seed: int,
        fold: bytes = b"",
        fold_period_steps: int = 1,
    ):
        import jax
        import jax.export

        exported = jax.export.deserialize(bytearray(serialized))
        folding = jax.export.deserialize(bytearray(fold)) if fold else None
        first = exported if folding is None else folding
        arguments, _ = jax.tree.unflatten(first.in_tree, first.in_avals)
        self._shapes = [aval.shape for aval in arguments[0]]
        self._ends = list(itertools.accumulate(math.prod(shape) for shape in self._shapes))
        if self._ends[-1] != num_params:
            raise ValueError(f"acting function: it takes {self._ends[-1]} parameters, want {num_params}")
        self._jax = jax
        self._cpu = jax.devices("cpu")[0]
        # that of the functions, whatever JAX_DEFAULT_PRNG_IMPL says
        self._seed_key = jax.device_put(jax.random.key(seed, impl="threefry2x32"), self._cpu)

        def key_data(key: Any, num_calls: Any) -> Any:
            return jax.random.key_data(jax.random.fold_in(key, num_calls))

        self._act = jax.jit(
            lambda params, obs, key, num_calls, epsilon: exported.call(params, obs, key_data(key, num_calls), epsilon)
        )
        self._fold = self._folded = self._folded_at = None
        self._fold_period_steps = fold_period_steps
        if folding is not None:
            self._fold = jax.jit(lambda params, key, num_calls: folding.call(params, key_data(key, num_calls)))
        self.num_calls = 0
        # compiles now, and shows now whether the function fits this actor's games
        self.set_params(np.zeros(num_params, np.float32), ParamsHeader(version=0, num_updates=0))
        self.act(obs)
        self.num_calls = 0

    def set_params(self, params: np.ndarray, header: ParamsHeader) -> None:
        self.params_version = header.version
        leaves = np.split(params, self._ends[:-1])
        leaves = [leaf.reshape(shape) for leaf, shape in zip(leaves, self._shapes, strict=True)]
        self._params, self._folded_at = self._jax.device_put(leaves, self._cpu), None
        self._epsilon = self._jax.device_put(np.float32(header.epsilon), self._cpu)

    def act(self, obs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        num_calls = np.uint32(self.num_calls % 2**32)
        action, extras = self._act(self._acting_params(), dict(obs), self._seed_key, num_calls, self._epsilon)
        self.num_calls += 1
        return np.asarray(action), np.asarray(extras)

    def _acting_params(self) -> Any:
        """The leaves that the acting function takes; folded once for a stretch, and for new parameters."""
        if self._fold is None:
            return self._params
        first = self.num_calls // self._fold_period_steps * self._fold_period_steps
        if first != self._folded_at:
            self._folded = self._fold(self._params, self._seed_key, np.uint32(first % 2**32))
            self._folded_at = first
        return self._folded


class AskedPolicy:
    """What the learner's process has chosen. `RequestWriter.wait` comes before each call of `act`.

    Attributes:
        num_calls, params_version: as of every policy.
    """

    def __init__(self, requests: RequestWriter):
        self.num_calls, self.params_version = 0, 0
        self._requests = requests

    def set_params(self, params: np.ndarray, header: ParamsHeader) -> None:
        """Ignored: the parameters are where the actions are chosen."""

    def act(self, obs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The answer to the last request, whose observations lie in these arrays, as in every policy's `act`."""
        assert obs is self._requests.observation
        self.num_calls += 1
        action, extras, self.params_version = self._requests.answer()
        return action, extras
