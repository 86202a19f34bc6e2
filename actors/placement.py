"""Which cores of the machine actors with their engines, and the learner's process, are kept to.

An actor and its engines work in turns: one waits while the other works. On one core a turn costs no wake-up of another
core. The measurements are in docs/PERFORMANCE.md.
"""

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Literal

import psutil

from gvz.core import janitor, records
from gvz.core.control_groups import num_cores

PlacementKind = Literal["auto", "pinned", "free"]
_SAMPLE_S, _IDLE_PERCENT = 0.25, 30.0
"""seconds that the cores are looked at, and at most how busy one is that counts as idle"""
_locks: list[IO[str]] = []
"""of the cores that `auto` has given to this process's actors and learner"""


def actor_cores(kind: PlacementKind, num_actors: int) -> list[int | None]:
    """The core of each actor; None: it may use any.

    With `auto` actors have cores of their own if as many are idle now, and one more for the learner: other programs
    would have to share a core with an actor, while others stand idle. Runs of a user that start at once get different
    ones: a run holds its cores until `give_back`, the next call or its end. With `pinned` actors have a core in any
    case, and share it if there are more actors than cores.
    """
    cores = sorted(os.sched_getaffinity(0))
    if kind == "auto":
        cores = _hold(idle_cores(), num_actors + 1) if num_actors < num_cores() else []
    if kind == "free" or (kind == "auto" and num_actors >= len(cores)):
        return [None] * num_actors
    return [cores[-1 - actor % len(cores)] for actor in range(num_actors)]


def _hold(cores: list[int], count: int) -> list[int]:
    """The last `count` of these cores that no other run holds, now held by this one; none if there are fewer."""
    give_back()
    held = held_cores(reversed(cores), count, "actors")
    _locks.extend(held.values())
    return sorted(held)


def held_cores(cores: Iterable[int], count: int, holder: str) -> dict[int, IO[str]]:
    """The first `count` of these cores that no other holder of this name has, each with its lock; none if there are
    fewer. Holders are processes of this user on this machine. A lock lasts as long as it is open.
    """
    held: dict[int, IO[str]] = {}
    for core in cores:
        lock = (janitor.runtime_dir() / f"{holder}-{core}.lock").open("w")
        if len(held) < count and records.lock(lock):
            held[core] = lock
        else:
            lock.close()
    if len(held) == count:
        return held
    for lock in held.values():
        lock.close()
    return {}


def give_back() -> None:
    """Other runs may have the cores that `auto` has given to this one."""
    while _locks:
        _locks.pop().close()


def idle_cores() -> list[int]:
    """The cores that this process may use and that do little at this moment."""
    busy = dict(enumerate(psutil.cpu_percent(_SAMPLE_S, percpu=True)))
    return [core for core in sorted(os.sched_getaffinity(0)) if busy.get(core, 0.0) < _IDLE_PERCENT]


def cores_left(taken: Iterable[int | None]) -> set[int]:
    """The cores that this process may use and no actor has; all it may use if the actors have them all, or none."""
    cores = os.sched_getaffinity(0)
    return cores - set(taken) or cores


def keep_to(cores: Iterable[int]) -> None:
    """From now on all threads of this process, and those that they start, run on these cores alone."""
    chosen = set(cores)
    for thread in Path("/proc/self/task").iterdir():
        with contextlib.suppress(ProcessLookupError):  # it has just ended
            os.sched_setaffinity(int(thread.name), chosen)


def in_words(cores: Iterable[int | None]) -> str:
    """For a line of the log."""
    pinned = sorted({core for core in cores if core is not None})
    if not pinned:
        return "actors and engines on any core"
    return f"each actor with its engines on one core ({', '.join(map(str, pinned))})"
