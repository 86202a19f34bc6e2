"""Where jobs run: shares of this machine's cores and GPUs. `gvz/cluster/ray_jobs.py` has those of a cluster."""

import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from gvz.core.errors import ConfigError
from gvz.experiments.jobs import Command
from gvz.experiments.process import LocalProcess, Process

LIST_TIMEOUT_S = 60.0
"""for the driver's list of GPUs, which takes a second"""


class Places(Protocol):
    """Something that commands of jobs run on."""

    settle_s: float
    """how old a directory's contents may be here after a command has written to it there, seconds"""

    def room(self, step: str | None = None) -> bool:
        """Whether a command of this step (of any, if None) can start now.

        Raises:
            GvzError: none ever will.
        """
        ...

    def start(self, log: Path, command: Command) -> Process | None:
        """Starts a command; None if another process runs the job of this log."""
        ...

    def end(self, process: Process) -> None:
        """Takes back the share of a process that has ended."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class Slot:
    """A share of the machine, for one job at a time."""

    cores: tuple[int, ...]
    environment: dict[str, str]
    """added to ours: which GPU, how much of its memory"""


class Machine:
    """This machine, divided into slots."""

    settle_s = 0.0

    def __init__(self, slots: Sequence[Slot]):
        self._free = list(slots)
        self._used: dict[Process, Slot] = {}

    def room(self, step: str | None = None) -> bool:
        return bool(self._free)

    def start(self, log: Path, command: Command) -> Process | None:
        slot = self._free[0]
        process = LocalProcess.start(log, command.arguments, slot.cores, {**os.environ, **slot.environment})
        if process is not None:
            self._used[process] = self._free.pop(0)
        return process

    def end(self, process: Process) -> None:
        self._free.append(self._used.pop(process))


def gpus() -> tuple[str, ...]:
    """Ids for CUDA_VISIBLE_DEVICES of the GPUs that are there and not hidden.

    Raises:
        ConfigError: the driver does not say which there are.
    """
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return tuple(id for id in visible.split(",") if id and id != "-1")
    if shutil.which("nvidia-smi") is None:
        return ()
    command = ["nvidia-smi", "-L"]
    try:
        listed = subprocess.run(command, capture_output=True, text=True, timeout=LIST_TIMEOUT_S, check=False).stdout
    except subprocess.TimeoutExpired as error:
        raise ConfigError(
            f"GPUs: waited {LIST_TIMEOUT_S:g} s for {' '.join(command)}; mend the driver, or set CUDA_VISIBLE_DEVICES "
            "to the GPUs that are to be used, empty for none"
        ) from error
    return tuple(re.findall(r"^GPU (\d+):", listed, flags=re.MULTILINE))  # between them, parts of GPUs have lines, too


def make_slots(jobs: int | None, cores: Sequence[int], devices: Sequence[str]) -> tuple[Slot, ...]:
    """Shares of these cores and GPUs for a number of jobs at once; None: one a GPU, or without one a pair of cores.

    Raises:
        ConfigError: fewer than one job.
    """
    if jobs is None:
        jobs = min(len(devices), len(cores)) if devices else max(1, len(cores) // 2)
    if jobs < 1:
        raise ConfigError(f"--jobs: got {jobs}, want at least 1")
    slots = []
    for n in range(jobs):
        share = tuple(cores[n::jobs]) or (cores[n % len(cores)],)
        environment = {}
        if devices:
            environment["CUDA_VISIBLE_DEVICES"] = devices[n % len(devices)]
            environment |= memory_share(-(-jobs // len(devices)))
        slots.append(Slot(cores=share, environment=environment))
    return tuple(slots)


def memory_share(jobs: float) -> dict[str, str]:
    """The environment variable that tells JAX its part of a GPU's memory, where several jobs use the GPU."""
    return {"XLA_PYTHON_CLIENT_MEM_FRACTION": f"{0.9 / jobs:.3f}"} if jobs > 1 else {}
