"""Processes that play or prepare things beside this one, a core each."""

import contextlib
import multiprocessing
import os
import signal
from collections.abc import Generator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool

from gvz.core import janitor
from gvz.core.errors import GvzError
from gvz.transport.child import one_core


@contextlib.contextmanager
def worker_processes(num_workers: int, died: str) -> Generator[ProcessPoolExecutor, None, None]:
    """An executor with this number of processes. They end with the block.

    If an exception leaves the block, the processes are killed. They also end if this process is killed.

    Raises:
        GvzError: one of them died; `died` is its text.
    """
    others = set(multiprocessing.active_children())
    executor = ProcessPoolExecutor(
        max_workers=num_workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin,
        initargs=(os.getpid(),),
    )
    ended = False
    try:
        yield executor
        ended = True
    except BrokenProcessPool as error:
        raise GvzError(died) from error
    finally:
        if not ended:  # what they do is not wanted any more, and one of them may hang
            for worker in set(multiprocessing.active_children()) - others:
                worker.kill()
        executor.shutdown(wait=True, cancel_futures=True)
        if not ended:
            janitor.clean_dead_instances()


def _begin(parent_pid: int) -> None:
    janitor.die_with_parent(parent_pid)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    os.environ |= one_core()
