"""Acting on the learner's device, for actors that ask for their actions."""

from collections.abc import Mapping
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from gvz.transport.messages import ParamsHeader
from learner.agents.base import Agent, Params, folding
from learner.export import unflatten_params
from learner.observation import Observation


class DevicePolicy:
    """The agent's acting function on the default device: what an actor's `ExportedPolicy` is on a core.

    The key of a call is the seed's key folded with the number of calls. For a `FoldingAgent` a decision is a call, of
    whichever actors have asked. `set_params` and `act` may be called by different threads.

    Attributes:
        num_calls: acting steps so far.
        params_version: of the parameters that chose the last actions.
    """

    def __init__(self, agent: Agent, seed: int):
        """Allocates nothing; `seed` has 31 bits."""
        self.num_calls, self.params_version = 0, 0
        self._key = jax.random.key(seed)
        self._unflatten = jax.jit(partial(unflatten_params, jax.eval_shape(agent.init, self._key)))
        self._newest: tuple[Params, ParamsHeader] | None = None
        self._folding = folding(agent)
        self._folded: tuple[Params, Params, int] | None = None
        """of which parameters, what came of them, for which stretch"""
        if self._folding is not None:
            fold = self._folding.fold
            self._fold = jax.jit(lambda params, key, num_calls: fold(params, jax.random.fold_in(key, num_calls)))

        def act(
            params: Params, obs: dict[str, Array], key: Array, num_calls: Array, epsilon: Array
        ) -> tuple[Int[Array, " B"], Float[Array, "B E"]]:
            return agent.act(params, jax.random.fold_in(key, num_calls), Observation(**obs), epsilon)

        self._act = jax.jit(act)

    def set_params(self, params: np.ndarray | jax.Array, header: ParamsHeader) -> None:
        """Acts by `params` float32[P], on the host or the device, from now on; nobody may change or donate them.

        Does not wait for the device: a train step in flight may still have to make them.
        """
        self._newest = self._unflatten(jnp.asarray(params)), header

    def act(self, obs: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """The fields of an `Observation` by name -> (action int32[B], extras float32[B, E]). Waits for the device.

        Compiles for each batch size. The arrays may be changed after the call.
        """
        assert self._newest is not None, "set_params first"
        params, header = self._newest
        params = self._acting_params(params)
        num_calls, epsilon = np.uint32(self.num_calls % 2**32), np.float32(header.epsilon)
        action, extras = self._act(params, dict(obs), self._key, num_calls, epsilon)
        found = np.asarray(action), np.asarray(extras)
        self.num_calls += 1
        self.params_version = header.version
        return found

    def _acting_params(self, params: Params) -> Params:
        """What `act` takes: the parameters, or what was folded of them for this stretch of calls."""
        if self._folding is None:
            return params
        steps = self._folding.fold_period_steps
        first = self.num_calls // steps * steps
        if self._folded is None or self._folded[0] is not params or self._folded[2] != first:
            self._folded = params, self._fold(params, self._key, np.uint32(first % 2**32)), first
        return self._folded[1]
