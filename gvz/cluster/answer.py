"""A call of Ray that may have no end: where the head hangs, Ray waits for it in C++, deaf to signals."""

import threading
from collections.abc import Callable
from typing import Any

from gvz.core import stop


class Answer(threading.Thread):
    """A call in a thread of its own."""

    def __init__(self, call: Callable[[], Any]):
        """Starts it."""
        super().__init__(name="ray", daemon=True)
        self._call = call
        self._found: Any = None
        self._error: Exception | None = None
        self.start()

    def run(self) -> None:
        """The thread's work."""
        try:
            self._found = self._call()
        except Exception as error:  # it is the asking thread's
            self._error = error

    def result(self, timeout_s: float) -> Any:
        """What the call returns or raises. Can be repeated.

        Raises:
            TimeoutError: it has not ended within this time.
        """
        self.join(timeout_s)
        if self.is_alive():
            stop.stuck.add(self)
            raise TimeoutError(f"Ray gave no answer within {timeout_s:g} s")
        if self._error is not None:
            raise self._error
        return self._found
