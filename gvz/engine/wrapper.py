"""Stands between ViZDoom's client library and the engine: a script that becomes the engine.

Usage: wrapper.py OWNER_PID DIRECTORY LOG ENGINE [engine arguments]

The client library launches "the engine", which is a one-line shell script in the engine's private directory, which
runs this file. It makes the engine die with its owner, keeps its files and its output in the private directory, notes
process and instance id for the janitor, then becomes the engine (exec: same process).
"""

import ctypes
import os
import signal
import sys
from pathlib import Path

_PR_SET_PDEATHSIG = 1


def main(owner_pid: int, directory: str, log: str, engine: str, arguments: list[str]) -> None:
    # The signal comes when the *thread* that launched us ends: it is the client library's own, which waits for
    # the engine's end, so it lives exactly as long as client and engine both do.
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL) != 0:
        sys.exit(f"engine wrapper: prctl failed: {os.strerror(ctypes.get_errno())}")
    instance_id = arguments[arguments.index("+viz_instance_id") + 1]
    if os.getppid() != owner_pid:  # it died before the line above, perhaps before anybody knew what it had made
        for queue in ("MQCtr", "MQDoom"):
            Path(f"/dev/shm/ViZDoom{queue}{instance_id}").unlink(missing_ok=True)
        sys.exit(1)
    os.setpgid(0, 0)  # the terminal's Ctrl-C is for the owner. No session: see gvz/transport/child.py
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):  # the owner blocks them: what came until now ...
        before = signal.signal(number, signal.SIG_IGN)  # ... is dropped
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {number})
        signal.signal(number, before)
    os.chdir(directory)  # the engine writes _vizdoom/ here ...
    os.environ["HOME"] = directory  # ... and would look for its settings in the user's home
    os.environ["ALSOFT_DRIVERS"] = "null"  # we play no sound, but OpenAL would leave /tmp/pulse-... of every engine
    start = Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19]
    Path("instance.partial").write_text(f"{os.getpid()} {start} {instance_id}\n")
    Path("instance.partial").rename("instance")
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(output, 1)
    os.dup2(output, 2)
    os.execv(engine, [engine, *arguments])  # argv[0] in full: the engine looks for vizdoom.pk3 beside it


if __name__ == "__main__":
    main(int(sys.argv[1]), sys.argv[2], sys.argv[3], sys.argv[4], sys.argv[5:])
