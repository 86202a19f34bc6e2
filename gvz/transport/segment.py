"""Named POSIX shared memory with a header that proves what it is. Imports the standard library, numpy, gvz.errors
and gvz.janitor.

A segment is a file of /dev/shm (what `shm_open` would make), mapped. `multiprocessing.shared_memory` is not used:
its resource tracker unlinks segments that a mere reader attached to.

Layout: eight little-endian u64 (magic, schema, total bytes, layout hash, four unused), then the payload.
"""

import contextlib
import hashlib
import mmap
import os
import re
import threading
from pathlib import Path

import numpy as np

from gvz import janitor
from gvz.errors import ResourceError, TransportError
from gvz.transport.messages import SCHEMA_VERSION

MAGIC = int.from_bytes(b"GViZ-shm", "little")
HEADER_BYTES = 64
ALIGN_BYTES = 64
"""parts of a payload start at multiples of this: a cache line, and what XLA wants of an array it reads in place"""
POISON = 0xFF
"""fills a new payload: as float32 it is NaN, as a sequence number it is impossible"""


class Segment:
    """One mapped piece of shared memory. Views of `payload` keep the mapping alive after `close`."""

    def __init__(self, name: str | None, mapping: mmap.mmap, *, owner: bool):
        self.name = name
        self.payload = memoryview(mapping)[HEADER_BYTES:]
        self._owner = owner

    @classmethod
    def create(cls, name: str | None, payload_bytes: int, *, layout_hash: int) -> "Segment":
        """Makes a segment, all of its memory taken at once and poisoned.

        Args:
            name: file name in /dev/shm, not used before; None for private memory without a name.
            payload_bytes: size without the header.
            layout_hash: u64; `attach` must bring the same.

        Raises:
            ResourceError: /dev/shm has no room. (Without asking first, the first touch of a missing page is SIGBUS.)
            TransportError: the name is taken.
        """
        total = HEADER_BYTES + payload_bytes
        mapping = mmap.mmap(-1, total) if name is None else _create_file(name, total)
        np.frombuffer(mapping, np.uint8)[HEADER_BYTES:] = POISON
        header = memoryview(mapping)[:HEADER_BYTES].cast("Q")
        header[1], header[2], header[3] = SCHEMA_VERSION, total, layout_hash
        header[0] = MAGIC
        return cls(name, mapping, owner=name is not None)

    @classmethod
    def attach(cls, name: str, payload_bytes: int, *, layout_hash: int) -> "Segment":
        """Maps the segment that another process made.

        Raises:
            TransportError: no such segment, not ours, or not what was expected of it.
        """
        try:
            file = os.open(_path(name), os.O_RDWR | os.O_NOFOLLOW | os.O_CLOEXEC)
        except OSError as error:
            raise TransportError(
                f"segment {name}: cannot be attached: {error.strerror}; its owner has ended, or systemd has removed "
                "it at a logout of this user (RemoveIPC=yes in logind.conf)"
            ) from error
        try:
            found, total = os.fstat(file), HEADER_BYTES + payload_bytes
            if found.st_uid != os.geteuid():
                raise TransportError(f"segment {name}: got owner {found.st_uid}, want our own {os.geteuid()}")
            if found.st_size != total:
                raise TransportError(f"segment {name}: got {found.st_size} bytes, want {total}")
            mapping = mmap.mmap(file, total)
        finally:
            os.close(file)
        got = memoryview(mapping)[:HEADER_BYTES].cast("Q")
        wanted = (MAGIC, SCHEMA_VERSION, total, layout_hash)
        for index, field in enumerate(("magic", "schema", "size", "layout hash")):
            if got[index] != wanted[index]:
                raise TransportError(
                    f"segment {name}: got {field} {got[index]:#x}, want {wanted[index]:#x}; "
                    "both sides must run the same version with the same configuration"
                )
        return cls(name, mapping, owner=False)

    def close(self) -> None:
        """Lets go of the mapping; the owner also unlinks the name, once. Can be repeated."""
        self.payload = memoryview(b"")
        if self._owner and self.name is not None:
            self._owner = False
            with contextlib.suppress(FileNotFoundError):  # a janitor may have been called on it by hand
                _path(self.name).unlink()
            janitor.forget("segment", self.name)


def _create_file(name: str, total: int) -> mmap.mmap:
    path = _path(name)
    if path.exists():
        raise TransportError(f"segment {name}: the name is taken in {janitor.SHM_DIR}; names are never used twice")
    janitor.record("segment", name)
    file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        os.posix_fallocate(file, 0, total)
        return mmap.mmap(file, total)
    except OSError as error:
        path.unlink()
        janitor.forget("segment", name)
        free = os.statvfs(janitor.SHM_DIR)
        raise ResourceError(
            f"segment {name}: {janitor.SHM_DIR} has no room for {total} bytes ({free.f_bavail * free.f_frsize} free): "
            f"{error.strerror}; enlarge it (mount -o remount,size=2G {janitor.SHM_DIR}, docker run --shm-size=2g), "
            "or lower actors.ring_capacity or actors.num_actors"
        ) from error
    finally:
        os.close(file)


def _path(name: str) -> Path:
    if re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name) is None:
        raise ValueError(f"segment name: got {name!r}, want letters, digits, '.', '_', '-'")
    return janitor.SHM_DIR / name


def aligned(num_bytes: int) -> int:
    """The next multiple of ALIGN_BYTES."""
    return -(-num_bytes // ALIGN_BYTES) * ALIGN_BYTES


def hash_layout(*parts: object) -> int:
    """u64 hash of the printed form of `parts`: what both sides of a segment must agree on."""
    return int.from_bytes(hashlib.blake2b(repr(parts).encode(), digest_size=8).digest(), "little")


class Fence:
    """Orders memory accesses: what stands before the call is done before what stands after it.

    x86-64 keeps stores in order anyway; on ARM two handovers of an uncontended lock are the barrier that plain
    Python offers (release, then acquire; 0.1 microseconds).
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()

    def __call__(self) -> None:
        with self._lock:
            pass
        with self._lock:
            pass
