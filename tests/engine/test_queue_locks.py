"""An engine that dies with the lock of a message queue never leaves its client waiting."""

import ctypes
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import vizdoom

from gvz.core import janitor
from gvz.core.errors import EngineError
from gvz.engine import queue_locks
from gvz.engine.engine import Engine, EngineConfig

pytestmark = pytest.mark.engine

STOCK_WAD = Path(vizdoom.scenarios_path) / "defend_the_center.wad"
TAKE_A_LOCK_AND_DIE = """
import ctypes, mmap, os, sys
with open(sys.argv[1], "r+b") as file:
    queue = mmap.mmap(file.fileno(), 0)
ctypes.CDLL(None).pthread_mutex_lock(ctypes.byref(ctypes.c_char.from_buffer(queue, int(sys.argv[2]))))
os.kill(os.getpid(), 9)
"""


def start() -> Engine:
    engine = Engine(EngineConfig(wad=STOCK_WAD, buttons=("ATTACK",), variables=()))
    engine.new_episode(1)
    return engine


def within(timeout_s: float, call: Callable[[], object]) -> None:
    """Fails if the call has not returned or raised by then, where waiting for it would never end."""
    errors: list[BaseException] = []

    def run() -> None:
        try:
            call()
        except BaseException as error:
            errors.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(timeout_s)
    assert not thread.is_alive(), f"{call.__name__} still waits after {timeout_s} s"
    assert not errors, errors


def lose_lock(engine: Engine, queue: str) -> None:
    """Kills the engine, and has the lock of the queue be held by a process that is dead."""
    os.kill(engine.pid, signal.SIGSTOP)  # else it would wait for the lock, and not for the client
    file = janitor.SHM_DIR / (queue + engine.instance_id)
    code = [sys.executable, "-c", TAKE_A_LOCK_AND_DIE, str(file), str(queue_locks._OFFSET)]
    assert subprocess.run(code, check=False, timeout=60).returncode == -signal.SIGKILL
    engine.kill()


@pytest.mark.parametrize("queue", janitor.QUEUE_PREFIXES)
def test_a_call_that_waits_for_a_lost_lock_raises(queue: str):
    engine = start()
    lose_lock(engine, queue)

    def step() -> None:
        with pytest.raises(EngineError, match=r"crash|died before"):
            engine.step([1], 4)

    within(20, step)
    within(20, engine.close)


@pytest.mark.parametrize("queue", janitor.QUEUE_PREFIXES)
def test_an_engine_with_a_lost_lock_is_closed(queue: str):
    engine = start()
    lose_lock(engine, queue)
    within(20, engine.close)


def test_a_lock_that_this_process_holds_is_left_alone():
    engine = start()
    (queue, _) = queue_locks.mapped(engine.instance_id)
    os.kill(engine.pid, signal.SIGSTOP)
    lock = ctypes.c_char.from_buffer(queue, queue_locks._OFFSET)
    libc = ctypes.CDLL(None)
    assert libc.pthread_mutex_trylock(ctypes.byref(lock)) == 0
    queue_locks.free([queue])
    assert libc.pthread_mutex_trylock(ctypes.byref(lock)) != 0, "it is still held"
    libc.pthread_mutex_unlock(ctypes.byref(lock))
    os.kill(engine.pid, signal.SIGCONT)
    engine.step([1], 4)
    engine.close()


def play(engine: Engine) -> None:
    while True:
        if engine.step([1], 4) is None:
            engine.new_episode(1)


def test_a_kill_at_any_moment_of_a_call_ends_it():
    """Without the freeing of locks, one of the twenty calls never returned, in two of three runs of this test."""
    moments = random.Random(1)
    for _ in range(20):
        engine = start()
        killer = threading.Timer(moments.uniform(0.02, 0.05), engine.kill)
        killer.start()

        def is_killed(engine: Engine = engine) -> None:
            with pytest.raises(EngineError):
                play(engine)

        start_s = time.monotonic()
        within(20, is_killed)
        assert time.monotonic() - start_s < 10, "the watchdog's own time-out"
        killer.join()
        engine.close()
