"""Control groups of Linux, versions 1 and 2 (cgroups(7)): by them a container or batch job has its limits."""

import contextlib
import math
import os
import random
from collections.abc import Generator
from pathlib import Path

MOUNTED = Path("/sys/fs/cgroup")


def own_groups(controller: str, mounted: Path = MOUNTED, listed: str | None = None) -> Generator[Path]:
    """Directories of the control groups that this process is in, some of which may not exist.

    Args:
        controller: what is limited, such as `cpu` or `memory`.
        mounted: where the control groups are mounted.
        listed: the text of /proc/self/cgroup; by default it is read.
    """
    if listed is None:
        file = Path("/proc/self/cgroup")
        listed = file.read_text() if file.exists() else ""
    for line in listed.splitlines():
        _, controllers, path = line.split(":", 2)
        if not controllers or controller in controllers.split(","):
            top = mounted / controllers  # in a container, it is that of the container
            own = Path(path.strip("/"))
            yield from (top / own, *(top / parent for parent in own.parents))


def num_cores(mounted: Path = MOUNTED, listed: str | None = None) -> int:
    """Cores that this process can keep busy: those it may use, or fewer where a container or batch job has a quota of
    processor time (`docker run --cpus`, Kubernetes' limits). A part of a core counts as one.

    Args:
        mounted, listed: as for `own_groups`.
    """
    found = [len(os.sched_getaffinity(0))]
    for group in own_groups("cpu", mounted, listed):
        with contextlib.suppress(OSError, ValueError):  # it has no quota, or another container has it
            found.append(_quota_in(group))
    return min(found)


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
