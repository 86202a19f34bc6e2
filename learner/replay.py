"""The replay: step records in, batches of n-step transitions out, all of it on the device.

Pure functions over `ReplayState`, as in `learner.store`, which keeps the records.

A *transition* is named by its anchor, the slot of o_t and a_t. An anchor can be drawn when its leaf in the sum tree is
positive, and no other rule exists. `add` keeps that true exactly while

- the anchor is not the last record of its episode (no action was taken there),
- its window is complete: n records follow it, or fewer and the last of its episode is among them, and
- every record that its observation reads is still stored.
"""

from dataclasses import dataclass, replace
from typing import no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from gvz.core.errors import ConfigError
from learner import store, sum_tree
from learner.across import ALONE, Across
from learner.observation import Observation
from learner.store import StepArrays, Store, StoreSpec, Written, moved
from learner.sum_tree import SumTree


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplaySpec(StoreSpec):
    """Sizes and constants of a replay; static under jit."""

    n_steps: int
    """longest window of a return"""
    discount: float
    """gamma of one decision"""
    priority_exponent: float
    """omega"""
    min_priority: float
    """added to |TD error| before the exponent"""
    prioritized: bool
    """False samples uniformly"""
    equal_shares: bool = False
    """every game gives the same share of a batch"""
    num_newest: int
    """newest transitions at the end of every batch"""

    def __post_init__(self) -> None:
        if self.lane_capacity < self.history + self.n_steps:
            raise ConfigError(
                f"replay.capacity: got {self.capacity} records over {self.num_lanes} games, {self.lane_capacity} "
                f"each; want at least {self.num_lanes * (self.history + self.n_steps)}, so that an observation of "
                f"{self.history} records and a window of {self.n_steps} steps fit into a game's share"
            )

    @property
    def max_block(self) -> int:
        """Largest block `add` takes: the slots it writes and those it looks back on must not meet in the circle."""
        return self.lane_capacity - self.history - self.n_steps + 1


@jax.tree_util.register_dataclass
@no_type_check
@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayState:
    """Everything stored, K = num_slots."""

    store: Store
    tree: SumTree
    """a leaf a slot"""
    max_priority: Float[Array, ""]
    """largest leaf ever set; what new transitions enter with"""
    newest: Int[Array, " num_newest"]
    """anchors of the newest transitions, a circle; num_slots where there is none yet"""
    newest_head: Int[Array, ""]


@jax.tree_util.register_dataclass
@no_type_check
@dataclass(frozen=True, kw_only=True, slots=True)
class Transitions:
    """A batch of n-step transitions; subscript t is where each window ends.

    `r_t` = sum over k = 0..m-1 of gamma^k times the k-th reward after the anchor and `discount_t` = gamma^m, with m
    the length of the window: n, or less where the episode ends earlier. `discount_t` is 0 where it *terminated*.

    Source: thesis eq. 4.15, 4.16. Differs: gamma^k from k = 0, and the bootstrap is discounted by gamma^m.
    """

    obs_tm1: Observation
    a_tm1: Int[Array, " B"]
    r_t: Float[Array, " B"]
    discount_t: Float[Array, " B"]
    obs_t: Observation
    sight_tm1: UInt8[Array, "B C"] | None = None
    """what was in sight when the action was chosen: flags by class and column; None if it is not recorded"""

    @property
    def task(self) -> Int[Array, " B"]:
        """Index of each transition's task."""
        return self.obs_tm1.task


@jax.tree_util.register_dataclass
@no_type_check
@dataclass(frozen=True, kw_only=True, slots=True)
class SampleInfo:
    """Where a batch came from.

    `weights` correct for not having drawn uniformly, divided by the largest in the batch (thesis eq. 4.13).
    """

    slots: Int[Array, " B"]
    weights: Float[Array, " B"]
    probabilities: Float[Array, " B"]


def init(spec: ReplaySpec) -> ReplayState:
    """Returns an empty replay."""
    return ReplayState(
        store=store.init(spec),
        tree=sum_tree.init(spec.num_slots, num_groups(spec)),
        max_priority=jnp.ones((), jnp.float32),
        newest=jnp.full(spec.num_newest, spec.num_slots, jnp.int32),
        newest_head=jnp.zeros((), jnp.int32),
    )


def num_groups(spec: ReplaySpec) -> int:
    """Sum trees of a replay."""
    return spec.num_lanes if spec.equal_shares else 1


def memory_bytes(spec: ReplaySpec) -> int:
    """Returns the bytes of a replay's arrays, exactly."""
    state = jax.eval_shape(lambda: init(spec))
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))


def add(spec: ReplaySpec, state: ReplayState, block: StepArrays) -> ReplayState:
    """Stores a block of records (`store.write`) and brings the leaves up to date; the same as one by one.

    Raises:
        ValueError: the block is larger than `spec.max_block`.
    """
    N = block.action.shape[0]
    if spec.max_block < N:
        raise ValueError(
            f"replay.add: got a block of {N} records, want at most {spec.max_block} with {spec.lane_capacity} slots a "
            f"game, observations of {spec.history} records and windows of {spec.n_steps}; raise replay.capacity"
        )
    records, written = store.write(spec, state.store, block)
    completed = _completed(spec, records.last, written)  # [N, n]
    stale = _reading(spec, records.first, written.slot)  # [N, history]
    # one call sets both: a slot of this block that is already complete is in both lists, and the larger value wins
    tree = sum_tree.set(
        state.tree,
        jnp.concatenate([stale.ravel(), completed.ravel()]),
        jnp.concatenate([jnp.zeros(stale.size), jnp.full(completed.size, state.max_priority)]),
    )
    newest, newest_head = _keep_newest(spec, state, stale.ravel(), completed.ravel())
    return ReplayState(
        store=records, tree=tree, max_priority=state.max_priority, newest=newest, newest_head=newest_head
    )


def sample(
    spec: ReplaySpec,
    state: ReplayState,
    key: PRNGKeyArray,
    batch_size: int,
    is_exponent: Float[Array, ""] | float,
    across: Across = ALONE,
) -> tuple[Transitions, SampleInfo]:
    """Draws a batch in proportion to priority; its last `num_newest` are the newest transitions instead.

    Args:
        spec: sizes.
        state: the replay. While it holds no complete transition all weights are NaN, see `check_can_sample`.
        key: consumed.
        batch_size: transitions, more than spec.num_newest.
        is_exponent: beta of the importance-sampling weights, 0..1.
        across: the devices that draw the batch together, `batch_size` transitions each. P(i) is then that of a draw
            from all of them, and weights are divided by the largest of all. A device that has nothing to draw yet
            gives transitions of weight 0, and those of the others weigh more.

    Returns:
        The batch, and where it came from. The newest transitions are in every batch: their probability is 1, and
        their weight is 1, for there is nothing to correct. While there are fewer of them, drawn ones stand in.

    Raises:
        ValueError: the newest transitions leave no room for drawn ones.

    Source: thesis eq. 4.12, 4.13, with the weights over their maximum (Schaul et al. 2016, 3.4); combined experience
        replay: thesis 4.1.1, Zhang and Sutton 2017.
    """
    num_drawn = batch_size - spec.num_newest
    if num_drawn < 1:
        raise ValueError(f"replay.sample: got num_newest {spec.num_newest}, want less than batch size {batch_size}")
    slots, probabilities = sum_tree.sample(state.tree, key, num_drawn)
    if across.alone:
        weights = _weights(probabilities, probabilities.min(), is_exponent)
    else:
        probabilities, weights = _of_all_devices(probabilities, is_exponent, across)
    if spec.num_newest > 0:
        stand_in = jnp.arange(spec.num_newest) % num_drawn
        there = state.newest < spec.num_slots
        slots, weights, probabilities = (
            jnp.concatenate([drawn, jnp.where(there, newest, drawn[stand_in])])
            for drawn, newest in ((slots, state.newest), (weights, 1.0), (probabilities, 1.0))
        )
    return _transitions(spec, state, slots), SampleInfo(slots=slots, weights=weights, probabilities=probabilities)


def _weights(
    probabilities: Float[Array, " B"], smallest: Float[Array, ""], is_exponent: Float[Array, ""] | float
) -> Float[Array, " B"]:
    """(1 / N P(i))^beta over its maximum: N drops out."""
    return (smallest / probabilities) ** is_exponent


def _of_all_devices(
    probabilities: Float[Array, " B"], is_exponent: Float[Array, ""] | float, across: Across
) -> tuple[Float[Array, " B"], Float[Array, " B"]]:
    """P(i) and weights of a draw to which each device that has a transition gives the same part.

    A device without one drew leaves of no tree: P(i) is infinite there, the weight 0. If none has one, it is NaN.
    """
    there = jnp.isfinite(probabilities).all()
    num_there = across.sum(there.astype(jnp.float32))
    probabilities = jnp.where(there, probabilities / num_there, jnp.inf)
    weights = _weights(probabilities, across.min(probabilities.min()), is_exponent)
    return probabilities, weights * (there * across.num_devices / num_there)


def update_priorities(
    spec: ReplaySpec,
    state: ReplayState,
    slots: Int[Array, " B"],
    td_errors: Float[Array, " B"],
    across: Across = ALONE,
) -> ReplayState:
    """Sets the priorities of drawn transitions to (|TD error| + min_priority)^omega; nothing if not prioritized.

    A slot that was overwritten since it was drawn stays undrawable. Where a slot repeats, its largest error counts. New
    transitions enter with the largest priority of all devices.

    Source: thesis eq. 4.11, 4.12.
    """
    if not spec.prioritized:
        return state
    priorities = (jnp.abs(td_errors) + spec.min_priority) ** spec.priority_exponent
    drawable = sum_tree.get(state.tree, slots) > 0
    return replace(
        state,
        tree=sum_tree.set(state.tree, jnp.where(drawable, slots, spec.num_slots), priorities),
        max_priority=jnp.maximum(state.max_priority, across.max(jnp.where(drawable, priorities, 0.0).max())),
    )


def check_can_sample(spec: ReplaySpec, state: ReplayState) -> None:
    """Refuses, on the host, a replay without a complete transition. Waits for the device.

    More than num_lanes * n_steps decisions always hold one, unless streams broke off after their first record: a lane
    without one is in its first episode and has at most n_steps records.

    Raises:
        ConfigError: there is nothing to draw.
    """
    if not float(sum_tree.total(state.tree)) > 0:
        raise ConfigError(
            f"replay: no complete transition among {int(store.records_per_task(spec, state.store).sum())} records, "
            f"nothing can be drawn; want learner.warmup_steps of at least {spec.num_lanes * spec.n_steps} "
            f"({spec.num_lanes} games times agent.n_steps {spec.n_steps}), and actors that do not die at the start of "
            "an episode"
        )


def _completed(spec: ReplaySpec, last: Bool[Array, " K"], written: Written) -> Int[Array, "N n"]:
    """The anchors whose windows each new record completes, oldest first; num_slots in place of none.

    A record completes the window of the anchor n records back, and if it is the last of its episode also those of
    the anchors between. After a cut it does the latter for the record before it, which was not known to be the last.
    """
    slot, is_last, cut = written
    closing = jnp.where(cut, moved(spec, slot, -1), slot)
    back = jnp.arange(1, spec.n_steps + 1)[None, :]
    anchors = moved(spec, closing[:, None], -back)  # [N, n]
    same_episode = jnp.cumprod(~store.at(last, anchors), axis=1, dtype=jnp.int32) > 0
    completes = jnp.where(back == spec.n_steps, ~cut[:, None], (is_last | cut)[:, None])
    return jnp.where(same_episode & completes, anchors, spec.num_slots)[:, ::-1]


def _reading(spec: ReplaySpec, first: Bool[Array, " K"], slot: Int[Array, " N"]) -> Int[Array, "N history"]:
    """The anchors whose observations read each written slot, itself included; num_slots in place of none."""
    ahead = moved(spec, slot[:, None], jnp.arange(1, spec.history)[None, :])
    reaches_back = jnp.cumprod(~store.at(first, ahead), axis=1, dtype=jnp.int32) > 0
    return jnp.concatenate([slot[:, None], jnp.where(reaches_back, ahead, spec.num_slots)], axis=1)


def _keep_newest(
    spec: ReplaySpec, state: ReplayState, stale: Int[Array, " R"], completed: Int[Array, " M"]
) -> tuple[Array, Array]:
    """Takes stale anchors out of the circle of the newest, and puts completed ones in."""
    if spec.num_newest == 0:
        return state.newest, state.newest_head
    newest = jnp.where(jnp.isin(state.newest, stale), spec.num_slots, state.newest)
    there = completed < spec.num_slots
    order = jnp.cumsum(there) - 1
    count = there.sum(dtype=jnp.int32)
    kept = there & (order >= count - spec.num_newest)
    place = jnp.where(kept, (state.newest_head + order) % spec.num_newest, spec.num_newest)
    return newest.at[place].set(completed, mode="drop"), (state.newest_head + count) % spec.num_newest


def _transitions(spec: ReplaySpec, state: ReplayState, anchors: Int[Array, " B"]) -> Transitions:
    n, records = spec.n_steps, state.store
    powers = jnp.asarray(spec.discount ** np.arange(n + 1), jnp.float32)
    window = moved(spec, anchors[:, None], jnp.arange(1, n + 1)[None, :])  # [B, n]
    ended = jnp.cumsum(records.last[window], axis=1)
    within = jnp.concatenate([jnp.ones_like(ended[:, :1], bool), ended[:, :-1] == 0], axis=1)
    length = within.sum(1)
    end = moved(spec, anchors, length)
    return Transitions(
        obs_tm1=store.observations(spec, records, anchors),
        a_tm1=records.action[anchors],
        r_t=jnp.sum(jnp.where(within, powers[None, :n] * store.rewards(spec, records, window), 0.0), axis=1),
        discount_t=powers[length] * ~records.terminated[end],
        obs_t=store.observations(spec, records, end),
        sight_tm1=None if records.sight is None else records.sight[anchors],
    )
