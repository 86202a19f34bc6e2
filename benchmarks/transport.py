"""The transport against memcpy: step records through a ring, parameters through the broadcast queue to 8 readers.

Ring: blocks of 64 records with frames of 84x84x3, in and out in one process (each is one copy), and as a stream from a
writer in another process. Queue: the full parameter vector, published with a pause in which every reader takes its
copy, and without pauses, while all readers copy. Goals: a ring's block goes in and comes out with at least half of
memcpy's bandwidth; a publication takes at most twice as long as one memcpy of the vector. `whole` measures the age of
the acting parameters.
"""

import contextlib
import dataclasses
import itertools
import statistics
import time
from collections.abc import Callable
from functools import partial

import numpy as np

from benchmarks.remote import Remote
from benchmarks.rounds import Budget, Row, alternate, goal, measured, ratios, seconds_per_call
from gvz.transport.broadcast import BroadcastWriter
from gvz.transport.messages import ParamsHeader
from gvz.transport.ring import RingReader

SHAPE, NUM_FRAMES = (84, 84, 3), 64
BLOCK_BYTES = NUM_FRAMES * 84 * 84 * 3
NUM_PARAMS = 6_728_248
"""of the default Rainbow agent with 3 actions"""
NUM_READERS = 8
_PAUSE_S = 0.1
"""long enough for every reader to copy the last version, even on two cores"""


def measure(budget: Budget) -> list[Row]:
    """Bandwidths and times in alternating rounds, and the ratios of the goals."""
    budget = dataclasses.replace(budget, body_s=budget.body_s / 2.5)  # a copy takes milliseconds
    with contextlib.ExitStack() as stack:
        ring = alternate(budget.rounds, _ring_bodies(stack, budget))
    with contextlib.ExitStack() as stack:
        queue = alternate(budget.rounds, _queue_bodies(stack, budget))
    memcpy = ring["memcpy"]
    return [
        *(measured(f"{name}, blocks of {NUM_FRAMES} frames", "GB/s", found) for name, found in ring.items()),
        *(measured(f"{name}, {4 * NUM_PARAMS / 1e6:.0f} MB", "ms", [1e3 * s for s in f]) for name, f in queue.items()),
        goal(3, "ring, in, against memcpy", ratios(ring["ring, in"], memcpy), at_least=0.5, unit="x"),
        goal(3, "ring, out, against memcpy", ratios(ring["ring, out"], memcpy), at_least=0.5, unit="x"),
        *(
            goal(3, f"{name}, against memcpy", ratios(queue[name], queue["memcpy"]), at_most=2.0, unit="x")
            for name in queue
            if name != "memcpy"
        ),
    ]


def _ring_bodies(stack: contextlib.ExitStack, budget: Budget) -> dict[str, Callable[[], float]]:
    """GB/s of memcpy, of a block in, of a block out, and of a stream between two processes."""
    reader = RingReader.create("gvz-bench", 4 * NUM_FRAMES, SHAPE)
    stack.callback(reader.close)
    writer = reader.writer()
    frames = np.random.default_rng(0).integers(0, 256, (NUM_FRAMES, *SHAPE), np.uint8)
    targets = itertools.cycle([frames.copy() for _ in range(4)])  # as many blocks as the ring holds

    def write() -> None:
        steps, slots = writer.reserve(NUM_FRAMES)
        steps["lane"] = 3
        slots[...] = frames
        writer.commit()

    calls = {
        "ring, in": write,
        "memcpy": lambda: np.copyto(next(targets), frames),
        "ring, out": lambda: reader.read(NUM_FRAMES),
    }

    def bandwidth(name: str) -> float:
        """The bandwidth of one call. All calls run in turn, so that each finds the caches in the same state."""
        times, start = [], time.perf_counter()
        while not times or time.perf_counter() - start < budget.body_s:
            for called, call in calls.items():
                before = time.perf_counter()
                call()
                if called == name:
                    times.append(time.perf_counter() - before)
        return BLOCK_BYTES / statistics.median(times) / 1e9

    streamed = RingReader.create("gvz-bench", 4 * NUM_FRAMES, SHAPE)
    stack.callback(streamed.close)
    arguments = str(streamed.descriptor), str(4 * NUM_FRAMES), str(NUM_FRAMES)
    source = stack.enter_context(Remote("ring_writer", *arguments, pass_fds=[streamed.descriptor]))

    def stream() -> float:
        count, start = 0, time.perf_counter()
        source.ask(seconds=budget.body_s)
        while time.perf_counter() - start < budget.body_s:
            count += len(streamed.read(NUM_FRAMES))
        elapsed_s = time.perf_counter() - start
        while streamed.num_unread or not source.has_answered():  # the writer's last block must find room
            streamed.read(NUM_FRAMES)
        source.answer()
        return count * BLOCK_BYTES / NUM_FRAMES / elapsed_s / 1e9

    return {**{name: partial(bandwidth, name) for name in calls}, "ring, between two processes": stream}


def _queue_bodies(stack: contextlib.ExitStack, budget: Budget) -> dict[str, Callable[[], float]]:
    """Seconds of a memcpy of the vector and of a publication, with the readers done or copying."""
    writer = BroadcastWriter.create("gvz-bench", NUM_PARAMS, 0)
    stack.callback(writer.close)
    params, header = np.ones(NUM_PARAMS, np.float32), ParamsHeader(version=1, num_updates=0)
    targets = itertools.cycle([params.copy() for _ in range(3)])  # as many vectors as the queue holds
    arguments = str(writer.descriptor), str(NUM_PARAMS)
    readers = [
        stack.enter_context(Remote("params_reader", *arguments, pass_fds=[writer.descriptor]))
        for _ in range(NUM_READERS)
    ]

    def paused(call: Callable[[], object]) -> float:
        times, start = [], time.perf_counter()
        while not times or time.perf_counter() - start < budget.body_s:
            time.sleep(_PAUSE_S)
            before = time.perf_counter()
            call()
            times.append(time.perf_counter() - before)
        return statistics.median(times)

    def reading(body: Callable[[], float]) -> float:
        for reader in readers:
            reader.ask(seconds=budget.body_s)
        found = body()
        for reader in readers:
            reader.answer()
        return found

    def publish() -> None:
        writer.publish(params, header)

    return {
        "memcpy": lambda: reading(lambda: paused(lambda: np.copyto(next(targets), params))),
        "publication, readers done": lambda: reading(lambda: paused(publish)),
        "publication, readers copying": lambda: reading(lambda: seconds_per_call(publish, budget.body_s)),
    }
