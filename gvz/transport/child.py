"""A Python process of ours at the other end of a channel: its start, its end, and what it does first.

Started with `subprocess` (an exec: nothing of a JAX process is inherited by fork) in a process group of its own, so
that a Ctrl-C reaches its parent alone. It is ended with the *thread* that started it.

It has no session of its own, and neither have engines. Linux divides the processor among sessions first (autogroup),
and processes that wait for each other wait longer if they are in different ones. Two workers of `gvz.make_vec` with
four engines each made 820 decisions/s in sessions of their own and 2,240 in one session (medians of 3 alternating
rounds beside other work of a load of 10; 2026-11-22, 2 cores).
"""

import contextlib
import faulthandler
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import FrameType, MappingProxyType
from typing import IO

from gvz.core import janitor
from gvz.core.libraries import import_path
from gvz.transport.channel import Channel
from gvz.transport.messages import Message, Stop


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
        "OPENCV_FOR_THREADS_NUM": "1",
    }


def end_all(processes: "Sequence[ChildProcess]", grace_s: float) -> None:
    """Asks them to stop, and ends those that have not within `grace_s`, also when a second Ctrl-C ends the wait.

    Raises:
        WaitTimeoutError: one is still there, or did not read; the others have ended.
    """
    try:
        for process in processes:
            if not process.channel.closed:
                process.channel.send(Stop())
        deadline = time.monotonic() + grace_s
        for process in processes:
            process.wait(max(0.0, deadline - time.monotonic()))
    finally:
        deadline = time.monotonic() + grace_s
        with contextlib.ExitStack() as all_of_them:
            for process in processes:
                all_of_them.callback(lambda p=process: p.end(grace_s=max(0.0, deadline - time.monotonic())))


class ChildProcess:
    """A running `python -m MODULE PARENT_PID SOCKET DESCRIPTOR...`, kept to one core.

    Attributes:
        channel: what it says and hears.
    """

    def __init__(
        self,
        module: str,
        who: str,
        spec: Message,
        *,
        inherited: Sequence[int],
        log: IO[bytes],
        directory: Path | None = None,
        environment: Mapping[str, str] = MappingProxyType({}),
    ):
        """Starts the process and sends it its first message.

        Args:
            module: dotted name; it calls `begin` first.
            who: its name in errors.
            spec: the first message.
            inherited: file descriptors that are passed on.
            log: file for its output.
            directory: its working directory; by default ours.
            environment: variables beside our own.
        """
        self._who = who
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            with theirs:
                passed = (theirs.fileno(), *inherited)
                self._process = subprocess.Popen(
                    [sys.executable, "-P", "-m", module, str(os.getpid()), *map(str, passed)],
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    cwd=directory,
                    env={**os.environ, **environment, **one_core(), "PYTHONPATH": import_path()},
                    pass_fds=passed,
                    process_group=0,
                )
        except BaseException:
            ours.close()
            raise
        self.pid = self._process.pid
        self.channel = Channel(ours, peer=f"{who} (pid {self.pid})")
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


def begin(parent_pid: int, descriptor: int, *, parent: str, last_signal: int = signal.SIGKILL) -> Channel:
    """What such a process does first; returns its end of the channel.

    Ctrl-C and SIGHUP are left to the parent. SIGTERM raises SystemExit, once. SIGUSR1 writes the stacks of all threads.

    Args:
        parent_pid: as given on the command line.
        descriptor: of the socket, likewise.
        parent: its name in errors.
        last_signal: what the kernel sends when the thread that started this process has ended.
    """

    def leave(number: int, frame: FrameType | None) -> None:
        del frame
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one must not interrupt what the first one ends
        sys.exit(128 + number)

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, leave)
    janitor.die_with_parent(parent_pid, last_signal)
    faulthandler.enable()
    faulthandler.register(signal.SIGUSR1, all_threads=True)
    os.set_inheritable(descriptor, False)  # an engine that held it would hide our end from the parent
    return Channel(socket.socket(fileno=descriptor), peer=parent)
