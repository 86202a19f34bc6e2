"""The replay against what actors acted on and a slow oracle, over random streams and by hand."""

import itertools
from dataclasses import replace

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from gvz.core.errors import ConfigError
from gvz.transport.messages import StepBlock
from learner import replay, store, sum_tree
from learner.ingest import Ingest
from learner.limiter import RateLimiter
from learner.replay import ReplaySpec
from tests.learner.sum_trees import check_valid
from tests.oracles import Record, ReplayOracle, check_batch, play, step_block

FRAME_SHAPE = (4, 5, 3)
DEFAULTS = {
    "num_lanes": 3,
    "capacity": 100,
    "frame_shape": FRAME_SHAPE,
    "num_tasks": 3,
    "stack_size": 4,
    "n_steps": 3,
    "discount": 0.99,
    "priority_exponent": 0.6,
    "min_priority": 0.01,
    "prioritized": True,
    "num_newest": 0,
}


def make_spec(**changes) -> ReplaySpec:
    return ReplaySpec(**(DEFAULTS | changes))


# jitted as the train loop does it, once for each spec and shape
jitted_add = jax.jit(replay.add, static_argnums=0, donate_argnums=1)
jitted_sample = jax.jit(replay.sample, static_argnums=(0, 3))
jitted_update = jax.jit(replay.update_priorities, static_argnums=0, donate_argnums=1)
jitted_leaves = jax.jit(lambda tree: sum_tree.get(tree, jnp.arange(tree.num_leaves)))


class Replay:
    """A replay under test."""

    def __init__(self, spec: ReplaySpec, *, block_size: int = 16, batch_size: int = 32):
        self.spec, self.state, self.batch_size = spec, replay.init(spec), batch_size
        self.ingest = Ingest(spec, block_size)

    def add(self, records: list[Record]) -> None:
        if records:
            self.add_block(step_block(records))

    def add_block(self, block: StepBlock) -> None:
        for arrays in self.ingest.arrays([block], params_version=0):
            self.state = jitted_add(self.spec, self.state, arrays)

    def sample(self, seed: int = 0, is_exponent: float = 0.4):
        key = jax.random.key(seed)
        return jax.device_get(jitted_sample(self.spec, self.state, key, self.batch_size, is_exponent))

    def update(self, slots, td_errors) -> None:
        slots, td_errors = np.asarray(slots, np.int32), np.asarray(td_errors, np.float32)
        self.state = jitted_update(self.spec, self.state, slots, td_errors)

    def leaves(self) -> np.ndarray:
        return np.asarray(jitted_leaves(self.state.tree))


def interleaved(rng: np.random.Generator, spec: ReplaySpec, mean_steps: float):
    """Random lanes in turn, each going on with its own stream."""
    streams = [play(rng, spec, lane, mean_steps=mean_steps) for lane in range(spec.num_lanes)]
    while True:
        yield next(streams[rng.integers(spec.num_lanes)])


def record(lane: int = 0, *, reward=0.0, first=False, terminated=False, truncated=False, task=0, value=0, action=0):
    frame = np.full(FRAME_SHAPE, value, np.uint8)
    return Record(frame, frame, action, reward, lane, task, 0, first, terminated, truncated)


@pytest.mark.parametrize(
    ("changes", "mean_steps", "num_records"),
    [
        ({}, 6, 8_000),  # lanes of 33 slots: each is written round a hundred times
        ({"n_steps": 1, "stack_size": 1, "num_lanes": 1, "capacity": 17, "prioritized": False}, 2, 4_000),
        ({"n_steps": 7, "stack_size": 3, "num_lanes": 2, "capacity": 61, "num_newest": 5}, 5, 6_000),
        ({"stack_size": 2, "num_lanes": 5, "capacity": 2_000, "discount": 0.5}, 40, 5_000),
        ({"num_past_actions": 6, "num_variables": 3, "num_extras": 2, "num_sights": 5}, 7, 5_000),
        ({"equal_shares": True, "num_lanes": 4, "capacity": 400}, 6, 5_000),
    ],
    ids=["rainbow", "dqn", "long windows", "long episodes", "past actions, variables and sight", "equal shares"],
)
def test_every_sample_is_what_the_actor_saw_and_the_oracle_says(changes, mean_steps, num_records):
    """Thousands of random episodes in random blocks: every drawable slot, stack, return and discount."""
    spec = make_spec(**changes)
    rng = np.random.default_rng(0)
    replayed, oracle = Replay(spec, block_size=min(16, spec.max_block)), ReplayOracle(spec)
    records = interleaved(rng, spec, mean_steps)
    num_drawn = 0
    for round_ in range(num_records // 24):
        some = list(itertools.islice(records, int(rng.integers(1, 48))))
        for one in some:
            oracle.add(one)
        replayed.add(some)
        leaves = replayed.leaves()
        if round_ % 10 == 0:
            assert set(np.flatnonzero(leaves)) == oracle.drawable()
            check_valid(replayed.state.tree)
        if not leaves.any():
            continue
        batch, info = replayed.sample(seed=round_)
        assert (leaves[info.slots] > 0).all()
        if spec.equal_shares:
            drawn = np.bincount(info.slots // spec.lane_capacity)[leaves.reshape(spec.num_lanes, -1).any(1)]
            assert drawn.max() - drawn.min() <= 2
        want = [oracle.transition(slot) for slot in info.slots.tolist()]
        check_batch(batch, want)
        num_drawn += len(want)
        if 0 < spec.num_newest <= len(oracle.completed):
            assert set(info.slots[-spec.num_newest :].tolist()) == set(oracle.completed[-spec.num_newest :])
        replayed.update(info.slots, rng.normal(size=len(info.slots)))
    assert num_drawn > num_records / 2
    assert (np.asarray(replayed.state.store.heads) == [len(s) % spec.lane_capacity for s in oracle.streams]).all()
    stored = [r.task for s in oracle.streams for r in s[-spec.lane_capacity :]]
    np.testing.assert_array_equal(
        store.records_per_task(spec, replayed.state.store), np.bincount(stored, minlength=spec.num_tasks)
    )


@pytest.mark.parametrize("num_newest", [0, 3])
def test_a_block_is_the_same_as_its_records_one_by_one(num_newest: int):
    spec = make_spec(num_newest=num_newest)
    records = list(itertools.islice(interleaved(np.random.default_rng(3), spec, 4), 600))
    at_once, one_by_one = Replay(spec, block_size=spec.max_block), Replay(spec, block_size=1)
    for start in range(0, 600, 60):
        for replayed in (at_once, one_by_one):
            replayed.add(records[start : start + 60])
        chex.assert_trees_all_equal(at_once.state, one_by_one.state)


def test_nothing_is_compiled_twice():
    """Blocks of any number of records, batches of any content."""
    spec, num_traces = make_spec(num_newest=2), 0

    def step(state, block, key):
        nonlocal num_traces
        num_traces += 1
        state = replay.add(spec, state, block)
        batch, info = replay.sample(spec, state, key, 8, 0.5)
        return replay.update_priorities(spec, state, info.slots, batch.r_t)

    step, state, ingest = jax.jit(step, donate_argnums=0), replay.init(spec), Ingest(spec, 16)
    records = interleaved(np.random.default_rng(0), spec, 4)
    for num_records in (1, 16, 5, 40, 16):
        for block in ingest.arrays([step_block(list(itertools.islice(records, num_records)))], params_version=0):
            state = step(state, block, jax.random.key(num_records))
    assert num_traces == 1


def test_returns_and_discounts_by_hand():
    """Rewards 1, 2, 4, 8 after frames 0..4; gamma 1/2, three steps: an ending, a time-out and a cut."""
    spec = make_spec(num_lanes=3, capacity=60, discount=0.5)
    replayed = Replay(spec)
    for lane, end in enumerate(("terminated", "truncated", "cut")):
        episode = [record(lane, reward=r, first=t == 0, value=10 * t, action=t) for t, r in enumerate([0, 1, 2, 4, 8])]
        if end == "cut":
            episode.append(record(lane, first=True))
        else:
            episode[-1] = replace(episode[-1], **{end: True})
        replayed.add(episode)
    slots = jnp.array([lane * 20 + t for lane in range(3) for t in range(4)])
    batch = jax.jit(replay._transitions, static_argnums=0)(spec, replayed.state, slots)
    returns = [1 + 2 / 2 + 4 / 4, 2 + 4 / 2 + 8 / 4, 4 + 8 / 2, 8]
    np.testing.assert_array_equal(batch.r_t, returns * 3)
    np.testing.assert_array_equal(batch.discount_t, [1 / 8, 0, 0, 0] + [1 / 8, 1 / 8, 1 / 4, 1 / 2] * 2)
    np.testing.assert_array_equal(batch.a_tm1, [0, 1, 2, 3] * 3)
    np.testing.assert_array_equal(
        batch.obs_tm1.frames[:4, 0, 0, ::3], [[0] * 4, [0, 0, 0, 10], [0, 0, 10, 20], [0, 10, 20, 30]]
    )
    np.testing.assert_array_equal(batch.obs_t.frames[:4, 0, 0, ::3], [[0, 10, 20, 30]] + [[10, 20, 30, 40]] * 3)
    assert set(np.flatnonzero(replayed.leaves())) == set(slots.tolist())


def test_rewards_are_scaled_and_actions_masked_by_task_when_they_are_read():
    masks = ((True, True, False), (False, True, True))
    spec = make_spec(num_lanes=2, discount=0.5, num_tasks=2, reward_scales=(3.0, 0.25), action_masks=masks)
    replayed = Replay(spec)
    for lane in range(2):
        replayed.add([record(lane, reward=r, first=t == 0, task=lane) for t, r in enumerate([0, 1, 2, 4, 8])])
    batch = jax.jit(replay._transitions, static_argnums=0)(spec, replayed.state, jnp.array([0, 1, 50, 51]))
    np.testing.assert_array_equal(batch.r_t, [3 * 3, 3 * 6, 3 / 4, 6 / 4])
    np.testing.assert_array_equal(replayed.state.store.reward[:5], [0, 1, 2, 4, 8])
    for obs in (batch.obs_tm1, batch.obs_t):
        np.testing.assert_array_equal(obs.mask, np.repeat(masks, 2, axis=0))


def test_new_transitions_enter_with_the_largest_priority_ever():
    replayed = Replay(make_spec())
    replayed.add([record(first=t == 0) for t in range(8)])
    assert set(replayed.leaves()) == {0, 1}
    replayed.update([2, 3], [9.0, 0.5])
    replayed.update([2], [0.0])
    replayed.add([record()])
    largest, small, smaller = (np.float32(x + 0.01) ** np.float32(0.6) for x in (9.0, 0.5, 0.0))
    np.testing.assert_allclose(replayed.leaves()[:9], [1, 1, smaller, small, 1, largest, 0, 0, 0], rtol=1e-6)
    assert float(replayed.state.max_priority) == pytest.approx(largest)


def test_a_repeated_slot_takes_its_largest_error():
    replayed = Replay(make_spec())
    replayed.add([record(first=t == 0) for t in range(8)])
    replayed.update([1, 1, 1], [0.5, -3.0, 1.0])
    assert replayed.leaves()[1] == pytest.approx(3.01**0.6)


def test_an_overwritten_slot_stays_undrawable():
    """A batch drawn before the write head came along must not bring its slots back to life."""
    replayed = Replay(make_spec(num_lanes=1, capacity=20))
    replayed.add([record(first=t == 0) for t in range(20)])
    assert replayed.leaves()[3] > 0
    replayed.add([record()] * 2)
    replayed.update([0, 1, 3, 4, 19, 10], [9.0] * 5 + [5.0])
    assert set(np.flatnonzero(replayed.leaves())) == {*range(5, 19)}, "0..4 read frames 0 and 1; 19 has no window yet"
    assert float(replayed.state.max_priority) == pytest.approx(5.01**0.6), "of what can be drawn"


def test_a_stack_that_begins_after_the_write_head_stays_drawable():
    replayed = Replay(make_spec(num_lanes=1, capacity=20))
    replayed.add([record(first=t in (0, 2), terminated=t == 1) for t in range(20)])
    replayed.add([record()])
    assert set(np.flatnonzero(replayed.leaves())) == {*range(2, 18)}, "2 begins an episode, 0 was overwritten"


def test_weights_by_hand():
    """Priorities 1 and 4 in ratio 3:1 -> P = 1/7, 4/7; weights (1 / N P)^beta over their maximum."""
    spec = make_spec(priority_exponent=1.0, min_priority=1e-8)
    replayed = Replay(spec)
    replayed.add([record(first=t == 0) for t in range(7)])
    replayed.update([0, 1, 2, 3], [1.0, 1.0, 1.0, 4.0])
    _, info = replayed.sample(is_exponent=0.5)
    np.testing.assert_allclose(info.probabilities, np.where(info.slots == 3, 4 / 7, 1 / 7), rtol=1e-6)
    np.testing.assert_allclose(info.weights, np.where(info.slots == 3, 0.5, 1.0), rtol=1e-6)
    _, info = replayed.sample(is_exponent=0.0)
    np.testing.assert_array_equal(info.weights, 1)


def test_uniform_sampling_is_uniform_and_takes_no_priorities():
    """Chi-square, fixed seed."""
    spec = make_spec(prioritized=False, num_lanes=2, capacity=60)
    replayed = Replay(spec, batch_size=1)
    replayed.add(list(itertools.islice(interleaved(np.random.default_rng(0), spec, 5), 200)))
    replayed.update([0, 1, 2], [100.0] * 3)
    drawable = np.flatnonzero(replayed.leaves())
    assert set(replayed.leaves()[drawable]) == {1}
    keys = jax.random.split(jax.random.key(0), 20_000)
    draw = jax.jit(jax.vmap(lambda key, state: replay.sample(spec, state, key, 1, 1.0)[1], in_axes=(0, None)))
    info = draw(keys, replayed.state)
    np.testing.assert_array_equal(info.weights, 1)
    counts = np.bincount(np.asarray(info.slots).ravel(), minlength=spec.num_slots)
    assert 0.001 < stats.chisquare(counts[drawable]).pvalue < 0.999


def test_the_newest_transitions_stand_at_the_tail_of_the_batch():
    """Lane 1 completes 0 and 1, then lane 0 completes 0; before there are three, drawn ones stand in."""
    spec = make_spec(num_newest=3, n_steps=2)
    replayed = Replay(spec, batch_size=8)
    replayed.add([record(1, first=t == 0) for t in range(4)])
    _, info = replayed.sample()
    assert set(info.slots.tolist()) == {33, 34}
    replayed.update([33], [50.0])
    replayed.add([record(0, first=t == 0) for t in range(3)])
    _, info = replayed.sample(is_exponent=1.0)
    assert sorted(info.slots[-3:].tolist()) == [0, 33, 34]
    np.testing.assert_array_equal(info.weights[-3:], 1)
    assert info.weights[:5].max() == 1
    np.testing.assert_array_equal(info.probabilities[-3:], 1)


def test_a_newest_transition_that_was_overwritten_is_in_no_batch():
    """Streams that break off after their first record put nothing newer in its place."""
    replayed = Replay(make_spec(num_lanes=2, capacity=40, n_steps=2, num_newest=3), batch_size=8)
    replayed.add([record(0, first=t == 0) for t in range(5)])
    replayed.add([record(0, first=True)] * 20)
    replayed.add([record(1, first=t == 0) for t in range(3)])
    _, info = replayed.sample()
    assert set(info.slots.tolist()) == {20}


def test_an_empty_replay_refuses_to_be_sampled():
    replayed = Replay(make_spec())
    replayed.add([record(first=t == 0) for t in range(3)])
    message = r"no complete transition among 3 records, nothing can be drawn; want learner.warmup_steps of at least 9"
    with pytest.raises(ConfigError, match=message):
        replay.check_can_sample(replayed.spec, replayed.state)
    assert np.isnan(replayed.sample()[1].weights).all(), "inside a jit the weights must spoil the loss"
    replayed.add([record()])
    replay.check_can_sample(replayed.spec, replayed.state)
    assert np.isfinite(replayed.sample()[1].weights).all()


def test_more_decisions_than_lanes_times_n_steps_always_hold_a_transition():
    spec = make_spec(num_lanes=4, capacity=400)
    for seed in range(30):
        replayed, decisions = Replay(spec), 0
        for one in interleaved(np.random.default_rng(seed), spec, 3):
            replayed.add([one])
            decisions += not one.last
            if decisions > spec.num_lanes * spec.n_steps:
                break
        replay.check_can_sample(replayed.spec, replayed.state)


def test_the_smallest_warmup_that_is_accepted_ends_with_a_transition_and_may_not_be_smaller():
    """The worst case: every game holds n_steps records, and any of them delivers the decision after them."""
    spec = make_spec(num_lanes=4, capacity=400, n_steps=3)
    smallest = spec.num_lanes * spec.n_steps
    limiter = RateLimiter(0.001, smallest, 1)
    for lane in range(spec.num_lanes):
        replayed = Replay(spec)
        replayed.add([record(other, first=t == 0) for other in range(spec.num_lanes) for t in range(spec.n_steps)])
        with pytest.raises(ConfigError, match="no complete transition among 12 records"):
            replay.check_can_sample(spec, replayed.state)
        replayed.add([record(lane)])
        replay.check_can_sample(spec, replayed.state)
        assert np.isfinite(replayed.sample()[1].weights).all()
    limiter.insert(smallest)
    assert limiter.num_updates_allowed() == 0, "however little an update costs"
    limiter.insert(1)
    assert limiter.num_updates_allowed() > 0


def test_memory_bill_is_exact():
    spec = make_spec(num_lanes=7, capacity=1000, num_newest=5)
    assert replay.memory_bytes(spec) == sum(leaf.nbytes for leaf in jax.tree.leaves(replay.init(spec)))
    thesis = make_spec(num_lanes=8, capacity=100_000, frame_shape=(84, 84, 3))
    assert 84 * 84 * 3 * 100_000 < replay.memory_bytes(thesis) < 1.002 * 84 * 84 * 3 * 100_000


def test_insertion_and_updates_are_done_in_place():
    """Buffers stay where they are, and what a call needs besides does not grow with the capacity."""
    replayed = Replay(make_spec())

    def addresses():
        return {leaf.unsafe_buffer_pointer() for leaf in (replayed.state.store.frames, replayed.state.tree.nodes)}

    replayed.add([record(first=True)])
    before = addresses()
    for _ in range(3):
        replayed.add([record()])
        replayed.update([0, 1], [1.0, 2.0])
        assert addresses() == before

    def step(spec, state, block, key):
        state = replay.add(spec, state, block)
        batch, info = replay.sample(spec, state, key, 8, 0.5)
        return replay.update_priorities(spec, state, info.slots, batch.r_t), (batch, info)

    (block,) = Ingest(replayed.spec, 16).arrays([step_block([record(first=True)])], params_version=0)
    scratch_bytes = []
    for capacity in (3_000, 30_000):
        spec = make_spec(num_newest=3, capacity=capacity)
        state = jax.eval_shape(lambda spec=spec: replay.init(spec))
        lowered = jax.jit(step, static_argnums=0, donate_argnums=1).lower(spec, state, block, jax.random.key(0))
        scratch_bytes.append(lowered.compile().memory_analysis().temp_size_in_bytes)
    assert scratch_bytes[1] - scratch_bytes[0] < 10_000, "an array that grows with the capacity is copied"


@pytest.mark.slow
def test_more_frame_bytes_than_int32_can_count():
    """2200 frames of 1 MiB: offsets into them pass 2^31."""
    spec = make_spec(num_lanes=1, capacity=2200, frame_shape=(1024, 1024, 1), stack_size=1, n_steps=1)
    replayed = Replay(spec, block_size=1, batch_size=2)
    heads = jnp.array([2197], jnp.int32)
    replayed.state = replace(replayed.state, store=replace(replayed.state.store, heads=heads))
    frames = [np.full(spec.frame_shape, value, np.uint8) for value in (7, 8, 9)]
    replayed.add([Record(f, f, 0, 0.0, 0, 0, 0, t == 0, False, False) for t, f in enumerate(frames)])
    batch, info = replayed.sample()
    np.testing.assert_array_equal(info.slots, [2197, 2198])
    np.testing.assert_array_equal(batch.obs_tm1.frames, np.stack(frames[:2]))
    np.testing.assert_array_equal(batch.obs_t.frames, np.stack(frames[1:]))


def test_what_does_not_fit_is_refused():
    with pytest.raises(ConfigError, match=r"replay.capacity: got 20 records over 3 games, 6 each; want at least 21"):
        make_spec(capacity=20)
    spec = make_spec(capacity=30)
    (block,) = Ingest(make_spec(), 5).arrays([step_block([record(first=True)] * 5)], params_version=0)
    message = r"replay.add: got a block of 5 records, want at most 4 with 10 slots a game, observations of 4 records"
    with pytest.raises(ValueError, match=message):
        replay.add(spec, replay.init(spec), block)
    newest = make_spec(num_newest=8)
    with pytest.raises(ValueError, match=r"replay.sample: got num_newest 8, want less than batch size 8"):
        replay.sample(newest, replay.init(newest), jax.random.key(0), 8, 1.0)
