"""Fuzz targets: what comes from another process. Control messages and their channel, rings, the parameter queue, and
batches from other machines.

Imports gvz.transport, gvz.cluster.wire, learner for rings. Segments are real ones; then their bytes are overwritten.
"""

import contextlib
import os
import socket
import struct
from pathlib import Path
from typing import get_type_hints

import numpy as np

from gvz.cluster import wire
from gvz.core.errors import TransportError, WaitTimeoutError
from gvz.transport import broadcast
from gvz.transport.broadcast import BroadcastReader, BroadcastWriter
from gvz.transport.channel import MAX_MESSAGE_BYTES, Channel
from gvz.transport.messages import (
    ActorSpec,
    Assign,
    Decision,
    Decisions,
    EpisodeStats,
    Fault,
    Outcome,
    Outcomes,
    ParamsHeader,
    Ready,
    Render,
    Screen,
    StepBlock,
    Stop,
    VectorSpec,
    decode,
    encode,
    step_dtype,
)
from gvz.transport.ring import RingReader, WriterState
from gvz.transport.segment import HEADER_BYTES, Segment
from tests.fuzz.target import Target

CAPACITY, FRAME_SHAPE, NUM_PARAMS, LAYOUT = 8, (2, 2, 1), 3, 0x1234
WORDS = [struct.pack("<Q", n) for n in (0, 1, 7, 8, 9, 2**31, 2**32, 2**63, 2**64 - 1, 2**64 - 8)]
WORDS += [struct.pack("<d", x) for x in (float("nan"), -1.0, 1e300)] + [struct.pack("<f", float("inf"))]

MESSAGES = [
    EpisodeStats(
        lane=1,
        task=0,
        episode=2,
        seed=3,
        score=4.5,
        reward=-1.0,
        reward_components={"kill": 1.0},
        length_frames=40,
        length_steps=10,
        params_version=7,
        terminated=True,
        truncated=False,
    ),
    Ready(actor=1, pid=2),
    Fault(actor=1, lane=None, kind="exception", message="m", traceback="t"),
    Stop(),
    Assign(lane=1, task=2),
    ActorSpec(
        actor=0,
        lanes=[0, 1],
        lane_tasks=[0, 0],
        tasks=("a/b",),
        first_episodes=[0, 5],
        seed=9,
        env_entry_point="m:f",
        env_config={"k": [1, None]},
        frame_shape=(2, 2, 1),
        stack_size=4,
        past_actions=2,
        variables=("HEALTH",),
        num_extras=1,
        action_masks=((True, False, True),),
        num_actions=3,
        policy=b"\0\1",
        ring_capacity=8,
        core=None,
        num_params=3,
        layout_hash=2**64 - 1,
        work_dir="/x",
    ),
    VectorSpec(
        worker=0,
        games=[0, 1],
        tasks=["a/b", "a/c"],
        num_envs=4,
        num_workers=2,
        env_config={"k": [1, None]},
        options={"render_mode": None},
        same_step=True,
        answer_after=2,
    ),
    Decisions(decisions=[Decision(0, 1, None, 5), Decision(1, 0, 2, 6)]),
    Outcomes(outcomes=[Outcome(0, 0.5, False, True, {"score": 1.0}, {"score": 2.0})]),
    Render(),
    Screen(b"\0\1"),
]


def message(_directory: Path) -> Target:
    """A control message."""

    def run(data: bytes) -> bool:
        try:
            heard = decode(data)
        except TransportError:
            return False
        assert decode(encode(heard)) == heard
        hints = get_type_hints(type(heard))
        for name in heard.__struct_fields__:
            assert hints[name] not in (int, str, bool, bytes) or type(getattr(heard, name)) is hints[name]
        return True

    names = sorted({name for one in MESSAGES for name in (one.__struct_config__.tag, *one.__struct_fields__)})
    words = [bytes([0xA0 + len(name)]) + name.encode() for name in names if len(name) < 32]
    words += [b"\xc0", b"\xc2", b"\xc3", b"\xcb\x7f\xf8" + bytes(6), b"\xd3" + b"\xff" * 8]
    words += [b"\xdd\xff\xff\xff\xff", b"\x91" * 600]
    return Target(run=run, seeds=[encode(one) for one in MESSAGES], words=words)


def batch(_directory: Path) -> Target:
    """A batch of step records from a host of a cluster."""
    steps = np.zeros(5, step_dtype(1))
    steps["lane"] = [0, 0, 1, 1, 3]
    blocks = [StepBlock(steps, np.arange(20, dtype=np.uint8).reshape(5, *FRAME_SHAPE))]
    header = wire.BatchHeader(run_id="r", host=1, incarnation=2, number=3)

    def run(data: bytes) -> bool:
        try:
            taken = wire.unpack(data, steps.dtype, FRAME_SHAPE, 64)
        except TransportError:
            return False
        assert taken.block.frames.shape == (len(taken), *FRAME_SHAPE)
        assert taken.block.steps.shape == (len(taken),) <= (64,)
        return True

    seeds = [wire.pack(header, MESSAGES[:3], blocks, compress=compress) for compress in (True, False)]
    names = [bytes([0xA0 + len(name)]) + name.encode() for name in wire.BatchHeader.__struct_fields__]
    return Target(run=run, seeds=[*seeds, wire.pack(header, [], [], compress=True)], words=WORDS + names)


def channel(_directory: Path) -> Target:
    """A stream of framed messages that comes in two pieces, then ends."""

    def run(data: bytes) -> bool:
        ours, theirs = socket.socketpair()
        received, sent = Channel(ours, peer="the peer"), 0
        try:
            with theirs:
                for piece in (data[: len(data) // 2], data[len(data) // 2 :]):
                    theirs.sendall(piece)
                    sent += len(received.receive())
            sent += len(received.receive())
            assert received.closed
            assert sent <= len(data) / 4
        except TransportError:
            return False
        finally:
            received.close()
        return True

    def frame(data: bytes) -> bytes:
        return struct.pack("<I", len(data)) + data

    whole = [frame(encode(one)) for one in MESSAGES]
    lengths = [struct.pack("<I", n) for n in (0, 1, MAX_MESSAGE_BYTES, MAX_MESSAGE_BYTES + 1, 2**32 - 1)]
    return Target(run=run, seeds=[b"".join(whole), *whole], words=lengths)


def ring(_directory: Path) -> Target:
    """A ring's control words and records: by its reader with what follows it, and by its writer."""
    from learner.ingest import Ingest
    from learner.replay import ReplaySpec

    reader = RingReader.create("gvz-fuzz", CAPACITY, FRAME_SHAPE)
    writer, payload = reader.writer(), reader._segment.payload
    writer.beat(WriterState.ACTING)
    steps, frames = writer.reserve(4)
    for field, values in {"lane": 0, "episode": 3, "first": [1, 0, 0, 0], "terminated": [0, 0, 0, 1], "pad": 0}.items():
        steps[field] = values
    for field in ("params_version", "action", "reward", "task", "truncated"):
        steps[field] = 0
    frames[:] = 7
    writer.commit()
    image = bytes(payload)
    spec = ReplaySpec(
        num_lanes=2,
        capacity=64,
        frame_shape=FRAME_SHAPE,
        num_tasks=2,
        stack_size=2,
        n_steps=2,
        discount=0.9,
        priority_exponent=0.5,
        min_priority=0.01,
        prioritized=True,
        num_newest=0,
    )

    def read() -> None:
        status = reader.writer_status()
        assert status.waited_for_space_s >= 0
        first = reader._words[8]
        block = reader.read(64)
        assert block.steps["sequence"].tolist() == list(range(first, first + len(block)))
        assert reader.num_unread + len(block) <= CAPACITY
        arrays = list(Ingest(spec).arrays([block], params_version=5))
        assert sum(int(part.num_valid) for part in arrays) == len(block)
        assert all(np.isfinite(part.reward).all() for part in arrays)
        assert all((part.lane < 2).all() and (part.task < 2).all() for part in arrays)

    def write() -> None:
        successor = reader.writer()
        successor.wait_for_space(CAPACITY, timeout_s=0.0)
        successor.reserve(1)
        successor.commit()
        assert 0 <= successor.free < CAPACITY

    def run(data: bytes) -> bool:
        taken = False
        for side in (read, write):
            payload[:] = image
            payload[: min(len(data), len(image))] = data[: len(image)]
            with contextlib.suppress(TransportError, WaitTimeoutError):
                side()
                taken = True
        return taken

    return Target(run=run, seeds=[image], once_broken=[b"\xff" * 72], words=WORDS, max_bytes=len(image))


def parameter_queue(_directory: Path) -> Target:
    """The control words and slots of the queue of parameters."""
    writer = BroadcastWriter.create("gvz-fuzz", NUM_PARAMS, LAYOUT)
    segment = writer._segment
    image = bytes(segment.payload)
    images = [image]
    for version in range(4):
        header = ParamsHeader(version=version, num_updates=10 * version, epsilon=0.5, layout_hash=LAYOUT)
        writer.publish(np.full(NUM_PARAMS, version, np.float32), header)
        images.append(bytes(segment.payload))

    def run(data: bytes) -> bool:
        segment.payload[:] = image
        segment.payload[: min(len(data), len(image))] = data[: len(image)]
        reader = BroadcastReader(segment, NUM_PARAMS, LAYOUT)
        patience, broadcast._READ_TIMEOUT_S = broadcast._READ_TIMEOUT_S, 0.001  # a damaged ticket is waited for in vain
        try:
            for _ in range(2):
                if (found := reader.read()) is not None:
                    params, newest = found
                    assert (params.shape, params.dtype) == ((NUM_PARAMS,), np.float32)
                    assert 0 <= newest.epsilon <= 1
        except (TransportError, WaitTimeoutError):
            return False
        finally:
            broadcast._READ_TIMEOUT_S = patience
        return True

    return Target(run=run, seeds=images, words=WORDS, max_bytes=len(image))


def segment_header(_directory: Path) -> Target:
    """A whole segment of shared memory, its header included, as it is attached to."""
    segment = Segment.create("gvz-fuzz", 64, layout_hash=LAYOUT)
    image = os.pread(segment.descriptor, HEADER_BYTES + 64, 0)
    file = os.memfd_create("gvz-fuzz")  # of any size: a segment's own is fixed
    segment.close()

    def run(data: bytes) -> bool:
        os.ftruncate(file, 0)
        os.pwrite(file, data, 0)
        try:
            attached = Segment.attach(file, 64, layout_hash=LAYOUT)
        except TransportError:
            return False
        assert data[: 4 * 8] == image[: 4 * 8]
        assert bytes(attached.payload) == data[HEADER_BYTES:]
        attached.close()
        return True

    sizes = [struct.pack("<Q", n) for n in (64, 127, 128, 129)]
    seeds = [image, image + b"x", image[:-1], b""]
    return Target(run=run, seeds=seeds, words=[*WORDS, *sizes], close=lambda: os.close(file))
