"""A clock that leaves out our own pauses, and a watchdog for a process that hangs. Standard library only.

`Watchdog` ends a process whose main loop is stuck where no Python code of its own can time it out: in a call into the
device's runtime, or in C code that holds the interpreter's lock. Its clock is in a process of its own, `python
watchdog.py WHO TIMEOUT_S`. A thread of the watched process stays silent
while C code holds the lock. `faulthandler.dump_traceback_later` does not need the lock, but its clock goes on while the
process is stopped, so that a process that is continued after a long stop would be ended at once.
"""

import contextlib
import faulthandler
import os
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

_LAST_SIGNAL = signal.SIGVTALRM
"""writes the stacks and ends the process. Not used by others: Slurm sends USR1 and USR2, pytest-timeout ALRM"""
_DUMP_TIMEOUT_S = 5.0
"""for the stacks; then SIGKILL"""


class AwakeClock:
    """Counts the seconds in which this process looked at it.

    A process that was stopped (Ctrl-Z, a paused container) or busy for a while has heard nothing of the others in that
    time, and that is not their silence. So the time between two looks counts as `longest_s` at most.

    Attributes:
        now_s: seconds that count, at the last look.
    """

    def __init__(self, longest_s: float = 1.0):
        self.now_s, self._longest_s, self._looked_s = 0.0, longest_s, time.monotonic()

    def look(self) -> float:
        """Seconds that count, now."""
        time_s = time.monotonic()
        self.now_s += min(time_s - self._looked_s, self._longest_s)
        self._looked_s = time_s
        return self.now_s


class Watchdog:
    """While it is entered, the process is ended when `beat` was not called for too long.

    A message and the stacks of all threads are written first, so that one sees who waited for whom. Time in which the
    process was stopped (Ctrl-Z, a paused container) does not count.
    """

    def __init__(self, who: str, timeout_s: float):
        """`who` is named in the message."""
        self._who, self._timeout_s, self._next_beat_s = who, timeout_s, 0.0

    def __enter__(self) -> "Watchdog":
        faulthandler.register(_LAST_SIGNAL, file=2, all_threads=True, chain=True)  # chain: then its default, the end
        reading, self._writing = os.pipe()
        command = [sys.executable, "-I", "-S", __file__, self._who, str(self._timeout_s)]
        # a session of its own: Ctrl-C and Ctrl-Z are not for it
        self._process = subprocess.Popen(command, stdin=reading, start_new_session=True)
        os.close(reading)
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._writing)
        faulthandler.unregister(_LAST_SIGNAL)

    def beat(self) -> None:
        """A sign of life."""
        now_s = time.monotonic()
        if now_s >= self._next_beat_s:
            self._next_beat_s = now_s + self._timeout_s / 100
            with contextlib.suppress(BrokenPipeError):  # somebody has ended the watchdog
                os.write(self._writing, b".")


def _watch(who: str, timeout_s: float) -> None:
    """Reads signs of life from standard input until its other end is closed; ends the parent if they stay away."""
    parent, period_s = os.getppid(), timeout_s / 20
    clock, heard_s = AwakeClock(2 * period_s), 0.0
    while (silent_s := clock.look() - heard_s) <= timeout_s:
        beating = bool(select.select([sys.stdin], [], [], period_s)[0])
        if beating and not os.read(sys.stdin.fileno(), 4096):
            return
        if beating or _is_stopped(parent):
            heard_s = clock.look()
    with contextlib.suppress(OSError):  # standard error is gone, or its disk is full
        print(
            f"error: {who} gave no sign of life for {silent_s:.0f} s and is ended; the stacks of its threads, the "
            "newest call first:",
            file=sys.stderr,
            flush=True,
        )
    os.kill(parent, _LAST_SIGNAL)
    if not select.select([sys.stdin], [], [], _DUMP_TIMEOUT_S)[0]:  # its end closes the pipe
        os.kill(parent, signal.SIGKILL)


def _is_stopped(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:  # it has just ended
        return True
    return state in "Tt"


if __name__ == "__main__":
    _watch(sys.argv[1], float(sys.argv[2]))
