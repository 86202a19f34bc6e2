"""The replay: step records in, batches of n-step transitions out, all of it on the device.

Pure functions over `ReplayState`; jit them once at the edge, with the state donated. They read an array that they
also write only where what is written depends on what was read: then XLA writes in place, else it copies the array.

Every lane (one game) owns `lane_capacity` consecutive slots, written in a circle. Frames are stored once; stacks,
returns and discounts are put together when a batch is drawn. A *transition* is named by its anchor, the slot of o_t
and a_t. An anchor can be drawn when its leaf in the sum tree is positive, and no other rule exists. `add` keeps that
true exactly while

- the anchor is not the last record of its episode (no action was taken there),
- its window is complete: n records follow it, or fewer and the last of its episode is among them, and
- every frame of its stack is still stored.

An empty slot counts as the last record of an episode, so that no window or stack reaches into one.

The pytrees are `no_type_check`: their shapes hold for what functions take and return (and are checked there), while
jax also builds them of numpy arrays, of shapes alone, and with batch axes.
"""

from dataclasses import dataclass, replace
from typing import no_type_check

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from gvz.core.errors import ConfigError
from learner import sum_tree
from learner.sum_tree import SumTree


@dataclass(frozen=True, kw_only=True, slots=True)
class ReplaySpec:
    """Sizes and constants of a replay; static under jit."""

    num_lanes: int
    """games of the run"""
    capacity: int
    """step records; what does not divide by num_lanes is left unused"""
    frame_shape: tuple[int, int, int]
    """(H, W, C) of one frame, uint8"""
    num_tasks: int
    stack_size: int
    """frames of an observation"""
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
    num_newest: int
    """newest transitions at the end of every batch"""

    def __post_init__(self) -> None:
        if self.lane_capacity < self.stack_size + self.n_steps:
            raise ConfigError(
                f"replay.capacity: got {self.capacity} records over {self.num_lanes} games, {self.lane_capacity} "
                f"each; want at least {self.num_lanes * (self.stack_size + self.n_steps)}, so that a stack of "
                f"{self.stack_size} and a window of {self.n_steps} steps fit into a game's share"
            )

    @property
    def lane_capacity(self) -> int:
        """Slots of one lane."""
        return self.capacity // self.num_lanes

    @property
    def num_slots(self) -> int:
        """Slots of all lanes."""
        return self.lane_capacity * self.num_lanes

    @property
    def max_block(self) -> int:
        """Largest block `add` takes: the slots it writes and those it looks back on must not meet in the circle."""
        return self.lane_capacity - self.stack_size - self.n_steps + 1


@jax.tree_util.register_dataclass
@no_type_check
@dataclass(frozen=True, kw_only=True, slots=True)
class StepArrays:
    """A block of step records (gvz.transport.messages.STEP_DTYPE), in the order of each lane's stream.

    The first `num_valid` are records; the rest is padding and may hold anything.
    """

    frames: UInt8[Array | np.ndarray, "N H W C"]
    action: Int[Array | np.ndarray, "N"]
    reward: Float[Array | np.ndarray, "N"]
    lane: Int[Array | np.ndarray, "N"]
    task: Int[Array | np.ndarray, "N"]
    first: Bool[Array | np.ndarray, "N"]
    terminated: Bool[Array | np.ndarray, "N"]
    truncated: Bool[Array | np.ndarray, "N"]
    num_valid: Int[Array | np.ndarray, ""]


@jax.tree_util.register_dataclass
@no_type_check
@dataclass(frozen=True, kw_only=True, slots=True)
class ReplayState:
    """Everything stored, K = num_slots."""

    frames: UInt8[Array, "K HWC"]
    action: Int[Array, "K"]
    reward: Float[Array, "K"]
    task: Int[Array, "K"]
    """num_tasks in an empty slot"""
    first: Bool[Array, "K"]
    last: Bool[Array, "K"]
    """the episode ended or was cut here, or the slot is empty"""
    terminated: Bool[Array, "K"]
    """the episode ended by the rules here: nothing to bootstrap from"""
    heads: Int[Array, "lanes"]
    """where in its circle each lane writes next, 0..lane_capacity-1 (a running count would overflow)"""
    tree: SumTree
    max_priority: Float[Array, ""]
    """largest leaf ever set; what new transitions enter with"""
    newest: Int[Array, "num_newest"]
    """anchors of the newest transitions, a circle; num_slots where there is none yet"""
    newest_head: Int[Array, ""]


@jax.tree_util.register_dataclass
@no_type_check
@dataclass(frozen=True, kw_only=True, slots=True)
class Transitions:
    """A batch of n-step transitions; subscript t is where each window ends.

    `r_t` = sum over k = 0..m-1 of gamma^k times the k-th reward after the anchor and `discount_t` = gamma^m, with m
    the length of the window: n, or less where the episode ends earlier. `discount_t` is 0 where it *terminated*.
    Stacks are oldest frame first on the channel axis, the episode's first frame repeated at its start.

    Source: thesis eq. 4.15, 4.16. Differs: gamma^k from k = 0, and the bootstrap is discounted by gamma^m.
    """

    obs_tm1: UInt8[Array, "B H W SC"]
    a_tm1: Int[Array, "B"]
    r_t: Float[Array, "B"]
    discount_t: Float[Array, "B"]
    obs_t: UInt8[Array, "B H W SC"]
    task: Int[Array, "B"]


@jax.tree_util.register_dataclass
@no_type_check
@dataclass(frozen=True, kw_only=True, slots=True)
class SampleInfo:
    """Where a batch came from.

    `weights` correct for not having drawn uniformly, divided by the largest in the batch (thesis eq. 4.13).
    """

    slots: Int[Array, "B"]
    weights: Float[Array, "B"]
    probabilities: Float[Array, "B"]


def init(spec: ReplaySpec) -> ReplayState:
    """Returns an empty replay."""
    K = spec.num_slots
    return ReplayState(
        frames=jnp.zeros((K, int(np.prod(spec.frame_shape))), jnp.uint8),
        action=jnp.zeros(K, jnp.int32),
        reward=jnp.zeros(K, jnp.float32),
        task=jnp.full(K, spec.num_tasks, jnp.int32),
        first=jnp.zeros(K, bool),
        last=jnp.ones(K, bool),
        terminated=jnp.zeros(K, bool),
        heads=jnp.zeros(spec.num_lanes, jnp.int32),
        tree=sum_tree.init(K),
        max_priority=jnp.ones((), jnp.float32),
        newest=jnp.full(spec.num_newest, K, jnp.int32),
        newest_head=jnp.zeros((), jnp.int32),
    )


def memory_bytes(spec: ReplaySpec) -> int:
    """Returns the bytes of a replay's arrays, exactly."""
    state = jax.eval_shape(lambda: init(spec))
    return sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state))


def add(spec: ReplaySpec, state: ReplayState, block: StepArrays) -> ReplayState:
    """Stores a block of records and brings the leaves up to date; the same as adding its records one by one.

    A record that is `first` after one that was not last says that the stream broke off there (actor or engine
    died): the earlier one becomes the last of its episode, truncated.

    Raises:
        ValueError: the block is larger than `spec.max_block`.
    """
    N = block.action.shape[0]
    if spec.max_block < N:
        raise ValueError(
            f"replay.add: got a block of {N} records, want at most {spec.max_block} with {spec.lane_capacity} slots a "
            f"game, stacks of {spec.stack_size} and windows of {spec.n_steps}; raise replay.capacity"
        )
    valid = jnp.arange(N) < block.num_valid
    lane = jnp.where(valid, block.lane, spec.num_lanes)  # padding lies beyond the last slot, where writes are dropped
    earlier_in_lane = jnp.tril(lane[:, None] == lane[None, :], k=-1)  # [N, N]
    rank = earlier_in_lane.sum(1, dtype=jnp.int32)
    slot = _moved(spec, lane * spec.lane_capacity, state.heads.at[lane].get(mode="clip") + rank)

    is_last = jnp.logical_or(block.terminated, block.truncated)
    first = state.first.at[slot].set(block.first, mode="drop")
    last = state.last.at[slot].set(is_last, mode="drop")
    previous = _moved(spec, slot, -1)
    cut = ~_at(last, previous) & block.first
    last = last.at[jnp.where(cut, previous, spec.num_slots)].set(True, mode="drop")

    completed = _completed(spec, last, slot, is_last, cut)  # [N, n]
    stale = _reading(spec, first, slot)  # [N, S]
    # one call sets both: a slot of this block that is already complete is in both lists, and the larger value wins
    tree = sum_tree.set(
        state.tree,
        jnp.concatenate([stale.ravel(), completed.ravel()]),
        jnp.concatenate([jnp.zeros(stale.size), jnp.full(completed.size, state.max_priority)]),
    )
    newest, newest_head = _keep_newest(spec, state, stale.ravel(), completed.ravel())
    return ReplayState(
        frames=state.frames.at[slot].set(block.frames.reshape(N, -1), mode="drop"),
        action=state.action.at[slot].set(block.action, mode="drop"),
        reward=state.reward.at[slot].set(block.reward, mode="drop"),
        task=state.task.at[slot].set(block.task, mode="drop"),
        first=first,
        last=last,
        terminated=state.terminated.at[slot].set(block.terminated, mode="drop"),
        heads=state.heads.at[lane].add(1, mode="drop") % spec.lane_capacity,
        tree=tree,
        max_priority=state.max_priority,
        newest=newest,
        newest_head=newest_head,
    )


def sample(
    spec: ReplaySpec,
    state: ReplayState,
    key: PRNGKeyArray,
    batch_size: int,
    is_exponent: Float[Array, ""] | float,
) -> tuple[Transitions, SampleInfo]:
    """Draws a batch in proportion to priority; its last `num_newest` are the newest transitions instead.

    Args:
        spec: sizes.
        state: the replay. While it holds no complete transition all weights are NaN, see `check_can_sample`.
        key: consumed.
        batch_size: transitions, more than spec.num_newest.
        is_exponent: beta of the importance-sampling weights, 0..1.

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
    weights = (probabilities.min() / probabilities) ** is_exponent  # (1 / N P(i))^beta over its maximum: N drops out
    if spec.num_newest > 0:
        stand_in = jnp.arange(spec.num_newest) % num_drawn
        there = state.newest < spec.num_slots
        slots, weights, probabilities = (
            jnp.concatenate([drawn, jnp.where(there, newest, drawn[stand_in])])
            for drawn, newest in ((slots, state.newest), (weights, 1.0), (probabilities, 1.0))
        )
    return _transitions(spec, state, slots), SampleInfo(slots=slots, weights=weights, probabilities=probabilities)


def update_priorities(
    spec: ReplaySpec, state: ReplayState, slots: Int[Array, "B"], td_errors: Float[Array, "B"]
) -> ReplayState:
    """Sets the priorities of drawn transitions to (|TD error| + min_priority)^omega; nothing if not prioritized.

    A slot that was overwritten since it was drawn stays undrawable. Where a slot repeats, its largest error counts.

    Source: thesis eq. 4.11, 4.12.
    """
    if not spec.prioritized:
        return state
    priorities = (jnp.abs(td_errors) + spec.min_priority) ** spec.priority_exponent
    drawable = sum_tree.get(state.tree, slots) > 0
    return replace(
        state,
        tree=sum_tree.set(state.tree, jnp.where(drawable, slots, spec.num_slots), priorities),
        max_priority=jnp.maximum(state.max_priority, jnp.where(drawable, priorities, 0.0).max()),
    )


def records_per_task(spec: ReplaySpec, state: ReplayState) -> Int[Array, "num_tasks"]:
    """Counts the stored records of each task. Reads all task numbers: for the log, not for every step."""
    return jnp.zeros(spec.num_tasks, jnp.int32).at[state.task].add(1, mode="drop")


def check_can_sample(spec: ReplaySpec, state: ReplayState) -> None:
    """Refuses, on the host, a replay without a complete transition. Waits for the device.

    More than num_lanes * n_steps decisions always hold one, unless streams broke off after their first record: a lane
    without one is in its first episode and has at most n_steps records.

    Raises:
        ConfigError: there is nothing to draw.
    """
    if not float(sum_tree.total(state.tree)) > 0:
        raise ConfigError(
            f"replay: no complete transition among {int(records_per_task(spec, state).sum())} records, nothing can be "
            f"drawn; want learner.warmup_steps of at least {spec.num_lanes * spec.n_steps} ({spec.num_lanes} games "
            f"times agent.n_steps {spec.n_steps}), and actors that do not die at the start of an episode"
        )


def _moved(spec: ReplaySpec, slot: Array, steps: Array | int) -> Array:
    """The slot that many records later (earlier if negative) in the same lane's circle."""
    lane_start = slot // spec.lane_capacity * spec.lane_capacity
    return lane_start + (slot + steps) % spec.lane_capacity


def _at(flags: Bool[Array, "K"], slots: Int[Array, "..."]) -> Bool[Array, "..."]:
    """flags[slots]; True beyond the last slot, where padding lies: it is the last and the first of everything."""
    return flags.at[slots].get(mode="fill", fill_value=True)


def _completed(
    spec: ReplaySpec, last: Bool[Array, "K"], slot: Int[Array, "N"], is_last: Bool[Array, "N"], cut: Bool[Array, "N"]
) -> Int[Array, "N n"]:
    """The anchors whose windows each new record completes, oldest first; num_slots in place of none.

    A record completes the window of the anchor n records back, and if it is the last of its episode also those of
    the anchors between. After a cut it does the latter for the record before it, which was not known to be the last.
    """
    closing = jnp.where(cut, _moved(spec, slot, -1), slot)
    back = jnp.arange(1, spec.n_steps + 1)[None, :]
    anchors = _moved(spec, closing[:, None], -back)  # [N, n]
    same_episode = jnp.cumprod(~_at(last, anchors), axis=1, dtype=jnp.int32) > 0
    completes = jnp.where(back == spec.n_steps, ~cut[:, None], (is_last | cut)[:, None])
    return jnp.where(same_episode & completes, anchors, spec.num_slots)[:, ::-1]


def _reading(spec: ReplaySpec, first: Bool[Array, "K"], slot: Int[Array, "N"]) -> Int[Array, "N S"]:
    """The anchors whose stacks reach back to each written slot, itself included; num_slots in place of none."""
    ahead = _moved(spec, slot[:, None], jnp.arange(1, spec.stack_size)[None, :])
    reaches_back = jnp.cumprod(~_at(first, ahead), axis=1, dtype=jnp.int32) > 0
    return jnp.concatenate([slot[:, None], jnp.where(reaches_back, ahead, spec.num_slots)], axis=1)


def _keep_newest(
    spec: ReplaySpec, state: ReplayState, stale: Int[Array, "R"], completed: Int[Array, "M"]
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


def _transitions(spec: ReplaySpec, state: ReplayState, anchors: Int[Array, "B"]) -> Transitions:
    n = spec.n_steps
    powers = jnp.asarray(spec.discount ** np.arange(n + 1), jnp.float32)
    window = _moved(spec, anchors[:, None], jnp.arange(1, n + 1)[None, :])  # [B, n]
    ended = jnp.cumsum(state.last[window], axis=1)
    within = jnp.concatenate([jnp.ones_like(ended[:, :1], bool), ended[:, :-1] == 0], axis=1)
    length = within.sum(1)
    end = _moved(spec, anchors, length)
    return Transitions(
        obs_tm1=_stacks(spec, state, anchors),
        a_tm1=state.action[anchors],
        r_t=jnp.sum(jnp.where(within, powers[None, :n] * state.reward[window], 0.0), axis=1),
        discount_t=powers[length] * ~state.terminated[end],
        obs_t=_stacks(spec, state, end),
        task=state.task[anchors],
    )


def _stacks(spec: ReplaySpec, state: ReplayState, slots: Int[Array, "B"]) -> UInt8[Array, "B H W SC"]:
    """Observations at `slots`: frames of one episode, oldest first, its first one repeated.

    Measured at 100K frames of 84x84x3, batch 32: a whole `sample`, both stacks, takes 1.4 ms (2026-11-21, 2-core AMD
    EPYC, minimum). Walking back in a scan matters: XLA would fuse the arithmetic of an unrolled walk into the gather
    and redo it for every byte (measured: 47 ms). To gather the S + n frames of a window once, instead of 2 S, would
    save at most an eighth.
    """

    def back(slot: Array, _: None) -> tuple[Array, Array]:
        return jnp.where(state.first[slot], slot, _moved(spec, slot, -1)), slot

    _, history = jax.lax.scan(back, slots, length=spec.stack_size, reverse=True)  # [S, B], oldest first
    S, B, (H, W, C) = *history.shape, spec.frame_shape
    return state.frames[history].reshape(S, B, H, W, C).transpose(1, 2, 3, 0, 4).reshape(B, H, W, S * C)
