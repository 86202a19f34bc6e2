"""Processes of actor hosts on this process's cluster."""

import contextlib
from pathlib import Path

import psutil

from tests.processes import arguments


def processes() -> list[psutil.Process]:
    """Of hosts and actors, on all nodes of clusters that this process started."""
    return [p for p in _ours() if "RemoteHost" in "".join(arguments(p)) or "actors.worker" in arguments(p)]


def host_processes() -> list[psutil.Process]:
    """Of hosts, oldest first."""
    return sorted((p for p in _ours() if "RemoteHost" in "".join(arguments(p))), key=lambda p: p.create_time())


def _ours() -> list[psutil.Process]:
    mine = {p.pid for p in psutil.Process().children(recursive=True)}
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            if process.pid in mine and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
    return found


def host_of(process: psutil.Process) -> int:
    """The host's index: its actors' logs are named by their numbers."""
    for child in process.children(recursive=True):
        if "actors.worker" in arguments(child):
            with contextlib.suppress(psutil.Error, OSError):
                log = Path(f"/proc/{child.pid}/fd/1").readlink().stem
                return int(log.removeprefix("actor_")) // 2
    return -1
