"""Is a directory fit to be shared by several machines that run experiments? Locks, renames and fsync, tried in it.

Where several commands work in one results directory, the lock of a job's log says who runs the job, and a checkpoint
appears by one rename.
"""

import contextlib
import json
import os
import secrets
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Generator
from pathlib import Path

from gvz.core import durable, records
from gvz.core.errors import ConfigError
from gvz.run.doctor import Finding

LOCK_FILE = ".gvz-doctor-lock"
NUM_RENAMES = 300
_TIMEOUT_S = 60.0
_HOLDER = """
import sys
from pathlib import Path
from gvz.core import records
file = Path(sys.argv[1]).open("ab")
print(records.lock(file), flush=True)
sys.stdin.read()
"""
_RENAMER = """
import os, sys
from pathlib import Path
directory, count = Path(sys.argv[1]), int(sys.argv[2])
for n in range(count):
    (directory / "new").write_bytes(bytes([n % 256]) * 8192)
    os.replace(directory / "new", directory / "file")
"""


@contextlib.contextmanager
def mark(directory: Path) -> Generator[tuple[str, str]]:
    """A locked file in the directory for other machines to look at (`problem`), removed at the end.

    Returns: its path and its text.
    """
    path, text = directory.resolve() / f".gvz-mark-{secrets.token_hex(8)}", secrets.token_hex(16)
    with path.open("w") as file:
        try:
            records.lock(file)
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
            yield str(path), text
        finally:
            path.unlink()


def problem(path: str, text: str) -> str:
    """What is wrong with another machine's view of a `mark`: a sentence's end; empty if nothing is."""
    file = Path(path)
    try:
        seen = file.read_text()
    except OSError as error:
        return (
            f"does not see the files of {file.parent} ({error.strerror}); mount it on all machines, at the same place"
        )
    if seen != text:
        return f"reads old contents in {file.parent}; {records.MOUNT}"
    if not records.is_locked(file):
        return f"does not see locks of others in {file.parent}; {records.MOUNT}"
    try:
        beside = file.with_name(f"{file.name}-{secrets.token_hex(4)}")
        beside.touch()
        beside.unlink()
    except OSError as error:
        return f"cannot write to {file.parent} ({error.strerror}); mount it for writing"
    return ""


def require_directory(directory: Path) -> None:
    """Raises ConfigError if there is no such directory, or none that this user may write to."""
    if not directory.is_dir() or not os.access(directory, os.W_OK | os.X_OK):
        raise ConfigError(f"--shared: {directory} is no directory that you can write to; make it first")


def check_locks(directory: Path) -> Finding:
    """A lock that one process holds is refused to another, and free when the holder is killed."""
    file = directory / f".gvz-lock-{secrets.token_hex(8)}"
    holder = subprocess.Popen(
        [sys.executable, "-c", _HOLDER, str(file)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    try:
        assert holder.stdout is not None
        if holder.stdout.readline() != "True\n":
            return Finding("locks", "bad", f"{directory}: no lock can be had", records.MOUNT)
        if not records.is_locked(file):
            return Finding("locks", "bad", f"{directory}: two processes got one lock", records.MOUNT)
        holder.kill()
        holder.wait(_TIMEOUT_S)
        deadline_s = time.monotonic() + _TIMEOUT_S
        while records.is_locked(file):
            if time.monotonic() > deadline_s:
                return Finding(
                    "locks", "bad", f"{directory}: a killed process kept its lock {_TIMEOUT_S:.0f} s", records.MOUNT
                )
            time.sleep(0.05)
    finally:
        holder.kill()
        holder.communicate(timeout=_TIMEOUT_S)
        file.unlink(missing_ok=True)
    return Finding("locks", "ok", f"{directory}: one process at a time; a killed one loses its lock")


def check_renames(directory: Path) -> Finding:
    """Whoever reads a file while it is replaced gets the old one or the new one."""
    num_reads, bad = 0, ""
    with tempfile.TemporaryDirectory(prefix=".gvz-rename-", dir=directory) as inside:
        file = Path(inside) / "file"
        file.write_bytes(bytes(8192))
        command = [sys.executable, "-c", _RENAMER, inside, str(NUM_RENAMES)]
        renamer = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        try:
            while not bad and renamer.poll() is None:
                try:
                    seen = file.read_bytes()
                except FileNotFoundError:
                    bad = "a file was missing while it was replaced"
                    break
                num_reads += 1
                if len(seen) != 8192 or len(set(seen)) != 1:
                    bad = "a file was half old and half new while it was replaced"
            _, error = renamer.communicate(timeout=_TIMEOUT_S)
            if not bad and renamer.returncode:
                bad = f"a file could not be replaced: {(error.splitlines() or [f'exit code {renamer.returncode}'])[-1]}"
        finally:
            renamer.kill()
            renamer.communicate()
    if bad:
        return Finding(
            "renames", "bad", f"{directory}: {bad}", "use another file system: a checkpoint appears by a rename"
        )
    return Finding("renames", "ok", f"{NUM_RENAMES} renames, whole in each of {num_reads} reads")


def check_fsync(directory: Path) -> Finding:
    """Files and their directory can be forced to the disk, as a checkpoint is."""
    file = directory / f".gvz-fsync-{secrets.token_hex(8)}"
    begin_s = time.monotonic()
    try:
        with file.open("wb") as stream:
            stream.write(bytes(2**20))
            stream.flush()
            os.fsync(stream.fileno())
        durable.fsync(directory)
    except OSError as error:
        return Finding(
            "fsync", "bad", f"{directory}: {error.strerror}", "use another file system: checkpoints need fsync"
        )
    finally:
        file.unlink(missing_ok=True)
    return Finding("fsync", "ok", f"1 MB and its directory in {1000 * (time.monotonic() - begin_s):.0f} ms")


def check_other_machine(directory: Path) -> Finding:
    """Whether a lock that another machine holds (`hold`) is seen here."""
    file = directory / LOCK_FILE
    name = "machines"
    how = f"on one machine `gvz doctor --shared {directory} --hold 60`, meanwhile on another `gvz doctor --shared ...`"
    if not file.exists():
        return Finding(name, "note", "locks between machines are not tested by one alone", how)
    locked = records.is_locked(file)
    try:
        said = json.loads(file.read_text())
        host, seconds = str(said["host"]), float(said["seconds"])
        with tempfile.TemporaryFile(dir=directory) as now:  # by one clock: those of the machines may differ
            is_held = os.fstat(now.fileno()).st_mtime < file.stat().st_mtime + seconds
    except (ValueError, KeyError, TypeError, OSError):
        host, is_held = "", False
    if locked:
        return Finding(
            name, "ok", f"{host or 'somebody'} holds a lock in it, which is refused on {socket.gethostname()}"
        )
    if is_held:
        return Finding(name, "bad", f"{host} holds a lock in it, which {socket.gethostname()} got, too", records.MOUNT)
    return Finding(name, "note", "locks between machines are not tested by one alone", how)


def hold(directory: Path, seconds: float, say: Callable[[str], None]) -> None:
    """Holds a lock for `check_other_machine` on another machine.

    Raises:
        ConfigError: somebody holds it already.
    """
    file = directory / LOCK_FILE
    with file.open("a+") as stream:
        if not records.lock(stream):
            raise ConfigError(
                f"--hold: somebody holds the lock in {directory} already; give the command without --hold"
            )
        stream.truncate(0)
        stream.write(json.dumps({"host": socket.gethostname(), "seconds": seconds}))
        stream.flush()
        os.fsync(stream.fileno())
        try:
            say(f"holding a lock for {seconds:g} s; now, on another machine: gvz doctor --shared {directory}")
            time.sleep(seconds)
        finally:
            file.unlink(missing_ok=True)


CHECKS: tuple[Callable[[Path], Finding], ...] = (check_locks, check_renames, check_fsync, check_other_machine)
