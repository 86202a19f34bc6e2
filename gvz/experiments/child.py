"""Becomes a job: `python -m gvz.experiments.child PARENT_PID CORES python-arguments...`. Standard library only.

The process stays on its share of the cores and is asked to stop (SIGTERM: a run saves itself) when its parent dies.
"""

import ctypes
import os
import signal
import sys

_PR_SET_PDEATHSIG = 1


def main(parent_pid: int, cores: str, arguments: list[str]) -> None:
    """Pins, ties to the parent, and executes Python with `arguments` in place of itself."""
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM) != 0:
        sys.exit(f"job: prctl failed: {os.strerror(ctypes.get_errno())}")
    if os.getppid() != parent_pid:  # it died before the line above
        sys.exit(1)
    os.sched_setaffinity(0, {int(core) for core in cores.split(",")})
    os.execv(sys.executable, [sys.executable, *arguments])


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], sys.argv[3:])
