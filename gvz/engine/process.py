"""Start and end of an engine's process: private directory, launch script, start-up limit, watchdog, removal.

Knows processes and files, not vizdoom: the game it starts is any object with `init` and `close`.
"""

import contextlib
import ctypes
import fcntl
import os
import secrets
import shlex
import shutil
import sys
import tempfile
import threading
import time
import weakref
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import IO, Protocol

from gvz.core import janitor
from gvz.core.errors import EngineError, ResourceError

_START_LOCKS = tuple(f"start-{place}" for place in range(min(8, max(2, os.cpu_count() or 1))))
"""at most this many engines of one user start at the same time, over all processes; many at once fail (ViZDoom #355)"""
_SHM_BYTES = 16 * 2**20
"""free shared memory a start needs: the three files of one engine take 10.8 MB"""
_LAUNCHER_MODE = 0o700
_WATCH_PERIOD_S = 0.5


class Startable(Protocol):
    """A vizdoom.DoomGame, as far as this file is concerned."""

    def set_vizdoom_path(self, file_path: str) -> None: ...

    def init(self) -> None: ...

    def close(self) -> None: ...


def make_directory() -> Path:
    """A new private directory for one engine, known to the janitor before it exists."""
    directory = Path(tempfile.gettempdir()) / (janitor.ENGINE_DIR_PREFIX + secrets.token_hex(8))
    janitor.record("engine", str(directory))
    directory.mkdir(mode=0o700)
    return directory


def write_launcher(directory: Path, engine: Path, log: Path) -> Path:
    """Writes the script that the client library launches in place of the engine (see wrapper.py).

    The client has made its message queues by then, so the script notes their id first of all. It is made again for
    every engine, because an installed file might not be executable, and its first line might be too long or hold blanks
    for a `#!` line.

    Raises:
        EngineError: programs in this directory may not be run.
    """
    wrapper = Path(__file__).with_name("wrapper.py")
    words = (sys.executable, "-IS", wrapper, os.getpid(), directory, log, engine)
    launcher, arguments = directory / janitor.LAUNCHER_FILE, shlex.quote(str(directory / janitor.ARGUMENTS_FILE))
    command = shlex.join(str(word) for word in words)
    launcher.write_text(f'#!/bin/sh\nprintf "%s\\n" "$*" >{arguments}\nexec {command} "$@"\n')
    launcher.chmod(_LAUNCHER_MODE)
    if not os.access(launcher, os.X_OK):
        raise EngineError(
            f"engine launcher {launcher}: the file system forbids running programs (noexec); "
            "set TMPDIR to a directory where they may run"
        )
    return launcher


def start(game: Startable, directory: Path, engine: Path, log: Path, timeout_s: float) -> None:
    """Has the game launch this engine, and runs `game.init()`, one of few at a time on this machine, with a deadline.

    It runs in a thread of its own. Past the deadline that thread is left behind, engine and all: ending an engine
    that is still starting would crash this process. Should it come up after all, it is closed at once. Whatever else
    goes wrong, nothing is left, the private directory included.

    Raises:
        ResourceError: not enough free shared memory.
        EngineError: not started within `timeout_s`, or ViZDoom raised, or programs in the directory may not be run.
    """
    deadline = time.monotonic() + timeout_s
    attempt = _Attempt(game, directory)
    try:
        game.set_vizdoom_path(str(write_launcher(directory, engine, log)))
        _require_shared_memory()
        with one_of(_START_LOCKS, deadline):
            finished = attempt.run(max(0.0, deadline - time.monotonic()))
        if not finished:
            raise EngineError(f"engine in {directory}: not started within {timeout_s:g} s{log_tail(log)}")
        if attempt.error is not None:
            tail = log_tail(log)
            raise EngineError(f"engine in {directory}: did not start: {attempt.error!r}{tail}") from attempt.error
    except BaseException:  # Ctrl-C while waiting, too
        attempt.give_up()
        raise


def _require_shared_memory() -> None:
    free = shutil.disk_usage(janitor.SHM_DIR).free
    if free < _SHM_BYTES:
        raise ResourceError(
            f"{janitor.SHM_DIR}: {free / 2**20:.0f} MiB free, an engine needs {_SHM_BYTES / 2**20:.0f}; "
            "enlarge it (docker run --shm-size=1g, or mount -o remount,size=1g /dev/shm)"
        )


class _Attempt:
    """One run of `game.init()` in a thread, which can be given up."""

    def __init__(self, game: Startable, directory: Path):
        self.error: Exception | None = None
        self._game = game
        self._directory = directory
        self._thread = threading.Thread(target=self._init, name=f"start {directory.name}", daemon=True)
        self._lock = threading.Lock()
        self._running = False
        self._given_up = False

    def run(self, timeout_s: float) -> bool:
        """Returns whether it has come to an end in time."""
        self._running = True
        self._thread.start()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def give_up(self) -> None:
        """Ends the engine and removes what it has; at once, or when it has come up."""
        with self._lock:
            self._given_up = True
            if not self._running:
                end(self._game, self._directory)

    def _init(self) -> None:
        try:
            self._game.init()
        except Exception as error:  # handed to the waiting thread
            self.error = error
        with self._lock:
            self._running = False
            if self._given_up:
                end(self._game, self._directory)


@contextlib.contextmanager
def one_of(lock_names: Sequence[str], deadline: float) -> Generator[None, None, None]:
    """Holds one of the named locks, which all processes of this user share; a SIGKILL gives it back too.

    Raises:
        EngineError: none became free before `deadline` (monotonic seconds).
    """
    with contextlib.ExitStack() as stack:
        files = [stack.enter_context((janitor.runtime_dir() / f"{name}.lock").open("w")) for name in lock_names]
        while not any(_try_lock(file) for file in files):
            if time.monotonic() > deadline:
                raise EngineError(f"engine: other processes held {', '.join(lock_names)} for the whole time-out")
            time.sleep(0.005)
        yield


def _try_lock(file: IO[str]) -> bool:
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def end(game: Startable, directory: Path) -> None:
    """Ends an engine and removes what it had. The order matters: with its engine dead, `game.close` cannot hang."""
    janitor.clean_engine(directory)
    game.close()
    janitor.forget("engine", str(directory))


def end_if_ours(game: Startable, directory: Path, owner_pid: int) -> None:
    """`end`; but in a fork of the owner, which inherited the object and not the engine, nothing."""
    if os.getpid() == owner_pid:
        end(game, directory)
    else:
        # its destructor would close the owner's engine, and wait for a thread that is not in this process
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(game))


def log_tail(log: Path, num_lines: int = 8) -> str:
    """The last lines of an engine's log, ready to be put behind an error message."""
    text = ""
    if log.exists():
        with log.open("rb") as file:
            file.seek(max(0, log.stat().st_size - 4096))
            text = file.read().decode(errors="replace")
    lines = [line for line in text.splitlines() if line.strip()]
    return "; its last lines:\n  " + "\n  ".join(lines[-num_lines:]) if lines else "; it printed nothing"


class Watched(Protocol):
    """Something with a deadline (monotonic seconds; None: nothing to wait for) that can be killed."""

    deadline: float | None

    def kill_overdue(self) -> None: ...


_watched: weakref.WeakSet[Watched] = weakref.WeakSet()
_watched_lock = threading.Lock()
_watcher: threading.Thread | None = None


def watch(one: Watched) -> None:
    """From now on `one` is killed when its deadline has passed. One thread watches for the whole process."""
    global _watcher
    with _watched_lock:
        _watched.add(one)
        if _watcher is None or not _watcher.is_alive():  # in a forked child the thread is gone
            _watcher = threading.Thread(target=_watch, name="engine watchdog", daemon=True)
            _watcher.start()


def _watch() -> None:
    while True:
        before_s = time.monotonic()
        time.sleep(_WATCH_PERIOD_S)
        if time.monotonic() - before_s > 4 * _WATCH_PERIOD_S:
            continue  # this process was stopped, so nobody took the engine's answer: it may be there by the next look
        _kill_overdue()


def _kill_overdue() -> None:  # a function of its own: asleep, the thread must hold no reference to an engine
    with _watched_lock:
        watched = list(_watched)
    for one in watched:
        if one.deadline is not None and time.monotonic() > one.deadline:
            one.kill_overdue()
