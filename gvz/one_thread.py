"""Methods of an environment that only one thread may be in."""

import functools
import os
import threading
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

from gymnasium.error import AlreadyPendingCallError

_lock_name = "_one_thread"
S = TypeVar("S")
P = ParamSpec("P")
R = TypeVar("R")


def one_thread(method: Callable[Concatenate[S, P], R]) -> Callable[Concatenate[S, P], R]:
    """The method, which refuses a call while another thread is in it, or in another such method of the same object.

    ViZDoom's client would wait without end there, or read memory that is gone. A signal's handler may call it.
    """

    @functools.wraps(method)
    def alone(self: S, *args: P.args, **kwargs: P.kwargs) -> R:
        own = vars(self)  # it has the lock from the first call on, because a lock cannot be pickled
        lock = own.get(_lock_name) or own.setdefault(_lock_name, threading.RLock())
        if not lock.acquire(blocking=False):
            name = method.__qualname__
            raise AlreadyPendingCallError(
                f"{name}: another thread is in a call of this environment; want one at a time: wait for that thread",
                method.__name__,
            )
        try:
            return method(self, *args, **kwargs)
        finally:
            lock.release()

    return alone


def _rename_lock() -> None:
    """A fork does not have the threads of its parent, which may hold its locks."""
    global _lock_name
    _lock_name += "_of_fork"


os.register_at_fork(after_in_child=_rename_lock)
