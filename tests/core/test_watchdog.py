"""A process that is stuck in one call is ended with its stacks; a slow, a beating and a stopped one are left alone."""

import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import IO

import pytest

from gvz.core.watchdog import AwakeClock

STUCK = """
import ctypes, threading, time
from gvz.core.watchdog import Watchdog

def wait_for_the_device():
    lock = threading.Lock()
    lock.acquire()
    lock.acquire()

def hold_the_interpreter():
    ctypes.PyDLL(None).sleep(600)

with Watchdog("the learner", 1.0) as watchdog:
    print("begun", flush=True)
    {body}
"""


def begin(body: str, stderr: IO[str] | int = subprocess.PIPE) -> subprocess.Popen[str]:
    code = STUCK.format(body=body)
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=stderr, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "begun\n"
    return process


@pytest.mark.parametrize("where", ["wait_for_the_device", "hold_the_interpreter"])
def test_a_stuck_process_is_ended_and_shows_where_it_hangs(where):
    """Also in C code that lets no other Python thread run."""
    with begin(f"{where}()") as process:
        _, err = process.communicate(timeout=60)
    assert process.returncode == -signal.SIGVTALRM
    assert err.startswith("error: the learner gave no sign of life for 1 s and is ended; the stacks of its threads")
    assert f"in {where}" in err


def test_a_stuck_process_whose_standard_error_cannot_be_written_is_ended_too():
    with Path("/dev/full").open("w") as full, begin("wait_for_the_device()", full) as process:
        assert process.wait(60) == -signal.SIGVTALRM


def test_the_watchdog_of_a_killed_process_ends_with_it():
    with begin("wait_for_the_device()") as process:
        process.kill()
        _, err = process.communicate(timeout=60)  # until nobody can write to it any more
    assert err == ""


def test_one_that_beats_is_left_alone():
    with begin("[(watchdog.beat(), time.sleep(0.1)) for _ in range(25)]") as process:
        _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")


def test_the_time_in_which_it_was_stopped_does_not_count():
    with begin("[(watchdog.beat(), time.sleep(0.1)) for _ in range(10)]") as process:
        process.send_signal(signal.SIGSTOP)
        time.sleep(2.0)
        process.send_signal(signal.SIGCONT)
        _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")


def test_one_that_has_left_is_not_watched():
    code = "import time; from gvz.core.watchdog import Watchdog\nwith Watchdog('x', 0.5): pass\ntime.sleep(2.0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_time_in_which_nobody_looked_counts_for_so_much_and_no_more(monkeypatch: pytest.MonkeyPatch):
    time_s = 100.0
    monkeypatch.setattr(time, "monotonic", lambda: time_s)
    clock = AwakeClock(longest_s=1.0)
    assert clock.look() == 0.0
    time_s = 100.5
    assert clock.look() == 0.5
    time_s = 4000.0  # stopped for an hour
    assert clock.look() == 1.5
    assert clock.now_s == 1.5
