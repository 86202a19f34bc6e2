"""The start and the end of an engine's process: launch script, limits on starts, watchdog, removal.

Knows processes and files, not vizdoom: the game it starts is any object with `init` and `close`.
"""

import atexit
import contextlib
import ctypes
import os
import shlex
import shutil
import sys
import threading
import time
import weakref
from collections.abc import Generator, Sequence
from pathlib import Path
from typing import Protocol

from gvz.core import janitor, records
from gvz.core.errors import EXIT_INTERRUPTED, EngineError, ResourceError
from gvz.core.stop import blocked_signals, exit_at_once, uninterrupted
from gvz.core.watchdog import AwakeClock
from gvz.engine import queue_locks

_START_LOCKS = tuple(f"start-{place}" for place in range(min(8, max(2, os.cpu_count() or 1))))
"""at most this many engines of a user start at the same time, in all processes; more may fail (ViZDoom #355)"""
_SHM_BYTES = 16 * 2**20
"""free shared memory a start needs: the three files of one engine take 10.8 MB"""
_LAUNCHER_MODE = 0o700
_WATCH_PERIOD_S = 0.5


class Startable(Protocol):
    """A vizdoom.DoomGame, as far as this file is concerned."""

    def set_vizdoom_path(self, file_path: str) -> None: ...

    def init(self) -> None: ...

    def close(self) -> None: ...


def write_launcher(directory: Path, engine: Path, log: Path) -> Path:
    """Writes the script that the client library launches in place of the engine (see wrapper.py).

    The client has made its message queues by then, so the script first notes their id. Every engine has a script of its
    own: an installed file might not be executable, and its path might be too long for a `#!` line or hold blanks.

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
    """Runs `game.init()`, which launches this engine, with a deadline and with few others at a time on this machine.

    It runs in a thread of its own. After the deadline thread and engine are left alone, because ending an engine that
    still starts would crash this process; if it starts later, it is closed at once. So it is after Ctrl-C, and
    the interpreter's exit waits for that. After all other failures nothing is left, not even the private directory.

    Raises:
        ResourceError: not enough free shared memory.
        EngineError: not started within `timeout_s`, or ViZDoom raised, or programs in the directory may not be run.
    """
    deadline = time.monotonic() + timeout_s
    attempt = _Attempt(game, directory, deadline)
    try:
        game.set_vizdoom_path(str(write_launcher(directory, engine, log)))
        _require_shared_memory()
        with one_of(_START_LOCKS, deadline):
            finished = attempt.run()
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

    def __init__(self, game: Startable, directory: Path, deadline: float):
        self.error: Exception | None = None
        self._game = game
        self._directory = directory
        self._deadline = deadline
        self._thread = threading.Thread(target=self._init, name=f"start {directory.name}", daemon=True)
        self._lock = threading.Lock()
        self._ended = threading.Event()  # before Python 3.13, an interrupted `join` takes the thread for ended
        self._running = False
        self._given_up = False

    def run(self) -> bool:
        """Returns whether `init` has ended in time."""
        self._running = True
        self._thread.start()
        return self.wait()

    def wait(self) -> bool:
        """Waits until the deadline; returns whether the thread has ended."""
        return self._ended.wait(max(0.0, self._deadline - time.monotonic()))

    def give_up(self) -> None:
        """Ends the engine and removes what it has: now, or when it has started."""
        with self._lock:
            self._given_up = True
            if not self._running:
                end(self._game, self._directory)

    def _init(self) -> None:
        _starting.add(self)
        try:
            with blocked_signals():  # a launcher that Ctrl-C ends would take this process with it
                self._game.init()
        except Exception as error:  # handed to the waiting thread
            self.error = error
        try:
            with self._lock:
                self._running = False
                if self._given_up:
                    end(self._game, self._directory)
        finally:
            _starting.discard(self)
            self._ended.set()


_starting: set[_Attempt] = set()
os.register_at_fork(after_in_child=_starting.clear)


@atexit.register
def _wait_for_starts() -> None:
    """Gives starts that were interrupted the rest of their time: if a thread is in the client library when the
    interpreter ends, the process aborts, and what the engine has stays. A further Ctrl-C ends the process at once.
    """
    try:
        for attempt in list(_starting):
            attempt.wait()
    except KeyboardInterrupt:
        exit_at_once(EXIT_INTERRUPTED, "interrupted while an engine starts; the next start removes what it leaves")


@contextlib.contextmanager
def one_of(lock_names: Sequence[str], deadline: float) -> Generator[None, None, None]:
    """Holds one of the named locks, which all processes of this user share. After a SIGKILL it is free again, too.

    Raises:
        EngineError: none became free before `deadline` (monotonic seconds).
    """
    with contextlib.ExitStack() as stack:
        files = [stack.enter_context((janitor.runtime_dir() / f"{name}.lock").open("w")) for name in lock_names]
        while (locked := next(filter(records.lock, files), None)) is None:
            if time.monotonic() > deadline:
                raise EngineError(f"engine: other processes held {', '.join(lock_names)} for the whole time-out")
            time.sleep(0.005)
        stack.callback(records.unlock, locked)  # a fork that is not an engine yet would hold it
        yield


def end(game: Startable, directory: Path) -> None:
    """Ends an engine and removes what it had. The order matters: dead and with free locks, `game.close` cannot hang."""
    with uninterrupted():
        instance = janitor.read_instance(directory)
        queues = [] if instance is None else queue_locks.mapped(instance[2])
        janitor.clean_engine(directory)
        queue_locks.free(queues)
        game.close()
        janitor.forget(directory)


def end_if_ours(game: Startable, directory: Path, owner_pid: int) -> None:
    """`end`; in a fork of the owner, which has the object but not the engine, nothing."""
    if os.getpid() == owner_pid:
        end(game, directory)
    else:
        # its destructor would close the owner's engine, and wait for a thread that is not in this process
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(game))


def log_tail(log: Path) -> str:
    """The last lines of an engine's log, to be added to an error message."""
    lines = records.last_lines(log)
    return "; its last lines:\n  " + "\n  ".join(lines[-8:]) if lines else "; it printed nothing"


class Watched(Protocol):
    """What can be killed when its deadline, given by `deadline`, has passed (None: nothing to wait for). If it is dead,
    `free_waiting_call` has a call that waits for it return.
    """

    deadline: float | None

    def kill_overdue(self) -> None: ...

    def free_waiting_call(self) -> None: ...


_watched: weakref.WeakSet[Watched] = weakref.WeakSet()
_watched_lock = threading.Lock()
_watcher: threading.Thread | None = None
_clock = AwakeClock(_WATCH_PERIOD_S)
"""an engine is not overdue because this process was stopped and could not take its answer"""


def watch(one: Watched) -> None:
    """From now on `one` is killed when its deadline has passed. One thread watches for the whole process."""
    global _watcher
    with _watched_lock:
        _watched.add(one)
        if _watcher is None or not _watcher.is_alive():  # in a forked child the thread is gone
            _watcher = threading.Thread(target=_watch, name="engine watchdog", daemon=True)
            _watcher.start()


def _forget_watched() -> None:
    """In a fork, whose parent watches these: a call that another thread was in has no end here, and its engine would be
    killed; the lock may be held by a thread that is not here.
    """
    global _watched, _watched_lock
    _watched, _watched_lock = weakref.WeakSet(), threading.Lock()


os.register_at_fork(after_in_child=_forget_watched)


def deadline(timeout_s: float) -> float:
    """For `Watched.deadline`: it is reached no earlier than in this time."""
    return _clock.now_s + timeout_s + _WATCH_PERIOD_S  # the clock may be a period behind


def _watch() -> None:
    while True:
        time.sleep(_WATCH_PERIOD_S)
        _kill_overdue(_clock.look())


def _kill_overdue(now_s: float) -> None:
    """A function of its own: asleep, the thread must hold no reference to an engine."""
    with _watched_lock:
        watched = list(_watched)
    for one in watched:
        if one.deadline is not None:
            if now_s > one.deadline:
                one.kill_overdue()
            one.free_waiting_call()
