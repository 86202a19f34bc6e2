"""The parameter queue: one writer (the learner), many readers (actors), shared memory.

A version of the parameters is one flat float32 vector. The writer fills the slots in turn and never waits. Each slot
has a ticket that is odd while the slot is written. So a reader detects that its slot was overwritten and takes the
newer version. The number of publications increases after a slot is complete: if a writer dies, the version before
stays.
"""

import struct

import numpy as np

from gvz.core.errors import TransportError, WaitTimeoutError
from gvz.core.watchdog import AwakeClock
from gvz.transport.messages import ParamsHeader
from gvz.transport.segment import ALIGN_BYTES, Fence, Segment, aligned, hash_layout

_TICKET, _VERSION, _NUM_UPDATES, _EPSILON_BITS, _NUM_WORDS = 0, 1, 2, 3, 8
"""u64 words before each slot's vector; the payload also starts with 8 words, and the first counts publications"""
_NUM_SLOTS = 3
"""versions kept, at least 2: one is read while one is written. A reader must repeat its copy only when two publications
begin during it"""
_READ_TIMEOUT_S = 30.0


class _ParamsQueue:
    """The mapped arrays of both ends."""

    def __init__(self, segment: Segment, num_params: int, layout_hash: int):
        payload = segment.payload
        stride = _slot_bytes(num_params)
        starts = [8 * _NUM_WORDS + slot * stride for slot in range(_NUM_SLOTS)]
        self.name = segment.name
        self.num_params = num_params
        self.layout_hash = layout_hash
        self._segment = segment
        self._count = payload[: 8 * _NUM_WORDS].cast("Q")
        self._words = [payload[start : start + 8 * _NUM_WORDS].cast("Q") for start in starts]
        self._vectors = [np.frombuffer(payload, np.float32, num_params, start + 8 * _NUM_WORDS) for start in starts]
        self._fence = Fence()

    def close(self) -> None:
        """Releases the memory. Can be repeated."""
        self._count = memoryview(bytes(8)).cast("Q")
        self._words, self._vectors = [], []
        self._segment.close()


class BroadcastWriter(_ParamsQueue):
    """The learner's end, which creates the queue."""

    @classmethod
    def create(cls, name: str, num_params: int, layout_hash: int) -> "BroadcastWriter":
        """Creates a queue that holds no version yet of a vector float32[num_params]; `name` is its name in errors.

        Readers must pass the same `layout_hash`, a u64 of the parameter tree.

        Raises:
            ResourceError: there is not enough memory.
        """
        whole_hash = hash_layout("broadcast", num_params, _NUM_SLOTS, layout_hash)
        segment = Segment.create(name, broadcast_bytes(num_params), layout_hash=whole_hash)
        queue = cls(segment, num_params, layout_hash)
        for words in (queue._count, *queue._words):
            for index in range(_NUM_WORDS):
                words[index] = 0
        return queue

    @property
    def descriptor(self) -> int:
        """File descriptor with which other processes attach a `BroadcastReader`."""
        return self._segment.descriptor

    def publish(self, params: np.ndarray, header: ParamsHeader) -> None:
        """Makes `params` float32[P] the newest version. Never waits.

        Raises:
            ValueError: length, dtype or parameter tree differs from the queue's.
        """
        if params.shape != (self.num_params,) or params.dtype != np.float32:
            raise ValueError(
                f"broadcast {self.name}: got {params.dtype}{list(params.shape)}, want float32[{self.num_params}]"
            )
        if header.layout_hash != self.layout_hash:
            raise ValueError(
                f"broadcast {self.name}: got layout hash {header.layout_hash:#x}, want {self.layout_hash:#x}"
            )
        count = self._count[0]
        words = self._words[count % len(self._words)]
        words[_TICKET] |= 1
        self._fence()
        self._vectors[count % len(self._words)][:] = params
        words[_VERSION], words[_NUM_UPDATES] = header.version, header.num_updates
        words[_EPSILON_BITS] = struct.unpack("<Q", struct.pack("<d", header.epsilon))[0]
        self._fence()
        words[_TICKET] += 1
        self._count[0] = count + 1


class BroadcastReader(_ParamsQueue):
    """An actor's end."""

    def __init__(self, segment: Segment, num_params: int, layout_hash: int):
        super().__init__(segment, num_params, layout_hash)
        self._seen = 0  # publications

    @classmethod
    def attach(cls, descriptor: int, num_params: int, layout_hash: int) -> "BroadcastReader":
        """Maps the queue.

        Raises:
            TransportError: the descriptor does not belong to a queue, or the queue was created for other parameters.
        """
        whole_hash = hash_layout("broadcast", num_params, _NUM_SLOTS, layout_hash)
        segment = Segment.attach(descriptor, broadcast_bytes(num_params), layout_hash=whole_hash)
        return cls(segment, num_params, layout_hash)

    def read(self) -> tuple[np.ndarray, ParamsHeader] | None:
        """The newest version, float32[P] and its header, if it is newer than the last one read; else None.

        The vector belongs to the caller and is aligned so that XLA on a CPU takes it without another copy.

        Raises:
            WaitTimeoutError: the writer overwrote every copy for too long.
            TransportError: the control words contradict each other.
        """
        if self._count[0] == self._seen:
            return None
        params, clock = _empty_aligned(self.num_params), AwakeClock()
        while True:
            count = self._count[0]
            slot = (count - 1) % len(self._words)
            words = self._words[slot]
            self._fence()
            ticket = words[_TICKET]
            self._fence()
            params[:] = self._vectors[slot]
            epsilon = struct.unpack("<d", struct.pack("<Q", words[_EPSILON_BITS]))[0]
            header = ParamsHeader(
                version=words[_VERSION],
                num_updates=words[_NUM_UPDATES],
                epsilon=epsilon,
                layout_hash=self.layout_hash,
            )
            self._fence()
            if ticket == 0:
                raise TransportError(
                    f"broadcast {self.name}: {count} publications, but slot {slot} was never written; its control "
                    "words are damaged"
                )
            if ticket % 2 == 0 and words[_TICKET] == ticket:
                if not 0 <= epsilon <= 1:
                    raise TransportError(
                        f"broadcast {self.name}: got epsilon {epsilon}, want 0..1; its slot is damaged"
                    )
                self._seen = count
                return params, header
            if clock.look() > _READ_TIMEOUT_S:
                raise WaitTimeoutError(
                    f"broadcast {self.name}: reader waited {_READ_TIMEOUT_S:.0f} s for a whole version; the writer "
                    "overtook every copy: raise learner.publish_period_updates"
                )


def broadcast_bytes(num_params: int) -> int:
    """Bytes of shared memory of a queue, without the segment's header."""
    return 8 * _NUM_WORDS + _NUM_SLOTS * _slot_bytes(num_params)


def _slot_bytes(num_params: int) -> int:
    return 8 * _NUM_WORDS + aligned(4 * num_params)


def _empty_aligned(num_params: int) -> np.ndarray:
    spare = ALIGN_BYTES // 4
    array = np.empty(num_params + spare, np.float32)
    start = -array.ctypes.data % ALIGN_BYTES // 4
    return array[start : start + num_params]
