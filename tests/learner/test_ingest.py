"""Ingest: what comes out of real rings is what the replay stores; counts, checks, and memory that nobody reuses."""

import itertools
import json
import math
from dataclasses import replace

import jax
import numpy as np
import pytest

from gvz.core.errors import TransportError
from gvz.transport.messages import STEP_DTYPE, StepBlock
from gvz.transport.ring import RingReader, RingWriter
from learner import replay, store
from learner.ingest import Ingest, Staleness
from learner.replay import ReplaySpec
from tests.oracles import Record, ReplayOracle, check_batch, play, step_block

SPEC = ReplaySpec(
    num_lanes=4,
    capacity=400,
    frame_shape=(4, 5, 3),
    num_tasks=3,
    stack_size=4,
    n_steps=3,
    discount=0.99,
    priority_exponent=0.6,
    min_priority=0.01,
    prioritized=True,
    num_newest=0,
)
jitted_add = jax.jit(replay.add, static_argnums=0, donate_argnums=1)
jitted_sample = jax.jit(replay.sample, static_argnums=(0, 3))


def some_records(num_records: int, *, lane: int = 0, seed: int = 0, **changes) -> list[Record]:
    records = itertools.islice(play(np.random.default_rng(seed), SPEC, lane, mean_steps=5), num_records)
    return [replace(record, **changes) for record in records]


def write(ring: RingWriter, record: Record) -> None:
    steps, frames = ring.reserve(1)
    block = step_block([record])
    for name in set(STEP_DTYPE.names or ()) - {"sequence"}:
        steps[name] = block.steps[name]
    frames[:] = block.frames
    ring.commit()


def test_streams_through_real_rings_are_drawn_as_the_actors_saw_them():
    """Two actors of two lanes each, small rings that wrap and fill, and an actor that dies and has a successor."""
    rng = np.random.default_rng(0)
    rings = [RingReader.create("gvz-test", 24, SPEC.frame_shape) for _ in range(2)]
    try:
        writers = [RingWriter.attach(ring.descriptor, 24, SPEC.frame_shape) for ring in rings]
        streams = [play(rng, SPEC, lane, mean_steps=8) for lane in range(4)]
        ingest, oracle, state = Ingest(SPEC, block_size=16), ReplayOracle(SPEC), replay.init(SPEC)
        decisions = 0
        for round_ in range(150):
            for actor, writer in enumerate(writers):
                for _ in range(int(rng.integers(0, writer.free + 1))):
                    record = next(streams[2 * actor + rng.integers(2)])
                    write(writer, record)
                    oracle.add(record)
                    decisions += not record.last
            if round_ == 70:  # killed while it filled a slot; its successor begins new episodes
                if writers[0].free:
                    writers[0].reserve(1)[1][:] = 255
                writers[0].close()
                writers[0] = RingWriter.attach(rings[0].descriptor, 24, SPEC.frame_shape)
                streams[:2] = [play(rng, SPEC, lane, mean_steps=8) for lane in range(2)]
            blocks = [ring.read(1000) for ring in rings]
            for arrays in ingest.arrays(blocks, params_version=0):
                state = jitted_add(SPEC, state, arrays)
            if not oracle.drawable():
                continue
            batch, info = jax.device_get(jitted_sample(SPEC, state, jax.random.key(round_), 16, 1.0))
            want = [oracle.transition(slot) for slot in info.slots.tolist()]
            check_batch(batch, want)
        assert sum(map(len, oracle.streams)) > 2_000
        assert ingest.take_env_steps() == decisions
        assert ingest.take_env_steps() == 0
    finally:
        for end in (*writers, *rings):
            end.close()


def test_all_records_come_out_in_order_in_arrays_of_one_shape():
    blocks = [step_block(some_records(n, lane=lane, seed=lane)) for lane, n in enumerate((5, 16, 1, 29))]
    blocks.insert(1, StepBlock(steps=blocks[0].steps[:0], frames=blocks[0].frames[:0]))
    packed = list(Ingest(SPEC, block_size=16).arrays(blocks, params_version=0))
    assert [int(arrays.num_valid) for arrays in packed] == [16, 16, 16, 3]
    shapes = {tuple((leaf.shape, leaf.dtype) for leaf in jax.tree.leaves(arrays)) for arrays in packed}
    assert len(shapes) == 1, "another shape compiles anew"
    for name in ("action", "reward", "lane", "task", "first", "terminated", "truncated"):
        got = np.concatenate([getattr(arrays, name)[: arrays.num_valid] for arrays in packed])
        np.testing.assert_array_equal(got, np.concatenate([block.steps[name] for block in blocks]))
    got = np.concatenate([arrays.frames[: arrays.num_valid] for arrays in packed])
    np.testing.assert_array_equal(got, np.concatenate([block.frames for block in blocks]))
    assert list(Ingest(SPEC).arrays([], params_version=0)) == []


def test_blocks_are_no_larger_than_the_replay_takes_at_once():
    spec = replace(SPEC, capacity=60)
    packed = list(Ingest(spec).arrays([step_block(some_records(20))], params_version=0))
    assert {len(arrays.action) for arrays in packed} == {15 - 4 - 3 + 1}
    state = replay.init(spec)
    for arrays in packed:
        state = jitted_add(spec, state, arrays)
    assert int(store.records_per_task(spec, state.store).sum()) == 15


def test_memory_that_was_handed_on_is_never_written_again():
    """JAX may hold the very memory of these arrays: the source is scribbled over, more is packed, all before use."""
    ingest, records = Ingest(SPEC, block_size=8), some_records(40)
    packed = []
    for start in range(0, 40, 8):
        block = step_block(records[start : start + 8])
        packed += ingest.arrays([block], params_version=0)
        block.frames[:], block.steps["reward"] = 0, -1
    frames = [arrays.frames for arrays in packed]
    assert not any(np.shares_memory(a, b) for a, b in itertools.combinations(frames, 2))
    held = [jax.device_put(arrays) for arrays in packed]
    list(ingest.arrays([step_block(some_records(8, lane=1))], params_version=0))
    np.testing.assert_array_equal(np.concatenate([h.frames for h in held]), np.stack([r.frame for r in records]))
    np.testing.assert_array_equal(
        np.concatenate([h.reward for h in held]), np.float32([record.reward for record in records])
    )


def test_staleness_is_the_distribution_over_decisions():
    """Versions 10 (once), 9 (18 times) and 3 (once) of 12; an episode's last record is no decision."""
    records = [replace(some_records(1)[0], terminated=False, truncated=False, first=t == 0) for t in range(21)]
    versions = [10, *[9] * 18, 3, 0]
    records = [replace(r, params_version=v) for r, v in zip(records, versions, strict=True)]
    records[-1] = replace(records[-1], terminated=True)
    ingest = Ingest(SPEC)
    list(ingest.arrays([step_block(records)], params_version=12))
    assert ingest.take_staleness() == Staleness(mean=(2 + 18 * 3 + 9) / 20, p95=3, max=9)
    assert ingest.take_staleness() == Staleness(mean=0.0, p95=0, max=0)
    assert ingest.take_env_steps() == 20


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lane": 4}, "ingest: record 7: got lane 4, want less than 4; actors and learner were started with different"),
        ({"task": 3}, "ingest: record 7: got task 3, want less than 3; actors and learner were started with different"),
        ({"reward": math.nan}, "ingest: record 7 of lane 0: got the reward nan, want a finite one"),
        ({"reward": -math.inf}, "ingest: record 7 of lane 0: got the reward -inf, want a finite one"),
        ({"vector": (0.0, math.inf)}, r"ingest: record 7 of lane 0: got the vector \[ 0\. inf\], want a finite one"),
        ({"extras": (math.nan,)}, r"ingest: record 7 of lane 0: got the extras \[nan\], want a finite one"),
        ({"first": False}, "ingest: record 7 of lane 0 neither begins an episode nor continues one; records before it"),
        (
            {"params_version": 6},
            "ingest: got an action of parameters version 6, but 5 is the newest that was published",
        ),
        (
            {"frame": np.zeros((4, 5, 1), np.uint8)},
            r"ingest: got frames uint8\[4, 5, 1\], want uint8\[4, 5, 3\]; actors and learner were started with",
        ),
    ],
)
def test_a_record_of_another_run_or_stream_is_refused(changes, message):
    good = replace(some_records(1)[0], terminated=False, truncated=False)
    record = replace(good, **changes)
    spec = replace(SPEC, num_variables=len(record.vector), num_extras=len(record.extras))
    with pytest.raises(TransportError, match=message):
        list(Ingest(spec).arrays([step_block([record], sequence=7)], params_version=5))


def test_a_stream_goes_on_across_blocks_and_ends_with_its_last_record():
    begin = replace(some_records(1)[0], terminated=False, truncated=False)
    middle, end = replace(begin, first=False), replace(begin, first=False, truncated=True)
    ingest = Ingest(SPEC)
    for record in (begin, middle, end, begin, begin, end):  # the third beginning cuts the second episode
        list(ingest.arrays([step_block([record])], params_version=0))
    with pytest.raises(TransportError, match="record 0 of lane 0 neither begins"):
        list(ingest.arrays([step_block([middle])], params_version=0))


def test_a_restored_ingest_goes_on_in_mid_episode():
    begin = replace(some_records(1)[0], terminated=False, truncated=False)
    middle = step_block([replace(begin, first=False)])
    first, second = Ingest(SPEC), Ingest(SPEC)
    list(first.arrays([step_block([begin])], params_version=0))
    with pytest.raises(TransportError, match="neither begins an episode nor continues one"):
        list(second.arrays([middle], params_version=0))
    second.restore(json.loads(json.dumps(first.state())))
    list(second.arrays([middle], params_version=0))
    assert second.take_env_steps() == 1
