"""What can be seen of a process that may end at any moment."""

import psutil


def arguments(process: psutil.Process) -> list[str]:
    """Its command line; nothing if it has just ended."""
    try:
        return process.cmdline()
    except psutil.Error:
        return []
