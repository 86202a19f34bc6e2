"""Waiting in a test for what another thread or process does."""

import subprocess
import time
from collections.abc import Callable
from typing import TypeVar

import pytest

T = TypeVar("T")


def wait_until(
    condition: Callable[[], T], what: str, timeout_s: float = 60, *, process: "subprocess.Popen[str] | None" = None
) -> T:
    """What the condition gives once it holds. Fails after the time, or if the process that is to bring it has ended."""
    deadline = time.monotonic() + timeout_s
    while not (found := condition()):
        assert process is None or process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline, f"waited {timeout_s:g} s for {what}"
        time.sleep(0.02)
    return found


def make_pause(monkeypatch: pytest.MonkeyPatch) -> Callable[[float], None]:
    """A function that sets the clock forward by a number of seconds. A process that was stopped sees the same."""
    paused_s, now = 0.0, time.monotonic

    def pause(seconds: float) -> None:
        nonlocal paused_s
        paused_s += seconds

    monkeypatch.setattr(time, "monotonic", lambda: now() + paused_s)
    monkeypatch.setattr(time, "monotonic_ns", lambda: int(1e9 * time.monotonic()))
    return pause
