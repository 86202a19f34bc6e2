"""Signals that ask a command to stop: Ctrl-C, SIGTERM, and SIGHUP, which comes when a terminal is closed. The first
asks the loop to finish its update, a second one ends it at once. Standard library.
"""

import atexit
import contextlib
import functools
import os
import signal
import sys
import threading
import time
from collections.abc import Generator
from types import FrameType
from typing import Any, NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_PATIENCE_S = 1.0
"""a call that lasts longer after a signal is spoken of"""
_AGAIN_S = 0.05
"""until what Python dropped is raised again"""

stuck: set[threading.Thread] = set()
"""threads that may wait in C++ without end: beside such a one the interpreter cannot end, so the process does"""


class StopRequest:
    """Catches SIGNALS while it is entered; SIGHUP only where it is not ignored, as by `nohup`. In another thread than
    the main one it catches none: Python lets only that one handle signals.

    A SIGHUP after another signal is no second one: a closed terminal sends two, and systemd sends it with SIGTERM.
    Python drops an exception that is raised inside a destructor or a callback of the garbage collector; it is raised
    again soon after.

    Attributes:
        signal: number of the first signal caught, or None.
        at_once: the first signal ends things too, by KeyboardInterrupt: there is nothing yet that could be saved.
        importing: it ends the process from within the handler: an exception in the middle of the import of a library
            may leave its C++ half made, and the interpreter's end then crashes.
    """

    def __init__(self, *, at_once: bool = False) -> None:
        self.signal: int | None = None
        self.at_once = at_once
        self.importing = False
        self._before: dict[int, object] = {}

    def __enter__(self) -> "StopRequest":
        for number in SIGNALS if _may_handle() else ():
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._handle)
        self._hook_before, sys.unraisablehook = sys.unraisablehook, self._handle_dropped
        return self

    def __exit__(self, *_: object) -> None:
        sys.unraisablehook = self._hook_before
        for number, handler in self._before.items():
            signal.signal(number, handler)  # pyright: ignore[reportArgumentType]  # what signal.signal returned

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del frame
        again = self.signal is not None
        if again and number == signal.SIGHUP:
            return
        if not again:
            self.signal = number
        if self.importing:
            os.write(2, b"stopped at once\n")
            os._exit(self.exit_code)
        if again or self.at_once:
            raise KeyboardInterrupt

    def _handle_dropped(self, dropped: "sys.UnraisableHookArgs") -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            threading.Timer(_AGAIN_S, _interrupt_again).start()  # here it would be dropped, too
        else:
            self._hook_before(dropped)

    @property
    def requested(self) -> bool:
        """A signal has asked the run to stop."""
        return self.signal is not None

    @property
    def exit_code(self) -> int:
        """128 + the signal's number, as shells expect; 0 without one."""
        return 0 if self.signal is None else 128 + self.signal


def _may_handle() -> bool:
    return threading.current_thread() is threading.main_thread()


def _interrupt_again() -> None:
    main = threading.main_thread().ident
    if main is not None and callable(signal.getsignal(signal.SIGTERM)):  # else the command has ended
        signal.pthread_kill(main, signal.SIGTERM)


@contextlib.contextmanager
def told_of_delay(stop: StopRequest) -> Generator[None]:
    """Within it a line is said if a signal comes while the main thread is in a long call, such as a compilation. Python
    runs handlers after the call, and who sees no sign of the first Ctrl-C presses it again.
    """
    if not _may_handle():
        yield
        return
    reading, writing = os.pipe()
    os.set_blocking(writing, False)

    def tell() -> None:
        with open(reading, "rb", buffering=0) as pipe:  # noqa: PTH123
            while number := pipe.read(1):
                time.sleep(_PATIENCE_S)
                if number[0] in SIGNALS and stop.signal is None:
                    say("stopping as soon as the call under way ends; a compilation can take a minute")

    threading.Thread(target=tell, name="signals", daemon=True).start()
    before = signal.set_wakeup_fd(writing)
    try:
        yield
    finally:
        signal.set_wakeup_fd(before)
        os.close(writing)


@contextlib.contextmanager
def blocked_signals() -> Generator[None]:
    """Within it this thread gets none of SIGNALS, nor does a process that is started here. What comes meanwhile is not
    lost: another thread gets it, or this one afterwards. A terminal sends a signal to all processes of a command, and a
    process that has just begun cannot yet say that it is not to end by it.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def uninterrupted() -> Generator[None]:
    """For a clean-up that is sure to end: what handlers would raise comes after it. Other threads get no exceptions."""
    came: list[int] = []
    before: dict[int, Any] = {}
    held = True

    def hold(number: int, frame: FrameType | None) -> None:
        if held:
            came.append(number)
        else:  # another one came while handlers were put back, and this one stayed
            before[number](number, frame)

    if _may_handle():
        before = {number: handler for number in SIGNALS if callable(handler := signal.getsignal(number))}
    try:
        for number in before:
            signal.signal(number, hold)
        yield
    finally:
        held = False
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in came:
            signal.raise_signal(number)


def ignore_signals() -> None:
    """For a process that another one ends: it gets none of SIGNALS, also if it was started with `blocked_signals`."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)


def say(message: str) -> None:
    """A line on standard error, if that can be written: what nobody can see is no reason to end otherwise."""
    try:
        print(message, file=sys.stderr)
    except OSError:
        _flush_to_nowhere_at_exit()


@functools.cache
def _flush_to_nowhere_at_exit() -> None:
    """Python flushes once more when it ends; if that fails, its exit code is 120."""
    atexit.register(lambda: os.dup2(os.open(os.devnull, os.O_WRONLY), 2))


def exit_at_once(code: int, message: str) -> NoReturn:
    """Ends this process without the waits of a normal end: for threads, and for the other processes of a group.

    The message goes to standard error, if that can be written.
    """
    say(message)
    for stream in filter(None, (sys.stdout, sys.stderr)):  # a closed one is None
        with contextlib.suppress(OSError):
            stream.flush()
    os._exit(code)
