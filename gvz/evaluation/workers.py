"""Processes that play or prepare things beside this one, a core each."""

import contextlib
import multiprocessing
import os
import queue
import traceback
from collections.abc import Callable, Generator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import Any, ParamSpec, TypeVar

from gvz.core import janitor
from gvz.core.errors import GvzError
from gvz.core.stop import blocked_signals, ignore_signals, uninterrupted
from gvz.transport.child import one_core

P = ParamSpec("P")
T = TypeVar("T")
_SPAWN = multiprocessing.get_context("spawn")


@contextlib.contextmanager
def worker_processes(num_workers: int, died: str) -> Generator[Executor, None, None]:
    """An executor with this number of processes. They end with the block.

    If an exception leaves the block, the processes are killed. They also end if this process is killed, and nothing of
    them is left then: not even if all processes are killed at once.

    Raises:
        GvzError: one of them died, and `died` is its text; or one could not be started.
    """
    executor = _Processes(num_workers)
    ended = False
    try:
        executor.start()
        yield executor
        executor.shutdown(cancel_futures=True)
        ended = True
    except BrokenProcessPool as error:
        raise GvzError(died) from error
    finally:
        if not ended:  # what they do is not wanted any more, and one of them may hang
            with uninterrupted():
                executor.kill()
                executor.shutdown(cancel_futures=True)
                janitor.clean_dead_instances()


class _Processes(Executor):
    """Spawned processes, and for each a thread that hands it calls over a pipe.

    Differs: the standard library's ProcessPoolExecutor has five named semaphores. They stay in /dev/shm if its process
    group is killed, since Python's tracker of such names dies with the group.
    """

    def __init__(self, num_workers: int):
        self._num_workers = num_workers
        self._processes: list[SpawnProcess] = []
        self._pipes: list[Any] = []  # a Connection to each
        self._idle: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._threads = ThreadPoolExecutor(num_workers)

    def start(self) -> None:
        """Starts the processes, in this thread: the kernel ends a process with the thread that started it.

        Raises:
            GvzError: one cannot be started. Those before it run.
        """
        resource_tracker.ensure_running()  # the first process would start it, and Python 3.11 then unblocks signals
        for number in range(self._num_workers):
            try:
                ours, theirs = _SPAWN.Pipe()
                self._pipes.append(ours)
                with theirs, blocked_signals():
                    process = _SPAWN.Process(target=_work, args=(os.getpid(), theirs), daemon=True)
                    process.start()
            except OSError as error:
                raise GvzError(
                    f"worker process {number + 1} of {self._num_workers} cannot be started: {error.strerror}; use "
                    "fewer, or raise the limits of processes and open files (ulimit -u, ulimit -n)"
                ) from error
            self._processes.append(process)
            self._idle.put(number)

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        return self._threads.submit(self._call, partial(fn, *args, **kwargs))

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        self._threads.shutdown(wait=wait, cancel_futures=cancel_futures)
        for pipe in self._pipes:
            pipe.close()  # a process ends when it finds its pipe closed
        for process in self._processes:
            process.join()

    def kill(self) -> None:
        """Ends the processes at once."""
        for process in self._processes:
            process.kill()

    def _call(self, call: Callable[[], Any]) -> Any:
        number = self._idle.get_nowait()  # there are no more threads than processes
        pipe = self._pipes[number]
        try:
            pipe.send(call)
            result, error = pipe.recv()
        except (EOFError, ConnectionError) as error:
            raise BrokenProcessPool("a worker process died") from error
        finally:
            self._idle.put(number)
        if error is not None:
            raise error
        return result


def _work(parent_pid: int, pipe: Connection) -> None:
    """The life of a process: calls come over the pipe, results or errors go back."""
    janitor.die_with_parent(parent_pid)
    ignore_signals()  # they go to the whole process group; the parent ends this process
    os.set_inheritable(pipe.fileno(), False)  # it is to close with this process, not with its engines
    os.environ |= one_core()
    with contextlib.suppress(EOFError, ConnectionError):
        while True:
            call = pipe.recv()
            try:
                pipe.send((call(), None))
            except Exception as error:  # the process boundary: whatever it is, the caller is to hear of it
                error.add_note("in a worker process:\n" + traceback.format_exc())
                pipe.send((None, error))
