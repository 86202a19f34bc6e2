"""Where a learner's arrays live, and how its functions are compiled for that: one device, or several with a shard each.

Several devices share the lanes: device d of D has the lanes from d * num_lanes / D on, with their slots, and a sum tree
of its own over them. Parameters and all else that a gradient step changes are on every device, bit for bit the same.
Every device draws its part of a batch from its own tree. Only sums and extremes cross devices (`learner.across`).

A lane's slots are consecutive, so an array of all slots in the order of the lanes is the shards' arrays one after
another: records look the same whatever D is. What does not is made the same for a checkpoint (`canonical`): the sum
trees are rebuilt of their leaves, and anchors are counted from slot 0 of all lanes.
"""

import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import PRNGKeyArray

from gvz.core.errors import ConfigError
from gvz.transport.messages import StepBlock
from learner import replay, sum_tree, train_step
from learner.across import AXIS, Across
from learner.agents.base import OffPolicyAgent
from learner.config import LearnerConfig, ReplayConfig
from learner.ingest import Ingest
from learner.replay import ReplaySpec, ReplayState
from learner.store import StepArrays
from learner.sum_tree import SumTree
from learner.train_step import LearnerState, TrainStep

SHARDED, REPLICATED = PartitionSpec(AXIS), PartitionSpec()


@dataclass(frozen=True, kw_only=True, slots=True)
class Learning:
    """What is compiled: the agent's loss on batches of a replay, over all devices."""

    agent: OffPolicyAgent
    config: LearnerConfig
    replay_config: ReplayConfig
    replay_spec: ReplaySpec

    def init(self, key: PRNGKeyArray) -> LearnerState:
        """The state before the first update."""
        return train_step.init(self.agent, self.replay_spec, self.config, key)

    def of_one_of(self, num_devices: int) -> "Learning":
        """What each of several devices has of it."""
        spec, config = self.replay_spec, self.config
        return replace(
            self,
            config=replace(config, batch_size=config.batch_size // num_devices, devices=1),
            replay_spec=replace(
                spec,
                num_lanes=spec.num_lanes // num_devices,
                capacity=spec.num_slots // num_devices,
                num_newest=spec.num_newest // num_devices,
            ),
        )


class Placement:
    """A learner's arrays on the default device. `SeveralDevices` has them on several."""

    def __init__(self, learning: Learning):
        self._learning = learning
        self._add = jax.jit(partial(replay.add, learning.replay_spec), donate_argnums=0)

    def init(self, key: PRNGKeyArray) -> tuple[LearnerState, ReplayState]:
        """The state before the first update, and an empty replay."""
        return jax.jit(self._learning.init)(key), replay.init(self._learning.replay_spec)

    def place(self, state: LearnerState, replay_state: ReplayState) -> tuple[LearnerState, ReplayState]:
        """The same from numpy arrays in canonical form; copies, for a borrowed buffer cannot be donated."""
        return jax.tree.map(jnp.array, (state, replay_state))

    def canonical(self, state: LearnerState, replay_state: ReplayState) -> tuple[LearnerState, ReplayState]:
        """In the form that does not depend on the devices."""
        return state, replay_state

    def settled(self, state: LearnerState) -> LearnerState:
        """What `local` gave on all devices again, where parts of it were made elsewhere, such as empty sums."""
        return state

    def local(self, state: LearnerState) -> LearnerState:
        """What this process has of it."""
        return state

    def one_copy(self, tree: Any) -> Any:
        """Replicated arrays on the default device alone."""
        return tree

    def add(self, replay_state: ReplayState, arrays: StepArrays) -> ReplayState:
        """`replay.add`, jitted; the replay is donated."""
        return self._add(replay_state, arrays)

    def blocks(self, ingest: Ingest, blocks: Sequence[StepBlock], params_version: int) -> Iterator[StepArrays]:
        """Checked records in the blocks that `add` takes."""
        return ingest.arrays(blocks, params_version)

    def make_train_step(self, num_updates: int) -> TrainStep:
        """As `train_step.make_train_step`."""
        one = self._learning
        return train_step.make_train_step(one.agent, one.replay_spec, one.config, one.replay_config, num_updates)


class SeveralDevices(Placement):
    """The first devices of every process, a shard of the process's lanes on each.

    The learner's state is of all processes. A replay is of one: its arrays are made parts of larger ones for a train
    step, without a copy.
    """

    def __init__(self, learning: Learning):
        """Compiles nothing yet.

        Raises:
            ConfigError: there are not as many devices.
        """
        self._all, self._num_devices = learning, learning.config.devices
        self._each = learning.of_one_of(self._num_devices)
        here = devices(self._num_devices)
        of_all = [device for process in range(jax.process_count()) for device in _of_process(process)[: len(here)]]
        self._here, self._everywhere = (Mesh(np.array(found), (AXIS,)) for found in (here, of_all))
        specs = self._replay_specs
        self._add = _jit(self._add_here, self._here, (specs, SHARDED), specs, donated=(0,))

    def init(self, key: PRNGKeyArray) -> tuple[LearnerState, ReplayState]:
        def empty() -> ReplayState:
            return self._as_shard(replay.init(self._each.replay_spec))

        state = self._put(jax.jit(self._all.init)(key), self._state_specs)
        return self._joined(state, self._state_specs), _jit(empty, self._here, (), self._replay_specs)()

    def place(self, state: LearnerState, replay_state: ReplayState) -> tuple[LearnerState, ReplayState]:
        sharded = regroup(replay_state, self._all.replay_spec, self._num_devices)
        state = self._joined(self._put(state, self._state_specs), self._state_specs)
        return state, self._put(sharded, self._replay_specs)

    def canonical(self, state: LearnerState, replay_state: ReplayState) -> tuple[LearnerState, ReplayState]:
        return self.local(state), regroup(replay_state, self._all.replay_spec, None)

    def local(self, state: LearnerState) -> LearnerState:
        return self._parted(state, self._state_specs)

    def settled(self, state: LearnerState) -> LearnerState:
        return self._joined(jax.device_put(state, self._shardings(self._state_specs)), self._state_specs)

    def one_copy(self, tree: Any) -> Any:
        return jax.tree.map(lambda leaf: leaf.addressable_data(0), tree)

    def add(self, replay_state: ReplayState, arrays: StepArrays) -> ReplayState:
        return self._add(replay_state, jax.device_put(arrays, NamedSharding(self._here, SHARDED)))

    def blocks(self, ingest: Ingest, blocks: Sequence[StepBlock], params_version: int) -> Iterator[StepArrays]:
        return ingest.shards(blocks, params_version, self._num_devices)

    def make_train_step(self, num_updates: int) -> TrainStep:
        each, state_specs, replay_specs = self._each, self._state_specs, self._replay_specs
        across = Across(self._everywhere.size)
        of_one_device = train_step.of_one_device(
            each.agent, each.replay_spec, each.config, each.replay_config, num_updates, across
        )

        def on_each(state: LearnerState, shard: ReplayState, task_weights: Any) -> tuple[LearnerState, ReplayState]:
            state, own = of_one_device(state, self._of_shard(shard), task_weights[0])
            return state, self._as_shard(own)

        both = state_specs, replay_specs
        compiled = _jit(on_each, self._everywhere, (*both, SHARDED), both, donated=(0, 1))

        def step(state: LearnerState, replay_state: ReplayState, task_weights: Any) -> tuple[LearnerState, ReplayState]:
            weights = self._put(np.tile(np.asarray(task_weights), (self._num_devices, 1)), SHARDED)
            state, replay_state = compiled(
                state, self._joined(replay_state, replay_specs), self._joined(weights, SHARDED)
            )
            return state, self._parted(replay_state, replay_specs)

        return step

    def _add_here(self, shard: ReplayState, arrays: StepArrays) -> ReplayState:
        arrays = replace(arrays, num_valid=arrays.num_valid[0])
        return self._as_shard(replay.add(self._each.replay_spec, self._of_shard(shard), arrays))

    def _put(self, tree: Any, specs: Any) -> Any:
        """Copies of the leaves on this process's devices; `specs` has the tree's structure."""
        return jax.device_put(tree, self._shardings(specs), may_alias=False)

    def _shardings(self, specs: Any) -> Any:
        return jax.tree.map(lambda spec: NamedSharding(self._here, spec), specs)

    def _joined(self, tree: Any, specs: Any) -> Any:
        """This process's arrays as parts of arrays of all processes: the same bytes."""
        return _on_mesh(tree, specs, self._here, self._everywhere)

    def _parted(self, tree: Any, specs: Any) -> Any:
        """The parts of this process: the inverse of `_joined`."""
        return _on_mesh(tree, specs, self._everywhere, self._here)

    @cached_property
    def _state_specs(self) -> Any:
        """Everything is on all devices, but for the samples that are kept of an update that is not finite."""
        sharded = tuple(f".non_finite.{name}" for name in ("batch", "loss", "weights"))

        def spec(path: Any, _: Any) -> PartitionSpec:
            return SHARDED if jax.tree_util.keystr(path).startswith(sharded) else REPLICATED

        return jax.tree_util.tree_map_with_path(spec, jax.eval_shape(self._all.init, jax.random.key(0)))

    @cached_property
    def _replay_specs(self) -> Any:
        shapes = jax.eval_shape(lambda: self._as_shard(replay.init(self._each.replay_spec)))
        return replace(jax.tree.map(lambda _: SHARDED, shapes), max_priority=REPLICATED)

    def _of_shard(self, shard: ReplayState) -> ReplayState:
        """A device's shard as a replay of its own lanes."""
        return replace(shard, tree=self._with_groups(shard.tree, 1), newest_head=shard.newest_head[0])

    def _as_shard(self, own: ReplayState) -> ReplayState:
        """A replay of a device's lanes as its part of the whole, in which its sum tree is one of several groups."""
        return replace(own, tree=self._with_groups(own.tree, self._num_devices), newest_head=own.newest_head[None])

    def _with_groups(self, tree: SumTree, num_shards: int) -> SumTree:
        spec = self._each.replay_spec
        return replace(tree, num_leaves=num_shards * spec.num_slots, num_groups=num_shards * replay.num_groups(spec))


def _jit(here: Callable[..., Any], mesh: Mesh, takes: Any, gives: Any, donated: tuple[int, ...] = ()) -> Any:
    """Jits what each device does."""
    mapped = jax.shard_map(here, mesh=mesh, in_specs=takes, out_specs=gives, check_vma=False)
    return jax.jit(mapped, donate_argnums=donated)


def _on_mesh(tree: Any, specs: Any, before: Mesh, mesh: Mesh) -> Any:
    """Arrays over a mesh made of the parts that this process has of arrays over another one."""

    def moved(leaf: jax.Array, spec: PartitionSpec) -> jax.Array:
        shape = (leaf.shape[0] * mesh.size // before.size, *leaf.shape[1:]) if spec == SHARDED else leaf.shape
        return _of_parts(shape, NamedSharding(mesh, spec), leaf)

    return tree if before == mesh else jax.tree.map(moved, tree, specs)


def _of_parts(shape: tuple[int, ...], sharding: NamedSharding, leaf: jax.Array) -> jax.Array:
    """An array of this shape whose parts on this process's devices are those of `leaf`."""
    parts = [shard.data for shard in leaf.addressable_shards]
    if leaf.size == 0:  # jit gives arrays without elements any sharding
        empty = np.zeros(sharding.shard_shape(shape), leaf.dtype)
        parts = [jax.device_put(empty, device) for device in sharding.addressable_devices]
    return jax.make_array_from_single_device_arrays(shape, sharding, parts)


def _of_process(process: int) -> list[Any]:
    return [device for device in jax.devices() if device.process_index == process]


def placement(learning: Learning) -> Placement:
    """Where `learning` happens.

    Raises:
        ConfigError: there are not as many devices as it wants.
    """
    alone = learning.config.devices == jax.process_count() == 1
    return Placement(learning) if alone else SeveralDevices(learning)


def devices(num_devices: int) -> list[Any]:
    """The first devices of this process.

    Raises:
        ConfigError: there are fewer, or none of the kind that JAX_PLATFORMS wants.
    """
    try:
        present = jax.local_devices()
    except (RuntimeError, AssertionError) as error:  # the latter has no text: JAX lacks the plugin for a GPU
        why = str(error).partition("\n")[0] or "its package for them is not installed"
        raise ConfigError(
            f"JAX_PLATFORMS={os.environ.get('JAX_PLATFORMS')}: JAX finds no such devices ({why}); unset it, or install "
            "what they need (an NVIDIA GPU: `make install-cuda`, and a driver)"
        ) from error
    if num_devices > len(present):
        raise ConfigError(
            f"learner.devices: got {num_devices}, but JAX sees {len(present)} ({present[0].platform}); lower it, or "
            "make more devices visible (CUDA_VISIBLE_DEVICES); to try it on a CPU, set "
            f"XLA_FLAGS=--xla_force_host_platform_device_count={num_devices}"
        )
    return present[:num_devices]


def regroup(state: ReplayState, spec: ReplaySpec, num_shards: int | None) -> ReplayState:
    """The same replay in other shards, on the host.

    Args:
        state: in shards or in canonical form.
        spec: of all lanes.
        num_shards: as many; None for the canonical form, in which all lanes are one.
    """
    num_groups = spec.num_lanes if spec.equal_shares else num_shards or 1
    begin = state.tree.starts[-2]
    of_group = np.asarray(state.tree.nodes).reshape(state.tree.num_groups, -1)
    leaves = of_group[:, begin : begin + spec.num_slots // state.tree.num_groups].ravel()
    newest, heads = _regroup_newest(np.asarray(state.newest), np.asarray(state.newest_head), spec, num_shards or 1)
    return replace(
        state,
        tree=sum_tree.of_leaves(leaves, num_groups),
        newest=newest,
        newest_head=heads[0] if num_shards is None else heads,
    )


def _regroup_newest(
    newest: np.ndarray, heads: np.ndarray, spec: ReplaySpec, num_shards: int
) -> tuple[np.ndarray, np.ndarray]:
    """The circles of the newest anchors for other shards; of several circles the last ones of each are the newest."""
    num_before, size = heads.size, spec.num_newest // num_shards
    slots_before, slots = spec.num_slots // num_before, spec.num_slots // num_shards
    aged = list[tuple[int, int]]()
    for d, (circle, head) in enumerate(zip(newest.reshape(num_before, -1), heads.ravel(), strict=True)):
        oldest_first = np.roll(circle, -int(head))
        aged += [
            (age, d * slots_before + int(slot)) for age, slot in enumerate(oldest_first[::-1]) if slot < slots_before
        ]
    anchors = np.array([anchor for _, anchor in sorted(aged, reverse=True)], np.int32)
    circles = np.full((num_shards, size), slots, np.int32)
    new_heads = np.zeros(num_shards, np.int32)
    if size > 0:
        for d in range(num_shards):
            own = anchors[anchors // slots == d][-size:] - d * slots
            circles[d, : len(own)], new_heads[d] = own, len(own) % size
    return circles.ravel(), new_heads
