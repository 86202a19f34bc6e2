"""Ends a process whose main loop is stuck where no Python code can time it out: in a call into the device's runtime,
for one. Standard library only.
"""

import faulthandler
import os
import sys
import threading
import time
from types import TracebackType


class Watchdog:
    """While it is entered, a thread ends the process with code 1 when `beat` was not called for too long.

    It prints the stacks of all threads first, so that one sees who waited for whom. Time in which the whole process
    was stopped (Ctrl-Z, a paused container) does not count.
    """

    def __init__(self, who: str, timeout_s: float):
        """`who` is named in the message."""
        self._who, self._timeout_s, self._beats = who, timeout_s, 0
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="watchdog", daemon=True)

    def __enter__(self) -> "Watchdog":
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self._ended.set()

    def beat(self) -> None:
        """A sign of life."""
        self._beats += 1

    def _watch(self) -> None:
        period_s = self._timeout_s / 20
        seen, silent_s, before_s = self._beats, 0.0, time.monotonic()
        while not self._ended.wait(period_s):
            now_s = time.monotonic()
            silent_s = 0.0 if seen != self._beats else silent_s + min(now_s - before_s, 2 * period_s)
            seen, before_s = self._beats, now_s
            if silent_s > self._timeout_s:
                print(
                    f"error: {self._who} gave no sign of life for {silent_s:.0f} s and is ended; the stacks of its "
                    "threads, the newest call first:",
                    file=sys.stderr,
                    flush=True,
                )
                faulthandler.dump_traceback(all_threads=True)
                os._exit(1)
