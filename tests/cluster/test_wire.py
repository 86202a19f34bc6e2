"""Batches: what a host sends comes back whole, sorted by lane, and nothing else is taken for one."""

import dataclasses
from collections import deque
from itertools import cycle

import msgspec
import numpy as np
import pytest
import zstandard

from gvz.cluster import wire
from gvz.cluster.config import ClusterConfig
from gvz.core.errors import TransportError
from gvz.run.assemble import hosts_config
from gvz.run.config_files import load_config
from gvz.transport.messages import Ready, StepBlock, Stop, step_dtype
from learner.rollouts import Rollouts, RolloutSpec

SHAPE = (6, 5, 3)
HEADER = wire.BatchHeader(run_id="r", host=2, incarnation=1, number=7, actors_ready=3, waited_for_space_s=0.5)


def block(lanes: list[int], seed: int = 0, num_variables: int = 0) -> StepBlock:
    rng = np.random.default_rng(seed)
    steps = np.zeros(len(lanes), step_dtype(num_variables))
    steps["lane"], steps["sequence"] = lanes, np.arange(len(lanes))
    steps["vector"] = rng.random((len(lanes), num_variables))
    return StepBlock(steps, rng.integers(0, 256, (len(lanes), *SHAPE), np.uint8))


def unpack(data: bytes, max_records: int = 1000, num_variables: int = 0) -> wire.Batch:
    return wire.unpack(data, step_dtype(num_variables), SHAPE, max_records)


@pytest.mark.parametrize("compress", [True, False])
@pytest.mark.parametrize("num_variables", [0, 3])
def test_a_batch_comes_back_sorted_by_lane_and_in_order_within_one(compress, num_variables):
    lanes = np.random.default_rng(1).integers(0, 5, 200).tolist()
    blocks = [block(lanes[:150], 1, num_variables), block(lanes[150:], 2, num_variables)]
    batch = unpack(wire.pack(HEADER, [Ready(actor=1, pid=2), Stop()], blocks, compress=compress), 200, num_variables)
    order = np.argsort(lanes, kind="stable")
    joined = [np.concatenate([getattr(b, name) for b in blocks])[order] for name in ("steps", "frames")]
    np.testing.assert_array_equal(batch.block.steps, joined[0])
    np.testing.assert_array_equal(batch.block.frames, joined[1])
    assert batch.messages == [Ready(actor=1, pid=2), Stop()]
    assert (batch.header.host, batch.header.number, batch.header.waited_for_space_s) == (2, 7, 0.5)
    assert len(batch) == 200


def test_each_rollout_has_a_window_of_every_game_of_two_hosts():
    """A batch is sorted by game. With 300 records or more in it, rollouts had two windows of half of the games."""
    config = dataclasses.replace(load_config("ppo_quick"), cluster=ClusterConfig(address="10.0.0.1:6379", hosts=2))
    lanes, num_steps = config.num_lanes, config.learner.rollout_steps
    size, history = hosts_config(config).batch_records, 4
    spec = RolloutSpec(
        num_lanes=lanes, capacity=lanes * (history + num_steps), frame_shape=SHAPE, num_tasks=lanes, stack_size=history
    )
    rollouts, begun, waiting, hosts = Rollouts(spec), np.zeros(lanes, bool), deque[StepBlock](), cycle((0, 1))
    found = []
    while len(found) < 8:
        if not (allowed := rollouts.num_records_allowed()):
            found.append(np.bincount(rollouts.take(0).windows.task.reshape(lanes, -1)[:, -1], minlength=lanes))
            continue
        if not waiting:
            turn, game = np.divmod(np.arange(size), lanes // 2)
            mine = next(hosts) * (lanes // 2) + game
            made = block(mine.tolist())
            made.steps["task"] = mine
            made.steps["first"] = ~begun[mine] & (turn == 0)
            begun[mine] = True
            waiting.append(unpack(wire.pack(HEADER, [], [made], compress=False), size).block)
        came = waiting.popleft()
        rollouts.add([StepBlock(came.steps[:allowed], came.frames[:allowed])])
        if len(came) > allowed:
            waiting.append(StepBlock(came.steps[allowed:], came.frames[allowed:]))
    assert all((of_games == 1).all() for of_games in found), found


def test_a_batch_may_be_empty():
    batch = unpack(wire.pack(HEADER, [], [], compress=True))
    assert (len(batch), batch.block.frames.shape, batch.messages) == (0, (0, *SHAPE), [])


def test_what_was_taken_may_be_changed_and_kept():
    data = wire.pack(HEADER, [], [block([0, 1])], compress=False)
    batch = unpack(data)
    batch.block.frames[0] = 0
    batch.block.steps["lane"] = 3
    assert unpack(data).block.steps["lane"].tolist() == [0, 1]


def repacked(data: bytes, **changes) -> bytes:
    """The batch with another header."""
    header, at = wire.read_header(data)
    encoded = msgspec.msgpack.encode(msgspec.structs.replace(header, **changes))
    return wire._PREFIX.pack(wire.WIRE_VERSION, len(encoded)) + encoded + data[at:]


GOOD = wire.pack(HEADER, [Stop()], [block([0, 0, 1])], compress=True)
BOMB = zstandard.ZstdCompressor().compress(bytes(2**24))


@pytest.mark.parametrize(
    ("data", "text"),
    [
        (b"", "want version 1 in its first byte"),
        (b"\x02" + GOOD[1:], "want version 1 in its first byte"),
        (GOOD[:3], "want version 1"),
        (b"\x01\xff\xff\xff\xff" + GOOD[5:], "got a header of 4294967295 bytes"),
        (GOOD[:20], "got a header of"),
        (b"\x01\x01\x00\x00\x00\xc1", "batch of 6 bytes"),
        (GOOD + b"x", "blocks of frames, want"),
        (GOOD[:-1], "blocks of frames, want"),
        (repacked(GOOD, num_records=4), "want"),
        (repacked(GOOD, num_records=1001), "got 1001 records, want at most 1000"),
        (repacked(GOOD, num_records=2**60), "records, want at most 1000"),
        (repacked(GOOD, frame_bytes=[]), "with 0 blocks of frames, want"),
        (repacked(GOOD, compressed=False), "bytes of 3 frames, want 270"),
        (repacked(GOOD, messages=[b"\x00"]), "want schema"),
        (GOOD[:-8] + b"12345678", "a block of frames"),
        (
            repacked(wire.pack(HEADER, [], [], compress=True), num_records=1, frame_bytes=[len(BOMB)])
            + bytes(48)
            + BOMB,
            "got a block of 16777216 bytes, want 90",
        ),
    ],
)
def test_what_is_no_batch_is_named(data, text):
    with pytest.raises(TransportError, match=text):
        unpack(data)
