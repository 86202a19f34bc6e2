"""Becomes a job: `python -m gvz.experiments.child PARENT_PID CORES python-arguments...`.

The process stays on its share of the cores and is asked to stop (SIGTERM: a run saves itself) when its parent dies.
Ray blocks SIGINT in all that it starts, and children inherit that: here it is let through again.
"""

import os
import signal
import sys

from gvz.core.janitor import die_with_parent

if __name__ == "__main__":
    die_with_parent(int(sys.argv[1]), signal.SIGTERM)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM})
    os.sched_setaffinity(0, {int(core) for core in sys.argv[2].split(",")})
    os.execv(sys.executable, [sys.executable, "-P", *sys.argv[3:]])
