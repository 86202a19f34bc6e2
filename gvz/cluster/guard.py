"""Stands between a worker of Ray and a job: `python -m gvz.cluster.guard CORES python-arguments...`.

A worker that ends kills its children at once. That is this process alone, and the kernel then asks the job, whose
parent this is, to save itself and to end. Signals are passed on to the job; the exit code is the job's.
"""

import os
import signal
import subprocess
import sys
from types import FrameType

from gvz.core.stop import SIGNALS


def main() -> int:
    """Starts the job and waits for its end."""
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # until there is somebody to pass them on to
    command = [sys.executable, "-P", "-m", "gvz.experiments.child", str(os.getpid()), *sys.argv[1:]]
    job = subprocess.Popen(command, close_fds=False)  # the locks of its cores

    def pass_on(number: int, frame: FrameType | None) -> None:
        del frame
        job.send_signal(number)

    for number in SIGNALS:
        signal.signal(number, pass_on)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)
    code = job.wait()
    return 128 - code if code < 0 else code


if __name__ == "__main__":
    sys.exit(main())
