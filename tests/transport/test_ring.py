"""The ring of step records: nothing lost, repeated or torn, whoever dies."""

import mmap
import os
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from gvz.core.errors import TransportError, WaitTimeoutError
from gvz.transport.messages import STEP_DTYPE, StepBlock
from gvz.transport.ring import RingReader, RingWriter, WriterState, ring_bytes
from gvz.transport.segment import HEADER_BYTES
from tests.waiting import make_pause, wait_until

CAPACITY, SHAPE = 8, (4, 5, 3)


@pytest.fixture
def reader() -> Iterator[RingReader]:
    ring = RingReader.create("gvz-test", CAPACITY, SHAPE)
    yield ring
    ring.close()


@pytest.fixture
def writer(reader: RingReader) -> Iterator[RingWriter]:
    ring = RingWriter.attach(reader.descriptor, reader.capacity, SHAPE)
    yield ring
    ring.close()


def write(writer: RingWriter, *numbers: int) -> None:
    """Records all of whose content follows from their numbers."""
    n = np.array(numbers)
    steps, frames = writer.reserve(len(n))
    frames[...] = (n % 251)[:, None, None, None]
    steps["episode"] = n * 3
    steps["params_version"] = n * 5
    steps["action"] = n % 7
    steps["reward"] = n / 2
    steps["lane"] = n % 11
    steps["task"] = n % 13
    steps["first"] = n % 2 == 0
    steps["terminated"] = n % 3 == 0
    steps["truncated"] = n % 5 == 0
    writer.commit()


def check(block: StepBlock, numbers: list[int]) -> None:
    n = np.array(numbers, np.int64)
    assert block.steps.dtype == STEP_DTYPE
    assert block.frames.shape == (len(n), *SHAPE)
    np.testing.assert_array_equal(block.frames, np.broadcast_to((n % 251)[:, None, None, None], block.frames.shape))
    for field, wanted in {
        "episode": n * 3,
        "params_version": n * 5,
        "action": n % 7,
        "reward": n / 2,
        "lane": n % 11,
        "task": n % 13,
        "first": n % 2 == 0,
        "terminated": n % 3 == 0,
        "truncated": n % 5 == 0,
        "pad": np.zeros((len(n), 9)),
    }.items():
        np.testing.assert_array_equal(block.steps[field], wanted, err_msg=field)


class RingMachine(RuleBasedStateMachine):
    """Any order of writes, reads, half-written records and dead writers against a deque."""

    def __init__(self):
        super().__init__()
        self.reader = RingReader.create("gvz-test", CAPACITY, SHAPE)
        self.writer = self.attach()
        self.unread: deque[int] = deque()
        self.written = 0
        self.num_read = 0

    def attach(self) -> RingWriter:
        return RingWriter.attach(self.reader.descriptor, CAPACITY, SHAPE)

    @rule(count=st.integers(1, CAPACITY))
    def write(self, count: int):
        until_wrap = CAPACITY - self.written % CAPACITY
        numbers = range(self.written, self.written + min(count, self.writer.free, until_wrap))
        write(self.writer, *numbers)
        self.unread.extend(numbers)
        self.written += len(numbers)

    @rule(count=st.integers(0, 2 * CAPACITY))
    def read(self, count: int):
        wanted = [self.unread.popleft() for _ in range(min(count, len(self.unread)))]
        block = self.reader.read(count)
        check(block, wanted)
        expected = np.arange(self.num_read, self.num_read + len(wanted))
        np.testing.assert_array_equal(block.steps["sequence"], expected)
        self.num_read += len(wanted)

    @rule(count=st.integers(0, 2 * CAPACITY))
    def peek(self, count: int):
        check(self.reader.peek(count), list(self.unread)[:count])

    @rule(half_written=st.booleans())
    def writer_dies(self, half_written: bool):
        if half_written and self.writer.free:
            steps, frames = self.writer.reserve(1)
            steps["episode"], frames[...] = 252, 252
        self.writer = self.attach()

    @invariant()
    def check_valid(self):
        assert self.reader.num_unread == len(self.unread)
        assert self.writer.free == CAPACITY - len(self.unread)

    def teardown(self):
        self.writer.close()  # its mapping holds a descriptor
        self.reader.close()


TestRingMachine = RingMachine.TestCase
TestRingMachine.settings = settings(max_examples=40, stateful_step_count=40)


def test_blocks_are_copies(reader: RingReader, writer: RingWriter):
    write(writer, 0)
    block = reader.read(1)
    for number in range(1, 1 + CAPACITY):
        write(writer, number)
    check(block, [0])
    block.frames[...] = 255
    check(reader.read(CAPACITY), list(range(1, 1 + CAPACITY)))


def test_reserving_in_a_full_ring_is_a_bug(reader: RingReader, writer: RingWriter):
    write(writer, *range(reader.capacity))
    with pytest.raises(AssertionError, match="0 records are free; wait_for_space first"):
        writer.reserve(1)


def test_a_reservation_that_wraps_is_a_bug(reader: RingReader, writer: RingWriter):
    write(writer, *range(CAPACITY - 1))
    reader.read(CAPACITY)
    with pytest.raises(AssertionError, match="2 records from slot 7 on wrap round"):
        writer.reserve(2)


@pytest.mark.usefixtures("reader")
def test_a_full_ring_makes_the_writer_wait_and_says_for_whom(writer: RingWriter):
    write(writer, *range(CAPACITY - 2))
    assert writer.wait_for_space(2, timeout_s=0.0)
    with pytest.raises(
        WaitTimeoutError, match=r"waited 0\.\d s for the learner to read; 2 of 8 records are free, 3 are"
    ):
        writer.wait_for_space(3, timeout_s=0.05)


def test_waiting_ends_when_the_reader_reads_and_is_counted(reader: RingReader, writer: RingWriter):
    write(writer, *range(CAPACITY))

    def read_later():
        wait_until(lambda: reader.writer_status().state == WriterState.WAITING_FOR_SPACE, "the writer's wait")
        time.sleep(0.1)
        reader.read(3)

    thread = threading.Thread(target=read_later)
    thread.start()
    assert writer.wait_for_space(3, timeout_s=10.0)
    thread.join()
    assert reader.writer_status().waited_for_space_s > 0.05
    assert reader.writer_status().heartbeat_ns > 0


@pytest.mark.usefixtures("reader")
def test_waiting_can_be_cancelled(writer: RingWriter):
    write(writer, *range(CAPACITY))
    assert not writer.wait_for_space(1, timeout_s=10.0, cancelled=lambda: True)


def test_time_in_which_the_writer_was_stopped_is_no_time_of_waiting(
    reader: RingReader, writer: RingWriter, monkeypatch: pytest.MonkeyPatch
):
    write(writer, *range(CAPACITY))
    pause, looks = make_pause(monkeypatch), []

    def stopped_once() -> bool:
        looks.append(1)
        if len(looks) == 2:
            pause(7200)
        elif len(looks) == 4:
            reader.read(1)
        return False

    assert writer.wait_for_space(1, timeout_s=3600, cancelled=stopped_once)
    assert reader.writer_status().waited_for_space_s < 60


def test_the_writer_shows_its_state(reader: RingReader, writer: RingWriter):
    assert reader.writer_status().state == WriterState.ABSENT
    for state in WriterState:
        before = time.monotonic_ns()
        writer.beat(state)
        status = reader.writer_status()
        assert (status.state, status.pid) == (state, os.getpid())
        assert before <= status.heartbeat_ns <= time.monotonic_ns()


def test_closing_can_be_repeated_and_leaves_the_other_end_its_memory(reader: RingReader, writer: RingWriter):
    write(writer, 0)
    writer.close()
    check(reader.read(1), [0])
    reader.close()
    reader.close()


@pytest.mark.parametrize(("capacity", "shape"), [(CAPACITY, (5, 4, 3)), (CAPACITY, (4, 15, 1)), (CAPACITY, (2, 2, 1))])
def test_another_layout_is_refused(reader: RingReader, capacity: int, shape: tuple[int, int, int]):
    with pytest.raises(TransportError, match=r"layout hash|bytes"):
        RingWriter.attach(reader.descriptor, capacity, shape)


def test_records_count_when_they_are_whole_and_a_state_when_its_heartbeat_has_come(
    reader: RingReader, writer: RingWriter
):
    sequence, found = steps_of(reader)["sequence"], []

    class Words(list[int]):
        def __setitem__(self, index, value):
            found.append((index, sequence[:2].tolist()))

    writer._words = Words([0] * 16)
    write(writer, 0, 1)
    writer.beat(WriterState.ACTING)
    assert found == [(0, [0, 1]), (1, [0, 1]), (2, [0, 1])], "published, heartbeat, state"


def test_a_heartbeat_is_as_new_as_the_state_that_is_seen(
    reader: RingReader, writer: RingWriter, monkeypatch: pytest.MonkeyPatch
):
    writer.beat(WriterState.RESETTING)
    before_ns = reader.writer_status().heartbeat_ns
    monkeypatch.setattr(reader, "_fence", lambda: writer.beat(WriterState.ACTING))
    status = reader.writer_status()
    assert status.state == WriterState.RESETTING
    assert status.heartbeat_ns > before_ns


# ---- damage: what a broken writer, or anything else with access, may have done to the memory


def words_of(ring: RingReader) -> np.ndarray:
    return np.frombuffer(mmap.mmap(ring.descriptor, 0), np.uint64, 16, HEADER_BYTES)


def steps_of(ring: RingReader) -> np.ndarray:
    return np.frombuffer(mmap.mmap(ring.descriptor, 0), STEP_DTYPE, CAPACITY, HEADER_BYTES + 128)


@pytest.mark.parametrize(("slot", "wrong"), [(2, 1), (1, 2), (0, 8), (3, 2**64 - 1)])
def test_a_lost_repeated_or_torn_record_is_found(reader: RingReader, writer: RingWriter, slot: int, wrong: int):
    write(writer, *range(5))
    steps_of(reader)["sequence"][slot] = wrong
    with pytest.raises(TransportError, match=f"got record {wrong} where {slot} should be; records were lost"):
        reader.read(5)
    with pytest.raises(TransportError, match="records were lost, repeated or torn"):
        reader.read(5)  # and it stays found


def test_a_record_that_changes_while_it_is_copied_is_found(
    reader: RingReader, writer: RingWriter, monkeypatch: pytest.MonkeyPatch
):
    write(writer, 0, 1)
    fences = []

    def overwrite_after_the_copy() -> None:
        fences.append(1)
        if len(fences) == 2:
            steps_of(reader)["sequence"][1] = 9

    monkeypatch.setattr(reader, "_fence", overwrite_after_the_copy)
    with pytest.raises(TransportError, match="got record 9 where 1 should be; records were lost, repeated or torn"):
        reader.read(2)


def test_a_slot_that_is_being_filled_holds_no_record(reader: RingReader, writer: RingWriter):
    write(writer, *range(CAPACITY))
    reader.read(CAPACITY)
    writer.reserve(1)
    assert steps_of(reader)["sequence"][:2].tolist() == [2**64 - 1, 1]


@settings(max_examples=100)
@given(published=st.integers(0, 2**64 - 1), consumed=st.integers(0, 2**64 - 1))
@example(published=2**64 - 1, consumed=2**64 - 1)
def test_impossible_indices_are_found(published: int, consumed: int):
    reader = RingReader.create("gvz-test", CAPACITY, SHAPE)
    words = words_of(reader)
    words[0], words[8] = published, consumed
    try:
        if published == consumed <= 2**63:
            assert len(reader.read(5)) == 0
        else:  # too far apart, or records that were never written
            with pytest.raises(TransportError, match=r"control words are damaged|records were lost"):
                reader.read(5)
    finally:
        reader.close()


def test_a_damaged_count_of_waiting_does_not_end_the_writer(writer: RingWriter, reader: RingReader):
    write(writer, *range(CAPACITY))
    words_of(reader)[4] = 2**64 - 1
    with pytest.raises(WaitTimeoutError, match="for the learner to read"):
        writer.wait_for_space(1, timeout_s=0.01)
    assert reader.writer_status().waited_for_space_s < 60  # counted on from there


def test_the_wait_of_a_successor_is_added_to_those_of_its_predecessors(writer: RingWriter, reader: RingReader):
    write(writer, *range(CAPACITY))
    words_of(reader)[4] = 3600 * 10**9
    with pytest.raises(WaitTimeoutError):
        writer.wait_for_space(1, timeout_s=0.01)
    assert reader.writer_status().waited_for_space_s > 3600


def test_an_unknown_writer_state_is_found(reader: RingReader):
    words_of(reader)[2] = 77
    with pytest.raises(TransportError, match=r"got writer state 77, want 0\.\.6"):
        reader.writer_status()


# ---- real processes

_WRITER = """
import sys
import numpy as np
from gvz.transport.ring import RingWriter
writer = RingWriter.attach(int(sys.argv[1]), 64, (84, 84, 3))
while True:
    writer.wait_for_space(4, 60.0)
    numbers = np.arange(writer._next, writer._next + 4)  # a counting game: all content follows from these
    steps, frames = writer.reserve(4)
    steps["episode"] = numbers
    for frame, number in zip(frames, numbers):
        frame[...] = number % 251
    writer.commit()
"""


def test_killed_writers_lose_duplicate_and_tear_nothing():
    """Writers are killed at random moments, most of them within a frame; each successor attaches to the same ring."""
    reader = RingReader.create("gvz-test", 64, (84, 84, 3))
    command = [sys.executable, "-c", _WRITER, str(reader.descriptor)]
    rng = np.random.default_rng(0)
    count = 0
    try:
        for _ in range(6):
            process = subprocess.Popen(command, pass_fds=[reader.descriptor])
            before, deadline = count, time.monotonic() + float(rng.uniform(0.05, 0.4)) + 30
            while count < before + 200 + int(rng.integers(1000)):
                assert time.monotonic() < deadline, "the writer delivers nothing"
                block = reader.read(int(rng.integers(1, 64)))
                numbers = np.arange(count, count + len(block))
                np.testing.assert_array_equal(block.steps["episode"], numbers)
                assert (block.frames == (numbers % 251).astype(np.uint8)[:, None, None, None]).all()
                count += len(block)
            process.send_signal(signal.SIGKILL)
            process.wait()
    finally:
        reader.close()
    assert count > 1200


def test_the_size_is_what_it_says(reader: RingReader):
    assert os.fstat(reader.descriptor).st_size == HEADER_BYTES + ring_bytes(reader.capacity, SHAPE)
