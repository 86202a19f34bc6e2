"""Becomes a job: `python -m gvz.experiments.child PARENT_PID CORES python-arguments...`.

The process stays on its share of the cores and is asked to stop (SIGHUP: a run saves itself) when its parent dies. The
kernel asks once for each thread of the parent that ends, and a second SIGTERM would end the run at once. Children
inherit that `nohup` ignores SIGHUP and that Ray blocks SIGINT in all that it starts: here both are let through again.
"""

import os
import signal
import sys

from gvz.core.janitor import die_with_parent
from gvz.core.stop import SIGNALS

if __name__ == "__main__":
    signal.signal(signal.SIGHUP, signal.SIG_DFL)
    die_with_parent(int(sys.argv[1]), signal.SIGHUP)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    os.sched_setaffinity(0, {int(core) for core in sys.argv[2].split(",")})
    os.execv(sys.executable, [sys.executable, "-P", *sys.argv[3:]])
