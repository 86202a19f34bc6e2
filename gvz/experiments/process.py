"""The process of a job's command, its log, and how it ends."""

import contextlib
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Protocol

from gvz.core import janitor, records
from gvz.core.libraries import import_path
from gvz.experiments import inventory

TAKEN = -1
"""instead of an exit code: another process runs the job"""
LOST = -2
"""likewise: the machine that it ran on is gone, or does not answer"""


class Process(Protocol):
    """A command at work, here or on another machine."""

    problem: str
    """why it could not begin; empty if it could"""

    @property
    def where(self) -> str:
        """The machine, if it is not this one."""
        ...

    def poll(self) -> int | None:
        """Exit code, as a shell says it; TAKEN, LOST; None while it runs."""
        ...

    def stop(self) -> None:
        """Asks the command to save what it has and to end."""
        ...

    def kill(self) -> None:
        """Ends the command and all it started at once."""
        ...


class LocalProcess:
    """A command at work on this machine.

    The log is locked as long as the command runs. Its process holds the lock, too: if it saves its run after our death,
    no other process starts the job before that is done.
    """

    where = ""
    problem = ""  # where it cannot begin, `start` raises

    def __init__(self, log: IO[bytes], process: "subprocess.Popen[bytes]"):
        """`start` calls this."""
        self._log, self._process = log, process
        self._started_s = time.monotonic()
        self._code: int | None = None

    @classmethod
    def start(
        cls,
        file: Path,
        arguments: Sequence[str],
        cores: Sequence[int],
        environment: Mapping[str, str],
        kept: Sequence[int] = (),
        guard: Sequence[str] = (),
    ) -> "LocalProcess | None":
        """Starts a command of Python.

        Args:
            file: the job's log.
            arguments: of Python.
            cores: that it stays on.
            environment: its environment variables.
            kept: open files that stay open as long as it runs.
            guard: arguments of a Python that starts it, before its own.

        Returns: None if another process runs the job.
        """
        file.parent.mkdir(parents=True, exist_ok=True)
        log = file.open("ab", buffering=0)
        if not records.lock(log):
            log.close()
            return None
        _note(log, f"# {time.strftime('%Y-%m-%d %H:%M:%S')} python {shlex.join(arguments)}")
        child = ("-m", "gvz.experiments.child", str(os.getpid()), ",".join(map(str, cores)))
        process = subprocess.Popen(
            [sys.executable, "-P", *child, *guard, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env={**environment, "PYTHONUNBUFFERED": "1", "PYTHONPATH": import_path()},
            pass_fds=kept,
            start_new_session=True,  # the terminal's Ctrl-C is for us, who then stop it in order
        )
        return cls(log, process)

    def poll(self) -> int | None:
        code = self._process.poll()
        if code is not None and self._code is None:
            self._code = 128 - code if code < 0 else code
            _note(self._log, f"{inventory.END_MARK}{self._code} after {time.monotonic() - self._started_s:.0f} s")
            self._log.close()
        return self._code

    def stop(self) -> None:
        if self.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        if self.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
            janitor.reap_killed(self._process, self._log.name)
            self.poll()


def _note(log: IO[bytes], line: str) -> None:
    with contextlib.suppress(OSError):  # a full disk: the command is worth more than this line
        log.write(f"{line}\n".encode())
