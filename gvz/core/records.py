"""Record files, one JSON object a line: their writer, their reader, and the lock that one process holds. Tier 0.

A row begins with the number of its schema. A file that ends in `.gz` is compressed: it is read like the others, and
never written to.
"""

import errno
import fcntl
import gzip
import io
import json
import os
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import IO, Any

from gvz.core.durable import fsync
from gvz.core.errors import GvzError, ResourceError
from gvz.core.stop import uninterrupted

SCHEMA = 1
"""Stands in every row as `schema`; raised by one when a row's meaning changes."""

MAX_LINE_LENGTH = 2**20
MAX_LINES = 2**22
"""far beyond any record of ours; a small compressed file could hold more than fits into memory"""
MAX_WAITING_BYTES = 64 * 2**20
"""rows kept in memory while the disk is full: hours of a run"""
TAIL_BYTES = 2**14
MOUNT = "mount it so that flock reaches the server: NFS 4 without `local_lock`, Lustre with `-o flock`"
"""what to do about a file system without locks"""
_NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS}


class Writer:
    """Appends rows to a record file, each of them flushed. On a full disk rows wait in memory for the next one."""

    def __init__(self, path: Path):
        """The file is opened, and created where there is none, with the first row or by `lock`."""
        self._path, self._waiting = path, bytearray()
        self._file: io.FileIO | None = None

    def lock(self) -> bool:
        """Makes this process the only one that may write, until it closes the file; False if another one is, or has
        just put another file in its place.

        Raises:
            OSError: the file cannot be opened.
        """
        file = self._opened()
        return lock(file) and is_at(file, self._path)

    def append(self, row: dict[str, Any]) -> None:
        """Adds a row.

        Raises:
            GvzError: the disk is full and too many rows wait.
        """
        self._waiting += json.dumps({"schema": SCHEMA, **row}).encode() + b"\n"
        try:
            self._write()
        except OSError as error:
            if self.waiting_bytes > MAX_WAITING_BYTES:
                raise self._unwritten(error) from error

    @property
    def waiting_bytes(self) -> int:
        """Length of the rows that are not on the disk yet."""
        return len(self._waiting)

    def close(self) -> None:
        """Writes what waits, closes the file and unlocks it.

        Raises:
            GvzError: there is still no room for the rows that wait.
        """
        try:
            self._write()
        except OSError as error:
            raise self._unwritten(error) from error
        finally:
            if self._file is not None:
                self._file.close()
                self._file = None
            self._waiting.clear()

    def _opened(self) -> io.FileIO:
        if self._file is None:
            self._file = self._path.open("ab", buffering=0)
        return self._file

    def _write(self) -> None:
        while self._waiting:  # the disk may take a part of a row
            with uninterrupted():  # else a Ctrl-C in between would have `close` write it again
                del self._waiting[: self._opened().write(self._waiting)]

    def _unwritten(self, error: OSError) -> GvzError:
        return GvzError(
            f"{self._path}: {self.waiting_bytes} bytes of records cannot be written: {error.strerror}; make room and "
            "give the same command again"
        )


def lock(file: IO[Any], *, wait: bool = False) -> bool:
    """Locks an open file for this process and its children; False if another process holds the lock.

    The kernel takes the lock back when the last of them has closed the file or has ended.

    Args:
        file: an open file.
        wait: until the other process has given it back, instead of returning False.

    Raises:
        ResourceError: the file system has no locks.
    """
    return _flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))


def _flock(file: IO[Any], how: int) -> bool:
    try:
        fcntl.flock(file, how)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
        path = Path(f"/proc/self/fd/{file.fileno()}").readlink()
        raise ResourceError(
            f"{path} cannot be locked: {error.strerror}; want a file system with locks, so that one process at a time "
            f"has the file: choose another place ($GVZ_RUNTIME_DIR for the locks of engines), or {MOUNT}"
        ) from error
    return True


def is_at(file: IO[Any], path: Path) -> bool:
    """Whether an open file still has this path: another one may have taken its place before it was locked."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False


def unlock(file: IO[Any]) -> None:
    """Takes back the lock of an open file, also from forks that have it open."""
    fcntl.flock(file, fcntl.LOCK_UN)


def is_locked(path: Path) -> bool:
    """Whether a process holds the lock of this file."""
    if not path.exists():
        return False
    with path.open("rb") as file:
        return not _flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # NFS gives a reader no other lock


def stored(path: Path) -> Path | None:
    """The record file of this name or, where it was compressed, the one with `.gz` behind it; None if there is none."""
    return next((file for file in (path, path.with_name(f"{path.name}.gz")) if file.exists()), None)


def read(path: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """Reads a record file; everything readable is returned.

    Returns: rows, and one message for each line that is damaged or of another schema.

    Raises:
        GvzError: there is no such file.
    """
    if not path.exists():
        raise GvzError(f"{path}: no such record file; is {path.parent} a run directory?")
    rows: list[dict[str, Any]] = []
    problems: list[str] = []
    try:
        for number, line in enumerate(lines(path), 1):
            if len(line) == MAX_LINE_LENGTH or number > MAX_LINES:
                problems.append(
                    f"{path}, line {number}: not read on; want lines shorter than {MAX_LINE_LENGTH} characters, and at "
                    f"most {MAX_LINES} of them"
                )
                break
            try:
                row = json.loads(line)
            except (ValueError, RecursionError):
                problems.append(f"{path}, line {number}: not JSON (half-written?)")
                continue
            if not isinstance(row, dict) or row.get("schema") != SCHEMA:
                got = row.get("schema") if isinstance(row, dict) else type(row).__name__
                problems.append(f"{path}, line {number}: schema {got!r}, want {SCHEMA}")
                continue
            rows.append(row)
    except (OSError, EOFError, zlib.error) as error:
        problems.append(f"{path}, after {len(rows)} rows: cannot be read on ({error})")
    return rows, problems


def read_stored(path: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """`read` of the file or of its compressed form; nothing if there is neither."""
    file = stored(path)
    return ([], []) if file is None else read(file)


def lines(path: Path) -> Iterator[str]:
    """The lines of a record file, cut at MAX_LINE_LENGTH characters."""
    with gzip.open(path, "rt", errors="replace") if path.suffix == ".gz" else path.open(errors="replace") as file:
        yield from iter(partial(file.readline, MAX_LINE_LENGTH), "")


def last_lines(path: Path, num_bytes: int = TAIL_BYTES) -> list[str]:
    """The lines at the end of a text file that are not blank, the first of them perhaps cut; none without a file."""
    if not path.exists():
        return []
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - num_bytes))
        return [line for line in file.read().decode(errors="replace").splitlines() if line.strip()]


def newest_rows(path: Path) -> Iterator[dict[str, Any]]:
    """The rows of a record file or of its compressed form, newest first, damaged ones left out: those of the file's end
    alone, and some of them again; none without a file.
    """
    if not path.exists():
        yield from reversed(read_stored(path)[0])
        return
    for num_bytes in (TAIL_BYTES, 2 * MAX_LINE_LENGTH):  # a row with many tasks is long
        for line in reversed(last_lines(path, num_bytes)):
            try:
                row = json.loads(line)
            except (ValueError, RecursionError):  # half-written, or no row of ours
                continue
            if isinstance(row, dict):
                yield row


def cut(path: Path, length: int, rest: Path) -> int:
    """Cuts a record file to `length` bytes and appends what stood behind them to `rest`; returns how many bytes."""
    if not path.exists() or path.stat().st_size <= length:
        return 0
    rest.parent.mkdir(exist_ok=True)
    with path.open("r+b") as file, rest.open("ab") as kept:
        file.seek(length)
        num_bytes = kept.write(file.read())
        kept.flush()  # on a full disk this fails, and nothing is cut
        file.truncate(length)
    return num_bytes


def split(path: Path, leaves: Callable[[dict[str, Any]], bool]) -> tuple[bytes, bytes]:
    """The lines of a record file that stay in it, damaged ones among them, and the rows that leave it."""
    parts = bytearray(), bytearray()
    for line in path.read_bytes().splitlines(keepends=True):
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            row = None
        parts[isinstance(row, dict) and leaves(row)].extend(line)
    return bytes(parts[0]), bytes(parts[1])


def move_rows(path: Path, leaves: Callable[[dict[str, Any]], bool], rest: Path) -> None:
    """Moves rows of a record file that this process has locked to the end of `rest`. After a power cut the file is the
    old one or the new one, and no row is lost.

    Raises:
        OSError: the disk does not take them; the file is as it was.
    """
    stay, leave = split(path, leaves)
    if not leave:
        return
    rest.parent.mkdir(exist_ok=True)
    with rest.open("ab") as kept:
        kept.write(leave if leave.endswith(b"\n") else leave + b"\n")
    fsync(rest)
    fsync(rest.parent)
    temporary = path.with_name(f"{path.name}.tmp")
    try:
        temporary.write_bytes(stay)
        fsync(temporary)
        temporary.replace(path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    fsync(path.parent)


def cut_half_row(path: Path) -> bytes:
    """Cuts off a last row that a killed process wrote only in part.

    Returns: the last line if it is no row of ours, which is left as it is; else nothing.
    """
    data = path.read_bytes()
    end = data.rfind(b"\n") + 1
    half, begin = data[end:], b'{"schema": '
    if not half.startswith(begin[: len(half)]):
        return half
    if half:  # a device has none, and cannot be cut
        os.truncate(path, end)
    return b""
