"""Finds and removes what dead processes of ours left behind. Linux; standard library and gvz.core only.

A SIGKILL leaves private directories and, at worst, engines with their files in /dev/shm. (Our own shared memory is
anonymous: the kernel frees it.) Before a process makes a private directory, it writes a record of it, a small private
file, and holds the lock of that file until the directory is gone. The kernel unlocks it when the process ends, however
it ends. `clean_dead_instances` removes what belongs to unlocked records, and nothing else: nothing is ever matched by a
pattern of names. A fork of an owner holds the lock, too.

Every step can be repeated and any number of janitors may run at once: names are never used twice.
"""

import contextlib
import ctypes
import json
import os
import re
import secrets
import shutil
import signal
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Generator
from pathlib import Path
from typing import IO

from gvz.core import records
from gvz.core.errors import ResourceError, WaitTimeoutError
from gvz.core.stop import uninterrupted

SHM_DIR = Path("/dev/shm")
PREFIX = "gvz-engine-"
"""every private directory is called so, followed by random letters"""
INSTANCE_FILE = "instance"
"""in an engine's private directory: "pid start id" of the engine, written by `gvz/engine/wrapper.py`"""
ARGUMENTS_FILE = "arguments"
"""in the same directory: the engine's arguments; the launcher writes them milliseconds before it becomes the engine"""
LAUNCHER_FILE = "launch"
"""in the same directory: the script that the client launches"""
_LAUNCH_S = 0.05
"""more than a launcher takes from its fork to its first line"""
KILL_TIMEOUT_S = 30.0
"""the kernel takes milliseconds over a SIGKILL, unless the process hangs in a driver or in a dead file system"""
QUEUE_PREFIXES = ("ViZDoomMQCtr", "ViZDoomMQDoom")
"""of the names of an engine's message queues in shared memory, each followed by its instance id"""
_ENGINE_SHM_PREFIXES = ("ViZDoomSM", *QUEUE_PREFIXES)
_PR_SET_PDEATHSIG = 1
_UNREADABLE = (OSError, ValueError, KeyError, TypeError, RecursionError, ResourceError)
"""what reading a damaged or forged record ends in, or one on a file system without locks"""
_held: dict[Path, int] = {}
"""descriptors of this process's records, locked. No file objects: Python closes these while it ends, when a thread of
ViZDoom's client may still start an engine."""


def runtime_dir() -> Path:
    """This user's private directory for records and locks (made if missing, mode 0700): in $GVZ_RUNTIME_DIR, or else
    the temporary directory. All processes of a user have to find it, so it is not in $XDG_RUNTIME_DIR, which cron,
    containers and batch jobs lack.

    Raises:
        ResourceError: the directory exists but is not ours alone, or cannot be made; or $GVZ_RUNTIME_DIR is relative.
    """
    given = Path(os.environ.get("GVZ_RUNTIME_DIR") or _temporary_place())
    if not given.is_absolute():
        raise ResourceError(
            f"GVZ_RUNTIME_DIR: got {given}, want an absolute path: all processes of a user have to find it, whatever "
            "directory they are in"
        )
    path = given / f"gvizdoom-{os.getuid()}"
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        found = path.lstat()
    except OSError as error:
        raise ResourceError(
            f"runtime directory {path}: {error}; set GVZ_RUNTIME_DIR or TMPDIR to a writable directory"
        ) from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise ResourceError(
            f"runtime directory {path}: got owner {found.st_uid}, mode {stat.filemode(found.st_mode)}, "
            f"want a directory of user {os.getuid()} that nobody else can enter (drwx------); "
            "remove it, or set GVZ_RUNTIME_DIR to another directory"
        )
    return path


def _temporary_place() -> str:
    try:
        with uninterrupted():  # Python tries the directory with a file of its own, which would stay
            return tempfile.gettempdir()
    except FileNotFoundError as error:
        raise ResourceError(f"{error.strerror}; make room in one, or set TMPDIR to a writable directory") from error


def make_directory(place: Path | None = None) -> Path:
    """A new private directory of this process, by default in the temporary directory; who is done with it calls
    `clean_engine` and `forget`.
    """
    directory = (place or Path(_temporary_place())) / (PREFIX + secrets.token_hex(8))
    record(directory)
    try:
        directory.mkdir(mode=0o700)
    except BaseException:
        forget(directory)
        raise
    return directory


@contextlib.contextmanager
def temporary_directory(place: Path | None = None) -> Generator[Path, None, None]:
    """A `make_directory` that goes with the block; if this process is killed in it, with the next start."""
    directory = make_directory(place)
    try:
        yield directory
    finally:
        clean_engine(directory)
        forget(directory)


def record(directory: Path) -> None:
    """Notes that this process owns a private directory. Call it before that is made: no instant is unprotected."""
    path = _record_path(_checked(directory))
    while directory not in _held:
        with _opened(path) as file:
            if records.lock(file) and path.exists():  # else a janitor has taken the empty file for one of a dead owner
                json.dump({"directory": str(directory), "owner_pid": os.getpid()}, file)
                file.flush()
                _held[directory] = os.dup(file.fileno())  # shares the lock


def forget(directory: Path) -> None:
    """Takes back this process's `record`; call it after the directory is gone. Unknown ones are ignored."""
    _record_path(directory).unlink(missing_ok=True)
    if directory in _held:
        os.close(_held.pop(directory))


def clean_dead_instances() -> list[str]:
    """Removes what dead owners left: engines, their shared memory, private directories.

    Returns:
        One line for each thing removed, and for each record that cannot be read (these are left alone).
    """
    done: list[str] = []
    for path in _records():
        try:
            with path.open() as file:
                if records.lock(file):  # else its owner lives, or another janitor is at it
                    directory = _read(file)
                    done += [] if directory is None else clean_engine(directory)
                    path.unlink(missing_ok=True)
        except FileNotFoundError:
            continue  # its owner, or another janitor, was faster
        except _UNREADABLE as error:
            done.append(f"left alone: unreadable record {path} ({error})")
    return done


def dead_instances() -> list[str]:
    """What `clean_dead_instances` would remove: private directories."""
    found: list[str] = []
    for path in _records():
        with contextlib.suppress(*_UNREADABLE), path.open() as file:
            directory = _read(file) if records.lock(file) else None
            found += [] if directory is None else [str(directory)]
    return found


def _records() -> list[Path]:
    return sorted(runtime_dir().glob("*.json"))


def _record_path(directory: Path) -> Path:
    return runtime_dir() / f"{directory.name}.json"


def _opened(path: Path) -> IO[str]:
    return os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC, 0o600), "w")


def _read(file: IO[str]) -> Path | None:
    """The directory that a record names; None if its owner died before it wrote the name."""
    text = file.read()
    return _checked(Path(json.loads(text)["directory"])) if text else None


def _checked(directory: Path) -> Path:
    """A damaged or forged record must not make us delete anything but what we could have made."""
    if not directory.is_absolute() or not directory.name.startswith(PREFIX) or ".." in directory.parts:
        raise ValueError(f"record of {str(directory)!r}: want an absolute path that ends in {PREFIX}...")
    return directory


def clean_engine(directory: Path) -> list[str]:
    """Ends the engine of a private directory if it runs, unlinks its shared memory, deletes the directory."""
    done: list[str] = []
    instance = read_instance(directory)
    if instance is None:
        for name in _launched_or_orphaned(directory):
            done += _unlink_shm(name)
    else:
        pid, start, instance_id = instance
        # the engine carries its instance id on its command line: proof that this process is the one recorded
        if process_start(pid) == start and instance_id in _arguments(pid):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
            wait_for_death(pid, start)  # until then, one that starts could still make its shared memory
            done.append(f"engine {instance_id} (pid {pid})")
        for prefix in _ENGINE_SHM_PREFIXES:
            done += _unlink_shm(prefix + instance_id)
    if directory.is_dir():
        shutil.rmtree(directory, ignore_errors=True)
        done.append(f"directory {directory}")
    return done


def read_instance(directory: Path) -> tuple[int, int, str] | None:
    """(pid, start time, instance id) of the engine of a private directory; None if none was launched."""
    try:
        text = (directory / INSTANCE_FILE).read_text()
    except FileNotFoundError:
        return None
    match = re.fullmatch(r"(\d+) (\d+) ([A-Za-z0-9]+)\n", text)
    if match is None:
        raise ValueError(f"{directory / INSTANCE_FILE}: got {text!r}, want process id, start time, instance id")
    return int(match[1]), int(match[2]), match[3]


def _launched_or_orphaned(directory: Path) -> list[str]:
    """What may be in shared memory of an engine that died before it noted who it is.

    Its client makes two message queues and then launches it. The launcher's first line notes their id. If the client
    died before that line, the queues are found in another way: they are younger than the launcher, and no process has
    mapped them.
    """
    launcher = directory / LAUNCHER_FILE
    if not launcher.exists():
        return []
    if not (directory / ARGUMENTS_FILE).exists():
        time.sleep(_LAUNCH_S)  # it may be on its way
    if (directory / ARGUMENTS_FILE).exists():
        text = (directory / ARGUMENTS_FILE).read_text(errors="replace")
        match = re.search(r"\+viz_instance_id ([A-Za-z0-9]+)\b", text)
        return [] if match is None else [prefix + match[1] for prefix in _ENGINE_SHM_PREFIXES]
    since_s = launcher.stat().st_mtime
    unheld = _unheld_queues(since_s)
    if unheld:
        time.sleep(_LAUNCH_S)  # a live client holds its queues microseconds after it has made them
        unheld &= _unheld_queues(since_s)
    return sorted(unheld)


def _unheld_queues(since_s: float) -> set[str]:
    """This user's message queues made since then, of no engine that ever ran, and mapped by no process."""
    names: set[str] = set()
    for file in SHM_DIR.glob("ViZDoomMQ*"):
        with contextlib.suppress(FileNotFoundError):
            found = file.stat()
            ran = (SHM_DIR / re.sub("MQ(Ctr|Doom)", "SM", file.name, count=1)).exists()
            if found.st_uid == os.getuid() and found.st_mtime >= since_s and not ran:
                names.add(file.name)
    for maps in Path("/proc").glob("[0-9]*/maps") if names else ():
        with contextlib.suppress(OSError):
            text = maps.read_text()
            names = {name for name in names if f"/{name}" not in text}
    return names


def die_with_parent(parent_pid: int, number: int = signal.SIGKILL) -> None:
    """Has the kernel send this process a signal when the thread that started it ends; exits if that has happened."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, number) != 0:
        raise OSError(ctypes.get_errno(), "prctl(PR_SET_PDEATHSIG)")
    if os.getppid() != parent_pid:
        sys.exit(1)


def reap_killed(process: "subprocess.Popen[bytes]", who: str) -> None:
    """Waits for the end of a child that was sent SIGKILL.

    Raises:
        WaitTimeoutError: it is still there.
    """
    try:
        process.wait(KILL_TIMEOUT_S)
    except subprocess.TimeoutExpired as error:
        raise WaitTimeoutError(
            f"waited {KILL_TIMEOUT_S:g} s for {who} (pid {process.pid}) to end after SIGKILL; it hangs in the kernel, "
            "which `ps -o pid,stat,wchan` shows"
        ) from error


def wait_for_death(pid: int, start: int) -> None:
    """Returns when a killed engine has ended, or when the kernel takes too long over it."""
    deadline = time.monotonic() + KILL_TIMEOUT_S
    while process_start(pid) == start and time.monotonic() < deadline:
        time.sleep(0.001)


def process_start(pid: int) -> int | None:
    """Clock ticks from boot to the start of a process; None if it does not exist or is a zombie.

    Differs: psutil's creation time is a wall clock time and moves when the clock is set; this one never does.
    """
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return None
    fields = text[text.rindex(")") + 2 :].split()  # the command's name may hold blanks and brackets
    state, start = fields[0], int(fields[19])
    return None if state in "ZX" else start


def _arguments(pid: int) -> list[str]:
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    except (FileNotFoundError, ProcessLookupError):
        return []


def _unlink_shm(name: str) -> list[str]:
    try:
        (SHM_DIR / name).unlink()
    except FileNotFoundError:
        return []
    return [f"shared memory {name}"]
