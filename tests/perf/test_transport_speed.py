"""Speed of the transport: ring against memcpy, parameter queue with 8 readers against memcpy.

`extra_info` holds the rates; the goals are at least half of memcpy's bandwidth for the ring, and at most twice the
time of one memcpy for a publication.
"""

import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
import pytest
from pytest_benchmark.fixture import BenchmarkFixture

from gvz.transport.broadcast import BroadcastWriter
from gvz.transport.messages import ParamsHeader
from gvz.transport.ring import RingReader

SHAPE, NUM_FRAMES = (84, 84, 3), 64
NUM_PARAMS = 6_728_248
"""of the default Rainbow agent with 3 actions"""


class Memcpy:
    """Times copies of an array into warm memory, one between any two measured calls: both see the same machine."""

    def __init__(self, source: np.ndarray):
        self._source, self._target, self._times = source, source.copy(), []

    def __call__(self) -> None:
        start = time.perf_counter()
        self._target[...] = self._source
        self._times.append(time.perf_counter() - start)

    def median_s(self) -> float:
        return float(np.median(self._times))


@pytest.mark.parametrize("side", ["write", "read"])
def test_ring(benchmark: BenchmarkFixture, side: str):
    """One block of 64 records in, or out."""
    reader = RingReader.create("gvz-perf", 2 * NUM_FRAMES, SHAPE)
    writer = reader.writer()
    frames = np.random.default_rng(0).integers(0, 256, (NUM_FRAMES, *SHAPE), np.uint8)

    memcpy = Memcpy(frames)

    def write() -> None:
        steps, slots = writer.reserve(NUM_FRAMES)
        steps["lane"] = 3
        slots[...] = frames
        writer.commit()

    def drain() -> None:
        reader.read(2 * NUM_FRAMES)

    def both(first: Callable[[], None], second: Callable[[], None]) -> None:
        first()
        second()

    try:
        for _ in range(4):  # touch every page
            write()
            drain()
        if side == "write":
            benchmark.pedantic(write, setup=lambda: both(drain, memcpy), rounds=50)
        else:
            benchmark.pedantic(drain, setup=lambda: both(write, memcpy), rounds=50)
        if benchmark.stats is not None:
            median_s = benchmark.stats["median"]
            benchmark.extra_info["frames_per_s"] = NUM_FRAMES / median_s
            benchmark.extra_info["share_of_memcpy"] = memcpy.median_s() / median_s
    finally:
        reader.close()


_READER = """
import sys
from gvz.transport.broadcast import BroadcastReader
reader = BroadcastReader.attach(int(sys.argv[1]), int(sys.argv[2]), 0)
print("attached", flush=True)
while True:
    newest = reader.read()
    if newest is not None and newest[1].num_updates:
        break
"""


@pytest.mark.parametrize("num_readers", [0, 8])
def test_broadcast(benchmark: BenchmarkFixture, num_readers: int):
    """One publication, while the readers copy as fast as they can."""
    writer = BroadcastWriter.create("gvz-perf", NUM_PARAMS, 0)
    command = [sys.executable, "-c", _READER, str(writer.descriptor), str(NUM_PARAMS)]
    inherited = [writer.descriptor]
    readers = [subprocess.Popen(command, stdout=subprocess.PIPE, pass_fds=inherited) for _ in range(num_readers)]
    params = np.ones(NUM_PARAMS, np.float32)
    header = ParamsHeader(version=1, num_updates=0)
    memcpy = Memcpy(params)
    try:
        for reader in readers:
            assert reader.stdout is not None
            assert reader.stdout.readline() == b"attached\n"
        for _ in range(3):
            writer.publish(params, header)

        def copy_first() -> tuple[tuple[np.ndarray, ParamsHeader], dict[str, object]]:
            memcpy()
            return (params, header), {}

        benchmark.pedantic(writer.publish, setup=copy_first, rounds=30)
        if benchmark.stats is not None:
            benchmark.extra_info["memcpies"] = benchmark.stats["median"] / memcpy.median_s()
        writer.publish(params, ParamsHeader(version=2, num_updates=1))
        assert [reader.wait(60) for reader in readers] == [0] * num_readers
    finally:
        for reader in readers:
            reader.kill()
            reader.communicate()
        writer.close()
