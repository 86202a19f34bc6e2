"""Freed memory stays with the process until it is released: counted in page faults and resident bytes."""

import json
import subprocess
import sys

import pytest

PROGRAM = """
import ctypes, json, resource, sys, threading
import psutil
from learner import memory

BYTES = 100 * 2**20
if sys.argv[1] == "keep":
    memory.keep_freed_memory()

def step() -> None:
    ctypes.create_string_buffer(BYTES)  # cleared, so touched

def five_steps() -> None:
    for _ in range(5):
        step()

def faults() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

step()
before = faults()
if sys.argv[2] == "another thread":
    thread = threading.Thread(target=five_steps)
    thread.start()
    thread.join()
else:
    five_steps()
count = (faults() - before) / 5
kept = psutil.Process().memory_info().rss
memory.release_freed_memory()
print(json.dumps([count, kept - psutil.Process().memory_info().rss]))
"""


def measure(what: str, where: str) -> tuple[float, int]:
    """Page faults of a step that takes 100 MB, and bytes given back after it."""
    done = subprocess.run([sys.executable, "-c", PROGRAM, what, where], capture_output=True, text=True, check=True)
    count, released = json.loads(done.stdout)
    return count, released


@pytest.mark.parametrize("where", ["main thread", "another thread"])
def test_kept_memory_is_not_faulted_in_again_and_can_be_released(where):
    pages = 100 * 2**20 / 4096
    count, released = measure("keep", where)
    assert count < pages / 100
    assert released > 90 * 2**20


def test_without_it_every_step_pays():
    pages = 100 * 2**20 / 4096
    count, released = measure("do not", "main thread")
    assert count > pages / 2
    assert released < 10 * 2**20
