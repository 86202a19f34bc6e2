"""Anonymous shared memory with a header that identifies it.

A segment is a mapped `memfd_create` file. It has no name in any directory: a process inherits its descriptor. The
kernel frees the memory when the last process that maps it or holds its descriptor has ended, so no crash leaves
anything behind. It counts as memory of the process group, not towards the size of /dev/shm.

Layout: eight little-endian u64 (magic, schema, total bytes, layout hash, four unused), then the payload.
"""

import fcntl
import hashlib
import mmap
import os
import re
import threading
from pathlib import Path

import numpy as np

from gvz.core.errors import ResourceError, TransportError
from gvz.transport.messages import SCHEMA_VERSION

MAGIC = int.from_bytes(b"GViZ-shm", "little")
HEADER_BYTES = 64
ALIGN_BYTES = 64
"""parts of a payload start at multiples of this: a cache line, and XLA's alignment of arrays that it reads in place"""
POISON = 0xFF
"""fills a new payload: NaN as a float32, impossible as a sequence number"""


class Segment:
    """One mapped piece of shared memory. Views of `payload` keep the mapping alive after `close`.

    Attributes:
        name: its name in errors and in `/proc/PID/maps`.
        descriptor: the file descriptor to pass to another process (`pass_fds`); -1 if this process attached the
            segment.
    """

    def __init__(self, name: str, mapping: mmap.mmap, descriptor: int = -1):
        self.name = name
        self.descriptor = descriptor
        self.payload = memoryview(mapping)[HEADER_BYTES:]

    @classmethod
    def create(
        cls,
        name: str,
        payload_bytes: int,
        *,
        layout_hash: int,
        advice: str = "lower actors.ring_capacity or actors.num_actors",
    ) -> "Segment":
        """Creates a segment. Its memory is allocated at once and filled with POISON. Its size can never change.

        Several segments may have the same name. `attach` must pass the same `layout_hash`, a u64. `advice` says how a
        user makes it smaller.

        Raises:
            ResourceError: there is not enough memory, or too many files are open.
        """
        total = HEADER_BYTES + payload_bytes
        try:
            available = _available_bytes()
            if total > available:  # the kernel would not refuse, but kill processes to make room
                raise ResourceError(
                    f"segment {name}: got {available} bytes of available memory, want {total}; {advice}"
                )
            descriptor = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
        except OSError as error:  # too many open files
            raise ResourceError(
                f"segment {name}: {error.strerror}; raise the limit (`ulimit -n`), or {advice}"
            ) from error
        try:
            os.posix_fallocate(descriptor, 0, total)
            fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
            mapping = mmap.mmap(descriptor, total)
        except OSError as error:
            os.close(descriptor)
            raise ResourceError(f"segment {name}: the kernel refused {total} bytes: {error.strerror}") from error
        np.frombuffer(mapping, np.uint8)[HEADER_BYTES:] = POISON
        header = memoryview(mapping)[:HEADER_BYTES].cast("Q")
        header[1], header[2], header[3] = SCHEMA_VERSION, total, layout_hash
        header[0] = MAGIC
        return cls(name, mapping, descriptor)

    @classmethod
    def attach(cls, descriptor: int, payload_bytes: int, *, layout_hash: int) -> "Segment":
        """Maps a segment of another process. The descriptor still belongs to the caller, who may close it.

        Raises:
            TransportError: no such descriptor, or the file is not the expected segment.
        """
        total = HEADER_BYTES + payload_bytes
        try:
            size = os.fstat(descriptor).st_size
            name = Path(f"/proc/self/fd/{descriptor}").readlink().name.removeprefix("memfd:").removesuffix(" (deleted)")
            if size != total:
                raise TransportError(f"segment {name}: got {size} bytes, want {total}")
            mapping = mmap.mmap(descriptor, total)
        except OSError as error:
            raise TransportError(f"segment of descriptor {descriptor}: cannot be mapped: {error.strerror}") from error
        got = memoryview(mapping)[:HEADER_BYTES].cast("Q")
        wanted = (MAGIC, SCHEMA_VERSION, total, layout_hash)
        for index, field in enumerate(("magic", "schema", "size", "layout hash")):
            if got[index] != wanted[index]:
                raise TransportError(
                    f"segment {name}: got {field} {got[index]:#x}, want {wanted[index]:#x}; "
                    "both sides must run the same version with the same configuration"
                )
        return cls(name, mapping)

    def close(self) -> None:
        """Releases mapping and descriptor. Can be repeated."""
        self.payload = memoryview(b"")
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1


def _available_bytes() -> int:
    """Memory that is available without swapping."""
    found = re.search(r"^MemAvailable: +(\d+) kB$", Path("/proc/meminfo").read_text(), re.MULTILINE)
    assert found is not None, "/proc/meminfo has no line MemAvailable"
    return 1024 * int(found[1])


def aligned(num_bytes: int) -> int:
    """The next multiple of ALIGN_BYTES."""
    return -(-num_bytes // ALIGN_BYTES) * ALIGN_BYTES


def hash_layout(*parts: object) -> int:
    """u64 hash of the printed form of `parts`, on which both sides of a segment must agree."""
    return int.from_bytes(hashlib.blake2b(repr(parts).encode(), digest_size=8).digest(), "little")


class Fence:
    """Orders memory accesses: all accesses before the call happen before all accesses after it.

    x86-64 keeps stores in order anyway. On ARM, locking and unlocking an uncontended lock twice is the barrier that
    plain Python offers (release, then acquire; 0.1 microseconds).
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def __call__(self) -> None:
        with self._lock:
            pass
        with self._lock:
            pass
