"""A pool in a test: drained, polled, every record checked; and what is left of it afterwards."""

import contextlib
import time
from collections.abc import Callable, Generator
from pathlib import Path
from typing import Any

import numpy as np
from fake_env import Checker

from actors.pool import PoolConfig
from actors.process_pool import ProcessPool
from gvz.core import janitor
from gvz.transport.messages import EpisodeStats, Fault, Message, StepBlock
from gvz.transport.ring import WriterState
from tests.waiting import wait_until

DEADLINE_S = 240.0


class Run:
    """A pool that is drained and polled until something has happened, every record checked."""

    def __init__(self, pool: ProcessPool, pool_config: PoolConfig):
        self.pool = pool
        self.checker = Checker(pool_config)
        self.messages: list[Message] = []

    def until(self, done: Callable[[], bool]) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not done():
            assert time.monotonic() < deadline, self.messages
            self.checker.add(self.pool.drain(100, wait_s=0.01))
            self.messages += self.pool.poll()

    def play(self, num_records: int) -> None:
        wanted = self.checker.num_records + num_records
        self.until(lambda: self.checker.num_records >= wanted)

    def faults(self) -> list[Fault]:
        return [m for m in self.messages if isinstance(m, Fault)]

    def first_episodes(self) -> dict[int, int]:
        """Number of the first episode that each lane has reported."""
        return {m.lane: m.episode for m in reversed(self.messages) if isinstance(m, EpisodeStats)}

    def until_all_ready(self) -> list[int]:
        """Process ids, by actor."""
        self.until(lambda: self.pool.statistics().actors_ready == 2)
        return [status.pid for status in self.pool.writer_statuses()]

    def until_all_full(self) -> None:
        """Until every actor waits for space in its ring; nothing is drained."""
        full = WriterState.WAITING_FOR_SPACE
        wait_until(lambda: {s.state for s in self.pool.writer_statuses()} == {full}, "full rings", DEADLINE_S)


@contextlib.contextmanager
def playing(pool_config: PoolConfig, state: dict[str, Any] | None = None) -> Generator[Run]:
    """A `ProcessPool` in a test; it is closed at the end."""
    with ProcessPool(pool_config, state) as pool:
        yield Run(pool, pool_config)


def gather(blocks: list[StepBlock]) -> tuple[np.ndarray, np.ndarray]:
    """(steps without their sequence numbers, frames) of several blocks."""
    steps = np.concatenate([block.steps for block in blocks])
    steps["sequence"] = 0
    return steps, np.concatenate([block.frames for block in blocks])


def segments() -> dict[int, int]:
    """Size of every segment of shared memory that this process holds a descriptor of, by inode."""
    found = {}
    for link in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # the descriptor by which this directory is read
            if link.readlink().name.startswith("memfd:gvz-"):
                found[link.stat().st_ino] = link.stat().st_size
    return found


def alive(pid: int) -> bool:
    return janitor.process_start(pid) is not None
