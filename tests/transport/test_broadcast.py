"""The parameter queue: whole versions only, and a writer that never waits."""

import math
import mmap
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gvz.core.errors import TransportError, WaitTimeoutError
from gvz.transport import broadcast
from gvz.transport.broadcast import BroadcastReader, BroadcastWriter, broadcast_bytes
from gvz.transport.messages import ParamsHeader
from gvz.transport.segment import HEADER_BYTES
from tests.waiting import make_pause

NUM_PARAMS, LAYOUT = 1000, 0xABCDEF


@pytest.fixture
def writer() -> Iterator[BroadcastWriter]:
    queue = BroadcastWriter.create("gvz-test", NUM_PARAMS, LAYOUT)
    yield queue
    queue.close()


@pytest.fixture
def reader(writer: BroadcastWriter) -> BroadcastReader:
    return BroadcastReader.attach(writer.descriptor, writer.num_params, LAYOUT)


def words_of(queue: BroadcastWriter, start: int = 0, dtype: type = np.uint64) -> np.ndarray:
    return np.frombuffer(mmap.mmap(queue.descriptor, 0), dtype, 8, HEADER_BYTES + start)


def header(version: int, *, epsilon: float = 0.0) -> ParamsHeader:
    return ParamsHeader(version=version, num_updates=10 * version, epsilon=epsilon, layout_hash=LAYOUT)


def publish(writer: BroadcastWriter, version: int) -> None:
    writer.publish(np.full(writer.num_params, version, np.float32), header(version))


def read(reader: BroadcastReader) -> tuple[ParamsHeader, list[float]]:
    newest = reader.read()
    assert newest is not None
    return newest[1], newest[0].tolist()


def test_nothing_is_read_before_the_first_version(reader: BroadcastReader):
    assert reader.read() is None


def test_a_version_arrives_with_its_header_and_once(writer: BroadcastWriter, reader: BroadcastReader):
    params = np.random.default_rng(0).normal(size=NUM_PARAMS).astype(np.float32)
    sent = header(2**40, epsilon=0.1)
    writer.publish(params, sent)
    assert read(reader) == (sent, params.tolist())
    assert reader.read() is None


def test_a_slow_reader_skips_to_the_newest(writer: BroadcastWriter, reader: BroadcastReader):
    for version in range(11):
        publish(writer, version)
    assert read(reader) == (header(10), [10.0] * NUM_PARAMS)


def test_a_version_that_comes_during_a_copy_is_read_next(
    writer: BroadcastWriter, reader: BroadcastReader, monkeypatch: pytest.MonkeyPatch
):
    publish(writer, 1)
    fences = []

    def publish_in_between() -> None:
        fences.append(1)
        if len(fences) == 2:
            publish(writer, 2)

    monkeypatch.setattr(reader, "_fence", publish_in_between)
    assert [read(reader)[0], read(reader)[0]] == [header(1), header(2)]


def test_a_version_counts_when_it_is_whole(writer: BroadcastWriter):
    """A writer that dies before it counts leaves the version before to the readers."""
    ticket, found = words_of(writer, 64), []

    class Count(list[int]):
        def __setitem__(self, index, value):
            found.append((value, int(ticket[0])))

    writer._count = Count([0])
    publish(writer, 1)
    assert found == [(1, 2)], "the slot's ticket is even again"


def test_a_publication_that_was_interrupted_does_not_hide_the_next_ones(
    writer: BroadcastWriter, reader: BroadcastReader, monkeypatch: pytest.MonkeyPatch
):
    def interrupt() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(writer, "_fence", interrupt)
    with pytest.raises(KeyboardInterrupt):
        publish(writer, 1)
    assert reader.read() is None
    for version in range(1, 8):
        ticket, seen = writer._words[(version - 1) % 3], []
        monkeypatch.setattr(writer, "_fence", lambda ticket=ticket, seen=seen: seen.append(ticket[0] % 2))
        publish(writer, version)
        assert seen == [1, 1], "the ticket is odd while the slot is written"
        assert read(reader)[0] == header(version)


def test_what_was_read_is_the_readers_own(writer: BroadcastWriter, reader: BroadcastReader):
    publish(writer, 1)
    newest = reader.read()
    for version in range(2, 10):
        publish(writer, version)
    assert newest is not None
    assert (newest[0] == 1).all()
    assert newest[0].ctypes.data % 64 == 0


def test_every_reader_gets_every_version(writer: BroadcastWriter, reader: BroadcastReader):
    late = BroadcastReader.attach(writer.descriptor, NUM_PARAMS, LAYOUT)
    publish(writer, 3)
    assert read(reader) == read(late) == (header(3), [3.0] * NUM_PARAMS)


@pytest.mark.parametrize("params", [np.zeros(999, np.float32), np.zeros((10, 100), np.float32), np.zeros(1000)])
def test_other_parameters_are_refused(writer: BroadcastWriter, params: np.ndarray):
    with pytest.raises(ValueError, match=r"got float\d\d\[.*\], want float32\[1000\]"):
        writer.publish(params, header(0))


def test_another_tree_is_refused(writer: BroadcastWriter):
    with pytest.raises(ValueError, match="got layout hash 0x1, want 0xabcdef"):
        writer.publish(np.zeros(NUM_PARAMS, np.float32), ParamsHeader(version=0, num_updates=0, layout_hash=1))


def test_a_reader_of_another_tree_is_refused(writer: BroadcastWriter):
    with pytest.raises(TransportError, match="got layout hash"):
        BroadcastReader.attach(writer.descriptor, NUM_PARAMS, LAYOUT + 1)
    with pytest.raises(TransportError, match=r"got \d+ bytes"):
        BroadcastReader.attach(writer.descriptor, NUM_PARAMS + 100, LAYOUT)


def test_a_version_that_never_becomes_whole_is_named(
    writer: BroadcastWriter, reader: BroadcastReader, monkeypatch: pytest.MonkeyPatch
):
    publish(writer, 0)
    words_of(writer, 64)[0] += 1  # as if the writer never finished this slot
    monkeypatch.setattr(broadcast, "_READ_TIMEOUT_S", 0.05)
    with pytest.raises(WaitTimeoutError, match="reader waited 0 s for a whole version; the writer overtook every"):
        reader.read()


def test_time_in_which_the_reader_was_stopped_is_no_time_of_waiting(
    writer: BroadcastWriter, reader: BroadcastReader, monkeypatch: pytest.MonkeyPatch
):
    publish(writer, 1)
    ticket, pause, fences = words_of(writer, 64), make_pause(monkeypatch), []
    ticket[0] += 1  # the slot is being written

    def stopped_once() -> None:
        fences.append(1)
        if len(fences) == 3:
            pause(7200)
        elif len(fences) == 6:
            ticket[0] += 1

    monkeypatch.setattr(reader, "_fence", stopped_once)
    assert read(reader)[0] == header(1)


@pytest.mark.parametrize("epsilon", [-0.1, 1.5, math.nan])
def test_an_epsilon_that_is_no_probability_is_found(writer: BroadcastWriter, reader: BroadcastReader, epsilon: float):
    publish(writer, 0)
    words_of(writer, 64, np.float64)[3] = epsilon
    with pytest.raises(TransportError, match=r"got epsilon (-0\.1|1\.5|nan), want 0\.\.1; its slot is damaged"):
        reader.read()


@settings(max_examples=100)
@given(count=st.integers(1, 2**64 - 1))
def test_publications_that_never_were_are_found(count: int):
    writer = BroadcastWriter.create("gvz-test", NUM_PARAMS, LAYOUT)
    try:
        words_of(writer)[0] = count
        with pytest.raises(TransportError, match=f"{count} publications, but slot {(count - 1) % 3} was never written"):
            BroadcastReader.attach(writer.descriptor, NUM_PARAMS, LAYOUT).read()
    finally:
        writer.close()


def test_closing_can_be_repeated_and_leaves_the_other_end_its_memory(writer: BroadcastWriter, reader: BroadcastReader):
    publish(writer, 3)
    writer.close()
    writer.close()
    assert read(reader) == (header(3), [3.0] * NUM_PARAMS)


def test_the_size_is_what_it_says(writer: BroadcastWriter):
    assert os.fstat(writer.descriptor).st_size == HEADER_BYTES + broadcast_bytes(NUM_PARAMS)


_READER = """
import sys
import numpy as np
from gvz.transport import broadcast
broadcast._NUM_SLOTS = 2
reader = broadcast.BroadcastReader.attach(int(sys.argv[1]), int(sys.argv[2]), 7)
last, count = -1, 0
while count < 300:
    newest = reader.read()
    if newest is None:
        continue
    params, header = newest
    assert (params == header.version % 10**6).all(), "torn"
    assert header.num_updates == 2 * header.version and header.epsilon == 1 / (1 + header.version)
    assert header.version >= last, "went back"
    last, count = header.version, count + 1
"""


def test_readers_that_are_overtaken_never_see_half_a_version(monkeypatch: pytest.MonkeyPatch):
    """Two slots and a writer at full speed: readers are overtaken all the time. One of them is stopped meanwhile."""
    num_params = 200_000
    monkeypatch.setattr(broadcast, "_NUM_SLOTS", 2)
    writer = BroadcastWriter.create("gvz-test", num_params, 7)
    command = [sys.executable, "-c", _READER, str(writer.descriptor), str(num_params)]
    readers = [subprocess.Popen(command, pass_fds=[writer.descriptor]) for _ in range(3)]
    try:
        version, deadline = 0, time.monotonic() + 60.0
        while any(process.poll() is None for process in readers):
            assert time.monotonic() < deadline, "the readers read nothing"
            params = np.full(num_params, version % 10**6, np.float32)
            sent = ParamsHeader(version=version, num_updates=2 * version, epsilon=1 / (1 + version), layout_hash=7)
            writer.publish(params, sent)
            version += 1
            if version % 50 == 0:
                readers[0].send_signal(signal.SIGSTOP if version % 100 else signal.SIGCONT)
        assert [process.returncode for process in readers] == [0, 0, 0]
    finally:
        for process in readers:
            process.kill()
            process.wait()
        writer.close()
