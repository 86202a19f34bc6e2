"""Finds and removes what dead processes of ours left behind. Linux; standard library and gvz.core.errors only.

A SIGKILL leaves private directories and, at worst, engines with their files in /dev/shm. (Our own shared memory is
anonymous: the kernel frees it.) So whoever makes such a thing first writes a record of it: a small private file that
names the thing and its owner (process id and start time, so that a reused process id is not mistaken for its owner).
`clean_dead_instances` removes what belongs to records whose owner is gone, and nothing else: nothing is ever matched
by a pattern of names.

Every step can be repeated and any number of janitors may run at once: names are never used twice.
"""

import contextlib
import ctypes
import hashlib
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
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Literal

from gvz.core.errors import ResourceError, WaitTimeoutError

Kind = Literal["engine", "directory"]
"""engine: `name` is an engine's private directory; directory: a `temporary_directory`."""

SHM_DIR = Path("/dev/shm")
ENGINE_DIR_PREFIX = "gvz-engine-"
"""every engine's private directory is called so, followed by random letters"""
INSTANCE_FILE = "instance"
"""in an engine's private directory: "pid start id" of its engine, written by `gvz/engine/wrapper.py`"""
ARGUMENTS_FILE = "arguments"
"""likewise: the engine's arguments, which its launcher writes first of all, some milliseconds before it is an engine"""
LAUNCHER_FILE = "launch"
"""likewise: what the client launches"""
_LAUNCH_S = 0.05
"""from fork to the first line of a launcher, and ample"""
_PARTIAL_S = 3600.0
"""a record that is half written after this time will never be whole"""
KILL_TIMEOUT_S = 30.0
"""the kernel takes milliseconds over a SIGKILL, unless the process hangs in a driver or in a dead file system"""
_ENGINE_SHM_PREFIXES = ("ViZDoomSM", "ViZDoomMQCtr", "ViZDoomMQDoom")
_DIRECTORY = re.compile(r"gvz-[a-z]+-[0-9a-f]{16}")
"""names of a `temporary_directory`"""
_PR_SET_PDEATHSIG = 1
_UNREADABLE = (OSError, ValueError, KeyError, TypeError, RecursionError)
"""what reading a damaged or forged record ends in"""


def runtime_dir() -> Path:
    """This user's private directory for records and locks (made if missing, mode 0700).

    Raises:
        ResourceError: the directory exists but is not ours alone, or cannot be made.
    """
    base = os.environ.get("XDG_RUNTIME_DIR")
    if not base or not os.access(base, os.W_OK | os.X_OK):
        base = tempfile.gettempdir()
    path = Path(base) / f"gvizdoom-{os.getuid()}"
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        found = path.lstat()
    except OSError as error:
        raise ResourceError(f"runtime directory {path}: {error}; set TMPDIR to a writable directory") from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise ResourceError(
            f"runtime directory {path}: got owner {found.st_uid}, mode {stat.filemode(found.st_mode)}, "
            f"want a directory of user {os.getuid()} that nobody else can enter (drwx------); "
            "remove it, or set TMPDIR to another directory"
        )
    return path


def record(kind: Kind, name: str) -> None:
    """Notes that this process owns `name`. Call it before the thing is made: no instant is unprotected."""
    _check_name(kind, name)
    path = _record_path(kind, name)
    content = {
        "kind": kind,
        "name": name,
        "owner_pid": os.getpid(),
        "owner_start": process_start(os.getpid()),
        "machine": _machine(),
    }
    # whole or not at all: a janitor never sees half a record
    partial = path.with_suffix(".partial")
    with os.fdopen(os.open(partial, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "w") as file:
        json.dump(content, file)
    partial.replace(path)


def forget(kind: Kind, name: str) -> None:
    """Takes back this process's `record`; call it after the thing is gone. Unknown names are ignored."""
    _record_path(kind, name).unlink(missing_ok=True)


@contextlib.contextmanager
def temporary_directory(purpose: str) -> Generator[Path, None, None]:
    """A private directory that goes with the block; if this process is killed in it, with the next start.

    Args:
        purpose: becomes a part of its name; lower-case letters.
    """
    directory = Path(tempfile.gettempdir()) / f"gvz-{purpose}-{secrets.token_hex(8)}"
    record("directory", str(directory))
    try:
        directory.mkdir(mode=0o700)
        yield directory
    finally:
        shutil.rmtree(directory, ignore_errors=True)
        forget("directory", str(directory))


def clean_dead_instances() -> list[str]:
    """Removes what dead owners left: engines, their shared memory, private directories.

    Returns:
        One line for each thing removed, and for each record that cannot be read (these are left alone).
    """
    done: list[str] = []
    for partial in runtime_dir().glob("*.partial"):  # whose writer was killed: writing takes no millisecond
        with contextlib.suppress(FileNotFoundError):
            if time.time() - partial.stat().st_mtime > _PARTIAL_S:
                partial.unlink()
    for path in _records():
        try:
            dead = _read_dead(path)
            if dead is not None:
                kind, name = dead
                done += _REMOVE[kind](name)
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
        with contextlib.suppress(*_UNREADABLE):
            dead = _read_dead(path)
            if dead is not None:
                found.append(dead[1])
    return found


def _records() -> list[Path]:
    return sorted(runtime_dir().glob("*.json"))


def _read_dead(path: Path) -> tuple[str, str] | None:
    """Kind and name of a record whose owner is gone; None if it lives, or belongs to another machine."""
    content = json.loads(path.read_text())
    kind, name, pid, start = (content[key] for key in ("kind", "name", "owner_pid", "owner_start"))
    _check_name(kind, name)
    if type(pid) is not int or type(start) is not int:
        raise ValueError(f"got owner {pid!r} of start {start!r}, want two numbers")
    if content["machine"] != _machine() or process_start(pid) == start:
        return None
    return kind, name


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
            done.append(f"engine {instance_id} (pid {pid})")
        for prefix in _ENGINE_SHM_PREFIXES:
            done += _unlink_shm(prefix + instance_id)
    return done + _remove_directory(directory)


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
    died before that line, they are what nobody holds any more of the queues that are younger than the launcher.
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


def die_with_parent(parent_pid: int) -> None:
    """Has the kernel kill this process when the thread that started it ends; exits if that has happened already."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL) != 0:
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


def _machine() -> str:
    """Process ids mean something only within one boot and one pid namespace (containers may share a disk)."""
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return f"{boot} {Path('/proc/self/ns/pid').readlink()}"


def _record_path(kind: Kind, name: str) -> Path:
    digest = hashlib.blake2b(name.encode(), digest_size=8).hexdigest()
    return runtime_dir() / f"{kind}-{os.getpid()}-{process_start(os.getpid())}-{digest}.json"


def _check_name(kind: str, name: str) -> None:
    """A damaged or forged record must not make us delete anything but what we could have made."""
    if kind == "engine":
        good = Path(name).is_absolute() and Path(name).name.startswith(ENGINE_DIR_PREFIX) and ".." not in name
        wanted = f"an absolute path that ends in {ENGINE_DIR_PREFIX}..."
    elif kind == "directory":
        good = Path(name).is_absolute() and ".." not in name and _DIRECTORY.fullmatch(Path(name).name) is not None
        wanted = "an absolute path that ends in gvz-PURPOSE-0123456789abcdef"
    else:
        raise ValueError(f"record of kind {kind!r}: want engine or directory")
    if not good:
        raise ValueError(f"record of kind {kind!r}: got name {name!r}, want {wanted}")


def _unlink_shm(name: str) -> list[str]:
    try:
        (SHM_DIR / name).unlink()
    except FileNotFoundError:
        return []
    return [f"shared memory {name}"]


def _remove_directory(directory: Path) -> list[str]:
    if not directory.is_dir():
        return []
    shutil.rmtree(directory, ignore_errors=True)
    return [f"directory {directory}"]


_REMOVE: dict[str, Callable[[str], list[str]]] = {
    "engine": lambda name: clean_engine(Path(name)),
    "directory": lambda name: _remove_directory(Path(name)),
}
"""by kind: removes what a record names, returns a line for each thing removed"""
