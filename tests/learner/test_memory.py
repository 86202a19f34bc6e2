"""Freed memory stays with the process until it is released: counted in page faults and resident bytes."""

import json
import subprocess
import sys

PROGRAM = """
import ctypes, json, resource, sys
import psutil
from learner import memory

BYTES = 100 * 2**20
if sys.argv[1] == "keep":
    memory.keep_freed_memory()

def step() -> None:
    ctypes.create_string_buffer(BYTES)  # cleared, so touched

def faults() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt

step()
before = faults()
for _ in range(5):
    step()
count = (faults() - before) / 5
kept = psutil.Process().memory_info().rss
memory.release_freed_memory()
print(json.dumps([count, kept - psutil.Process().memory_info().rss]))
"""


def measure(what: str) -> tuple[float, int]:
    """Page faults of a step that takes 100 MB, and bytes given back after it."""
    done = subprocess.run([sys.executable, "-c", PROGRAM, what], capture_output=True, text=True, check=True)
    count, released = json.loads(done.stdout)
    return count, released


def test_kept_memory_is_not_faulted_in_again_and_can_be_released():
    pages = 100 * 2**20 / 4096
    count, released = measure("keep")
    assert count < pages / 100
    assert released > 90 * 2**20


def test_without_it_every_step_pays():
    pages = 100 * 2**20 / 4096
    count, released = measure("do not")
    assert count > pages / 2
    assert released < 10 * 2**20
