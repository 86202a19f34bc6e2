"""A job's command on a node of a cluster: its cores, environment and process. No Ray here: Ray carries the calls."""

import os
import random
import socket
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from actors.placement import held_cores, idle_cores
from gvz.experiments.process import LocalProcess

RAYS_OWN = ("RAY_", "OMP_NUM_THREADS", "PYTHONBREAKPOINT")
"""beginnings of the environment variables that Ray sets in its workers: a job knows nothing of Ray, and its numerical
libraries use the cores that it is on"""


class JobHost:
    """One command of a job on this node. All calls come from one thread: the kernel ends the command with it."""

    def __init__(self) -> None:
        self._process: LocalProcess | None = None
        self._locks: list[IO[str]] = []

    def start(self, log: str, arguments: Sequence[str], num_cores: int, environment: dict[str, str]) -> str | None:
        """Starts a command on cores that no other job of this user has here.

        Args:
            log: the job's log, an absolute path that all nodes know.
            arguments: of Python.
            num_cores: that it is to have.
            environment: added to this process's.

        Returns: this node's name; None if another process runs the job.
        """
        cores, self._locks = hold_cores(num_cores)
        mine = {name: value for name, value in os.environ.items() if not name.startswith(RAYS_OWN)}
        kept = [lock.fileno() for lock in self._locks]
        guard = ("-m", "gvz.cluster.guard", ",".join(map(str, cores)))
        self._process = LocalProcess.start(Path(log), arguments, cores, {**mine, **environment}, kept, guard)
        return None if self._process is None else socket.gethostname()

    def poll(self) -> int | None:
        """Exit code of the command, as a shell says it; None while it runs."""
        assert self._process is not None, "it has started"
        return self._process.poll()

    def stop(self) -> None:
        """Asks the command to save what it has and to end."""
        assert self._process is not None, "it has started"
        self._process.stop()

    def kill(self) -> None:
        """Ends the command and all it started at once."""
        assert self._process is not None, "it has started"
        self._process.kill()


def hold_cores(count: int) -> tuple[tuple[int, ...], list[IO[str]]]:
    """Cores of this machine that no other job of this user holds, and their locks, which last as long as they are open.

    Idle cores go first, chosen at random: containers see the same cores, but not each other's locks. All cores,
    without locks, where too few are free: Ray was told of more cores than there are, or somebody holds them.
    """
    allowed, idle = sorted(os.sched_getaffinity(0)), idle_cores()
    first = random.randrange(len(allowed))
    held = held_cores(sorted(allowed[first:] + allowed[:first], key=lambda core: core not in idle), count, "core")
    return (tuple(held), list(held.values())) if held else (tuple(allowed), [])
