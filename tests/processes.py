"""Processes that may end at any moment."""

import subprocess
import sys

import psutil


def arguments(process: psutil.Process) -> list[str]:
    """Its command line; nothing if it has just ended."""
    try:
        return process.cmdline()
    except psutil.Error:
        return []


def run_until_killed(code: str) -> str:
    """Runs code in a process of its own, kills it with SIGKILL at its first line of output, returns that line."""
    with subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        line = process.stdout.readline().strip()
        process.kill()
    return line
