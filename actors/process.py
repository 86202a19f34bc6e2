"""One actor process as its parent sees it: start, signs of life, end.

Started with `subprocess` (an exec: nothing of a JAX process is inherited by fork) in a session of its own, so that a
Ctrl-C reaches the learner alone. It dies with the *thread* that started it.
"""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

from gvz.core import janitor
from gvz.core.cache import xla_cache_directory
from gvz.transport.broadcast import BroadcastWriter
from gvz.transport.channel import Channel
from gvz.transport.messages import ActorSpec
from gvz.transport.ring import RingReader


def one_core() -> dict[str, str]:
    """Environment variables that keep a process to one core. Must be set before it imports anything.

    The user's own XLA_FLAGS stay: with --xla_cpu_max_isa actors and learner compute by the same instruction set.
    """
    return {
        "JAX_PLATFORMS": "cpu",
        "XLA_FLAGS": f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_multi_thread_eigen=false".strip(),
        "NPROC": "1",  # size of XLA's own thread pools
        "OMP_NUM_THREADS": "1",
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
    }


def _environment() -> dict[str, str]:
    """Our own, with this process's import path and a cache of compiled acting functions (6 s less at a start)."""
    path = os.pathsep.join(str(Path(entry).absolute()) for entry in sys.path)
    return {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(xla_cache_directory()), **one_core(), "PYTHONPATH": path}


class ActorProcess:
    """A running worker. Its output is appended to a log file.

    Attributes:
        channel: what it says and hears; the first message to it is its `spec`.
    """

    def __init__(self, spec: ActorSpec, ring: RingReader, params: BroadcastWriter | None):
        """Starts the process, which inherits the descriptors of its socket, its ring and the parameter queue."""
        work_dir = Path(spec.work_dir)
        work_dir.mkdir(mode=0o700, parents=True, exist_ok=True)
        self._who = f"actor {spec.actor}"
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        with theirs, log_path(spec).open("ab") as log:
            inherited = [theirs.fileno(), ring.descriptor] + ([] if params is None else [params.descriptor])
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "actors.worker", str(os.getpid()), *map(str, inherited)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                cwd=work_dir,
                env=_environment(),
                pass_fds=inherited,
                start_new_session=True,
            )
        self.pid = self._process.pid
        self.channel = Channel(ours, peer=f"{self._who} (pid {self.pid})")
        try:
            self.channel.send(spec)
        except BaseException:
            self.end(grace_s=0.0)
            raise

    def exit_text(self) -> str | None:
        """How the process ended, in words; None while it runs."""
        code = self._process.poll()
        if code is None:
            return None
        return f"was ended by {signal.Signals(-code).name}" if code < 0 else f"exited with code {code}"

    def dump_stacks(self) -> None:
        """Has it write the stacks of its threads into the log (faulthandler; works while Python code hangs)."""
        self._process.send_signal(signal.SIGUSR1)

    def wait(self, timeout_s: float) -> bool:
        """Waits for the end; False if it still runs."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            return False
        return True

    def end(self, *, grace_s: float) -> None:
        """Ends it: SIGTERM, and after `grace_s` SIGKILL. Its engines die with it. Can be repeated.

        Raises:
            WaitTimeoutError: it is still there.
        """
        self.channel.close()
        self._process.terminate()
        if not self.wait(grace_s):
            self._process.kill()
            janitor.reap_killed(self._process, self._who)


def log_path(spec: ActorSpec) -> Path:
    """Where the output of this actor's processes is kept."""
    return Path(spec.work_dir) / f"actor_{spec.actor}.log"
