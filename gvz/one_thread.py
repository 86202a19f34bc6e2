"""Methods of an environment that only one thread may be in."""

import functools
import os
import threading
from collections.abc import Callable
from typing import Concatenate, ParamSpec, TypeVar

from gymnasium.error import AlreadyPendingCallError

S = TypeVar("S")
P = ParamSpec("P")
R = TypeVar("R")


def one_thread(method: Callable[Concatenate[S, P], R]) -> Callable[Concatenate[S, P], R]:
    """The method, which refuses a call while another thread is in it, or in another such method of the same object.

    ViZDoom's client would wait without end there, or read memory that is gone. A signal's handler may call it, and so
    may a fork, which has not the threads of its parent.
    """

    @functools.wraps(method)
    def alone(self: S, *args: P.args, **kwargs: P.kwargs) -> R:
        own, caller = vars(self), (os.getpid(), threading.get_ident())
        before = own.get("_caller")
        if before and before[0] == caller[0] and before != caller:
            name = method.__qualname__
            raise AlreadyPendingCallError(
                f"{name}: another thread is in a call of this environment; want one at a time: wait for that thread",
                method.__name__,
            )
        own["_caller"] = caller
        try:
            return method(self, *args, **kwargs)
        finally:
            own["_caller"] = before

    return alone
