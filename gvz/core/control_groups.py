"""Control groups of Linux, versions 1 and 2 (cgroups(7)): by them a container or batch job has its limits."""

import contextlib
import math
import os
import random
from collections.abc import Generator
from functools import cache
from pathlib import Path

MOUNTED, LISTED = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
"""where the control groups are mounted, and the file that lists those of this process"""


def own_groups(controller: str) -> Generator[Path]:
    """Directories of the control groups that this process is in, some of which may not exist.

    Args:
        controller: what is limited, such as `cpu` or `memory`.
    """
    for line in LISTED.read_text().splitlines() if LISTED.exists() else ():
        _, controllers, path = line.split(":", 2)
        if not controllers or controller in controllers.split(","):
            top = MOUNTED / controllers  # in a container, it is that of the container
            own = Path(path.strip("/"))
            yield from (top / own, *(top / parent for parent in own.parents))


def num_cores() -> int:
    """Cores that this process can keep busy: those it may use, or fewer where a container or batch job has a quota of
    processor time (`docker run --cpus`, Kubernetes' limits). A part of a core counts as one.
    """
    return min([len(os.sched_getaffinity(0)), *_quotas()])


def keep_xla_to_quota() -> None:
    """Before jax is imported: under a quota, XLA would have a thread for each core of the machine."""
    if (cores := num_cores()) < len(os.sched_getaffinity(0)):
        os.environ.setdefault("NPROC", str(cores))


@cache
def _quotas() -> tuple[int, ...]:
    """Cores that each quota is worth. Read once in a process: configurations ask again and again."""
    found: list[int] = []
    for group in own_groups("cpu"):
        with contextlib.suppress(OSError, ValueError):  # it has no quota, or another container has it
            found.append(_quota_in(group))
    return tuple(found)


def _quota_in(group: Path) -> int:
    """Cores that the processor time of a control group is worth."""
    if (file := group / "cpu.max").exists():
        quota, period = file.read_text().split()
    else:
        quota, period = (group / "cpu.cfs_quota_us").read_text(), (group / "cpu.cfs_period_us").read_text()
    if int(quota) < 0:
        raise ValueError(f"{group}: no quota")
    return math.ceil(int(quota) / int(period))


def some_cores() -> list[int]:
    """`num_cores` of the cores that this process may use. Where these are not all, they are neighbours from a random
    place: other containers see the same cores.
    """
    cores, count = sorted(os.sched_getaffinity(0)), num_cores()
    first = random.randrange(len(cores)) if count < len(cores) else 0
    return sorted((cores[first:] + cores[:first])[:count])
