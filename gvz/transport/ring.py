"""A ring of step records in shared memory: one writer (an actor), one reader (the learner).

Layout of the payload: control words, then step_dtype[capacity], then uint8[capacity, H, W, C]. Records and frames
stand side by side so that a run of frames is one contiguous copy. Record number s lies in slot s mod capacity.
`published` and `consumed` count records since the ring was created and never decrease. One side writes `published`, the
other `consumed`, each after its records are written or read. So a reader never sees an incomplete record, a writer
never fills a slot that is not free, and the successor of a dead writer continues at `published`.
"""

import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from gvz.core.errors import TransportError, WaitTimeoutError
from gvz.core.watchdog import AwakeClock
from gvz.transport.messages import STEP_DTYPE, StepBlock
from gvz.transport.segment import Fence, Segment, aligned, hash_layout

# u64 control words; the writer's and the reader's are in separate cache lines
_PUBLISHED, _HEARTBEAT_NS, _STATE, _PID, _WAITED_NS, _CONSUMED, _NUM_WORDS = 0, 1, 2, 3, 4, 8, 16
_UNPUBLISHED = 2**64 - 1
"""sequence number of a slot that is being filled"""
_MAX_PUBLISHED = 2**63
"""larger counts are damaged: no ring ever holds that many records"""
_FIRST_SLEEP_S, _LONGEST_SLEEP_S = 20e-6, 10e-3


class WriterState(IntEnum):
    """What the writer does. A stuck writer, whatever its state, has no heartbeat; a waiting one has one."""

    ABSENT = 0
    STARTING = 1
    ACTING = 2
    RESETTING = 3
    WAITING_FOR_SPACE = 4
    STOPPED = 5
    WAITING_FOR_ACTIONS = 6


@dataclass(frozen=True, kw_only=True, slots=True)
class WriterStatus:
    """The state that the writer reports."""

    pid: int
    state: WriterState
    heartbeat_ns: int
    """`time.monotonic_ns()` of the writer's last heartbeat; 0 before the first"""
    waited_for_space_s: float
    """seconds that the writers of this ring have waited for the reader"""


class _Ring:
    """The mapped arrays of both ends."""

    def __init__(self, segment: Segment, capacity: int, frame_shape: tuple[int, int, int], dtype: np.dtype):
        steps_at, frames_at, _ = _offsets(capacity, frame_shape, dtype)
        payload = segment.payload
        self.name = segment.name
        self.capacity = capacity
        self.frame_shape = frame_shape
        self.dtype = dtype
        self._segment = segment
        self._words = payload[: 8 * _NUM_WORDS].cast("Q")
        self._steps = np.frombuffer(payload, dtype, capacity, steps_at)
        self._sequence = self._steps["sequence"]
        self._frames = np.frombuffer(payload, np.uint8, capacity * math.prod(frame_shape), frames_at)
        self._frames = self._frames.reshape(capacity, *frame_shape)
        self._fence = Fence()

    @property
    def num_unread(self) -> int:
        """Records published and not yet read.

        Raises:
            TransportError: the control words contradict each other.
        """
        published, consumed = self._words[_PUBLISHED], self._words[_CONSUMED]
        if not 0 <= published - consumed <= self.capacity or published > _MAX_PUBLISHED:
            raise TransportError(
                f"ring {self.name}: {published} records published and {consumed} consumed do not fit a capacity of "
                f"{self.capacity}; its control words are damaged"
            )
        return published - consumed

    def close(self) -> None:
        """Releases the memory. Can be repeated."""
        self._words = memoryview(bytes(8 * _NUM_WORDS)).cast("Q")
        self._steps, self._frames = np.empty(0, self.dtype), np.empty(0, np.uint8)
        self._sequence = self._steps["sequence"]
        self._segment.close()


class RingReader(_Ring):
    """The learner's end, which creates the ring and outlives its writers."""

    @classmethod
    def create(
        cls, name: str, capacity: int, frame_shape: tuple[int, int, int], dtype: np.dtype = STEP_DTYPE
    ) -> "RingReader":
        """Creates an empty ring of `capacity` records (`dtype`, a `step_dtype`) with frames uint8[H, W, C].

        Raises:
            ResourceError: there is not enough memory.
        """
        layout_hash = _layout_hash(capacity, frame_shape, dtype)
        segment = Segment.create(name, ring_bytes(capacity, frame_shape, dtype), layout_hash=layout_hash)
        ring = cls(segment, capacity, frame_shape, dtype)
        ring._steps["pad"] = 0
        for index in range(_NUM_WORDS):
            ring._words[index] = 0
        return ring

    @property
    def descriptor(self) -> int:
        """File descriptor with which another process attaches its `RingWriter`."""
        return self._segment.descriptor

    def writer(self) -> "RingWriter":
        """The writing end for a writer in this process."""
        return RingWriter(self._segment, self.capacity, self.frame_shape, self.dtype)

    def peek(self, max_records: int) -> StepBlock:
        """Copies up to `max_records` of the oldest unread records, without waiting; they stay unread.

        Raises:
            TransportError: a record is missing, repeated or overwritten while being read.
        """
        first = self._words[_CONSUMED]
        count = min(self.num_unread, max_records)
        self._fence()
        block = StepBlock(steps=self._copy(self._steps, first, count), frames=self._copy(self._frames, first, count))
        self._fence()
        # the copy must hold the expected records; the ring, read afterwards, shows that none changed during the copy
        expected = np.arange(first, first + count, dtype=np.uint64)
        for found in (block.steps["sequence"], self._copy(self._sequence, first, count)):
            if not (found == expected).all():
                at = int(np.argmax(found != expected))
                raise TransportError(
                    f"ring {self.name}: got record {int(found[at])} where {int(expected[at])} should be; "
                    "records were lost, repeated or torn"
                )
        return block

    def read(self, max_records: int) -> StepBlock:
        """Like `peek`, and frees the slots for the writer. The block may be empty."""
        block = self.peek(max_records)
        self._words[_CONSUMED] += len(block)
        return block

    def writer_status(self) -> WriterStatus:
        """The writer's state and heartbeat.

        Raises:
            TransportError: an unknown state.
        """
        state = self._words[_STATE]
        self._fence()
        if state not in WriterState._value2member_map_:
            raise TransportError(f"ring {self.name}: got writer state {state}, want 0..{max(WriterState)}")
        return WriterStatus(
            pid=self._words[_PID],
            state=WriterState(state),
            heartbeat_ns=self._words[_HEARTBEAT_NS],
            waited_for_space_s=self._words[_WAITED_NS] / 1e9,
        )

    def _copy(self, array: np.ndarray, first: int, count: int) -> np.ndarray:
        """An owned copy of `count` entries from record number `first`; at most two contiguous runs."""
        start = first % self.capacity
        before_wrap = min(count, self.capacity - start)
        copy = np.empty((count, *array.shape[1:]), array.dtype)
        copy[:before_wrap] = array[start : start + before_wrap]
        copy[before_wrap:] = array[: count - before_wrap]
        return copy


class RingWriter(_Ring):
    """The actor's end. `reserve`, fill in place, `commit`."""

    def __init__(self, segment: Segment, capacity: int, frame_shape: tuple[int, int, int], dtype: np.dtype):
        super().__init__(segment, capacity, frame_shape, dtype)
        self._next = self._words[_PUBLISHED]
        self._num_reserved = 0
        self._words[_PID] = os.getpid()

    @classmethod
    def attach(
        cls, descriptor: int, capacity: int, frame_shape: tuple[int, int, int], dtype: np.dtype = STEP_DTYPE
    ) -> "RingWriter":
        """Becomes the writer; continues after the last record that a predecessor published.

        Raises:
            TransportError: the descriptor does not belong to a ring, or the ring has another layout.
        """
        layout_hash = _layout_hash(capacity, frame_shape, dtype)
        segment = Segment.attach(descriptor, ring_bytes(capacity, frame_shape, dtype), layout_hash=layout_hash)
        return cls(segment, capacity, frame_shape, dtype)

    @property
    def free(self) -> int:
        """Records that fit without waiting."""
        return self.capacity - self.num_unread

    def reserve(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Views of the next `count` slots to fill: step_dtype[count] except `sequence`, and uint8[count, H, W, C].

        The slots must be free. A reservation cannot wrap round the end, so a writer that always reserves the same
        `count` needs a capacity that is a multiple of it.
        """
        slot = self._next % self.capacity
        assert count <= self.free, f"ring {self.name}: {self.free} records are free; wait_for_space first"
        assert slot + count <= self.capacity, f"ring {self.name}: {count} records from slot {slot} on wrap round"
        self._num_reserved = count
        self._sequence[slot : slot + count] = _UNPUBLISHED
        self._fence()
        return self._steps[slot : slot + count], self._frames[slot : slot + count]

    def commit(self) -> None:
        """Publishes all reserved records at once."""
        slot, last = self._next % self.capacity, self._next + self._num_reserved
        self._sequence[slot : slot + self._num_reserved] = np.arange(self._next, last, dtype=np.uint64)
        self._fence()
        self._words[_PUBLISHED] = self._next = last
        self._num_reserved = 0

    def beat(self, state: WriterState) -> None:
        """Writes the state and a heartbeat."""
        self._words[_HEARTBEAT_NS] = time.monotonic_ns()
        self._fence()  # who sees the state sees its heartbeat
        self._words[_STATE] = state

    def wait_for_space(
        self, num_records: int, timeout_s: float, *, cancelled: Callable[[], bool] = lambda: False
    ) -> bool:
        """Waits until `num_records` fit, with a heartbeat; adds the time to the ring's waiting time. Time in which this
        process was stopped does not count.

        Returns:
            False if `cancelled()` became true first.

        Raises:
            WaitTimeoutError: the reader did not free enough slots in time.
        """
        if self.free >= num_records:
            return True
        clock, sleep_s = AwakeClock(), _FIRST_SLEEP_S
        waited_before_ns = self._words[_WAITED_NS]
        while not (done := self.free >= num_records) and not cancelled():
            self.beat(WriterState.WAITING_FOR_SPACE)
            time.sleep(sleep_s)
            sleep_s = min(2 * sleep_s, _LONGEST_SLEEP_S)
            waited_s = clock.look()
            self._words[_WAITED_NS] = (waited_before_ns + int(1e9 * waited_s)) % 2**64
            if waited_s > timeout_s:
                raise WaitTimeoutError(
                    f"ring {self.name}: writer (pid {os.getpid()}) waited {waited_s:.1f} s for the learner to "
                    f"read; {self.free} of {self.capacity} records are free, {num_records} are wanted"
                )
        return done


def ring_bytes(capacity: int, frame_shape: tuple[int, int, int], dtype: np.dtype = STEP_DTYPE) -> int:
    """Bytes of shared memory of a ring, without the segment's header."""
    return _offsets(capacity, frame_shape, dtype)[2]


def _offsets(capacity: int, frame_shape: tuple[int, int, int], dtype: np.dtype) -> tuple[int, int, int]:
    """Offsets in the payload of the records, of the frames and of the end, bytes."""
    steps_at = aligned(8 * _NUM_WORDS)
    frames_at = steps_at + aligned(capacity * dtype.itemsize)
    return steps_at, frames_at, frames_at + capacity * math.prod(frame_shape)


def _layout_hash(capacity: int, frame_shape: tuple[int, int, int], dtype: np.dtype) -> int:
    return hash_layout("ring", dtype.descr, capacity, tuple(frame_shape))
