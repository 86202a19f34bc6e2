"""One process's end of its group: messages to all, values gathered from all, and who is gone. Standard library only."""

import contextlib
import socket
import threading
import time
from typing import Any

from gvz.core.errors import ConfigError, GroupError, WaitTimeoutError
from gvz.core.stop import exit_at_once
from gvz.core.watchdog import AwakeClock
from gvz.run.relay import close, decode, encode

JOIN_TIMEOUT_S = 600.0
"""for the other processes to start"""
BEAT_PERIOD_S = 2.0
SILENCE_TIMEOUT_S = 60.0
"""a process that is not heard of for this time counts as gone: its host is down, or the network"""
LEAVE_TIMEOUT_S = 20.0
"""for a process whose group has ended to end in order; then it is ended wherever it is stuck"""


class Link:
    """The connection of a process to its group; two threads of its own read and watch it."""

    def __init__(self, address: tuple[str, int], process: int, num_processes: int, hello: dict[str, Any]):
        """Connects and waits until all processes have.

        Raises:
            WaitTimeoutError: some do not come; says which. ConfigError: two have one number.
        """
        self._process, self._num_processes = process, num_processes
        self._changed = threading.Condition()
        self._values: dict[tuple[str, int], dict[int, Any]] = {}
        self._clock = AwakeClock(2 * BEAT_PERIOD_S)  # what a stopped process does not hear is nobody's silence
        self._heard_s = dict.fromkeys(range(num_processes), 0.0)
        self._refused: str | None = None
        self._done = set[int]()
        self.failure: str | None = None
        """why the group has ended"""
        self.stop_signal: int | None = None
        """a process asks all to stop, because of this signal"""
        self._socket = self._connect(address)
        self._address: tuple[str, int] | None = address  # until something of the group has come from there
        self._write = threading.Lock()
        self._rounds: dict[str, int] = {}
        self._closed = False
        self.send("hello", hello)
        for work in (self._read, self._watch):
            threading.Thread(target=work, name="group", daemon=True).start()
        self.hellos: list[dict[str, Any]]
        """what each process said of itself"""
        try:
            self.hellos = self._wait_for(("hello", 0), JOIN_TIMEOUT_S, f"to connect to {address[0]}:{address[1]}")
        except BaseException:
            self.close()
            raise

    def send(self, kind: str, value: Any = None, number: int = 0) -> None:
        """A message to all processes, this one included."""
        line = encode({"kind": kind, "from": self._process, "number": number, "value": value})
        with self._write, contextlib.suppress(OSError):  # closed: the reader says so
            self._socket.sendall(line)

    def gather(self, kind: str, value: Any, timeout_s: float, what: str) -> list[Any]:
        """The values of all processes, in order; all call it with the same kinds in the same order.

        Raises:
            GroupError: a process is gone. WaitTimeoutError: one does not answer; `what` says what it was to do.
        """
        number = self._rounds[kind] = self._rounds.get(kind, -1) + 1
        self.send(kind, value, number)
        return self._wait_for((kind, number), timeout_s, what)

    def values(self, kind: str, number: int, wait_s: float) -> list[Any] | None:
        """The values that all processes have sent with this kind and number; None if some are missing still.

        Raises:
            GroupError: a process is gone.
        """
        with self._changed:
            self._changed.wait_for(lambda: self.failure or self._complete((kind, number)), wait_s)
            return self._take((kind, number))

    def check(self) -> None:
        """Raises GroupError: a process is gone."""
        if self.failure is not None:
            raise GroupError(self.failure)

    def wait_for_failure(self, wait_s: float) -> None:
        """Waits for the news that a process is gone, if one is.

        Raises:
            GroupError: it is.
        """
        with self._changed:
            self._changed.wait_for(lambda: self.failure, wait_s)
        self.check()

    def close(self) -> None:
        """Leaves the group: this process is watched no more."""
        self._closed = True
        close(self._socket)

    def _connect(self, address: tuple[str, int]) -> socket.socket:
        deadline_s = time.monotonic() + JOIN_TIMEOUT_S
        while True:
            try:
                connection = socket.create_connection(address, timeout=10.0)
                connection.settimeout(None)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                return connection
            except OSError as error:
                if time.monotonic() > deadline_s:
                    raise WaitTimeoutError(
                        f"group.coordinator: waited {JOIN_TIMEOUT_S:.0f} s for learner process 0 at {address[0]}:"
                        f"{address[1]} ({error.strerror or error}); start it, or correct the address"
                    ) from error
                time.sleep(0.2)

    def _read(self) -> None:
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError), self._socket.makefile("rb") as lines:
            for line in lines:
                self._take_in(decode(line))
                self._address = None
        if self._address is None:
            self._fail(0)
        else:
            host, port = self._address
            self._fail(0, f"has not answered at {host}:{port} (is that group.coordinator right?)")

    def _take_in(self, message: dict[str, Any]) -> None:
        kind, process = message["kind"], message["from"]
        if kind == "gone":
            self._fail(process)
            return
        with self._changed:
            self._heard_s[process] = self._clock.now_s
            if kind == "refused":
                self._refused = message["value"]
            elif kind == "stop":
                self.stop_signal = message["value"]
            elif kind == "done":
                self._done.add(process)
            if kind != "beat":
                self._values.setdefault((kind, message["number"]), {})[process] = message["value"]
                self._changed.notify_all()

    def _fail(self, process: int, why: str = "is gone") -> None:
        """A process is gone, unless it has said that it is done."""
        with self._changed:
            if self._closed or self.failure is not None or process in self._done:
                return
            self.failure = (
                f"learner process {process} of {self._num_processes} {why}, so the group ends; look at what it said "
                "last, and give the same commands again: all go on from the newest checkpoint that all have"
            )
            self._changed.notify_all()

    def _watch(self) -> None:
        while not self._closed and self.failure is None:
            self.send("beat")
            time.sleep(BEAT_PERIOD_S)
            now_s = self._clock.look()
            for process, heard_s in self._heard_s.items():
                if self.hellos_complete and now_s - heard_s > SILENCE_TIMEOUT_S:
                    self._fail(process, f"is silent for {SILENCE_TIMEOUT_S:.0f} s")
        self._end_if_stuck()

    @property
    def hellos_complete(self) -> bool:
        return ("hello", 0) not in self._values

    def _end_if_stuck(self) -> None:
        """Ends this process, whose main thread may wait without end for what the others were to send."""
        deadline_s = time.monotonic() + LEAVE_TIMEOUT_S
        while not self._closed and time.monotonic() < deadline_s:
            time.sleep(0.1)
        if not self._closed:
            exit_at_once(1, f"error: {self.failure}")

    def _complete(self, key: tuple[str, int]) -> bool:
        return len(self._values.get(key, ())) == self._num_processes

    def _take(self, key: tuple[str, int]) -> list[Any] | None:
        if not self._complete(key):
            self.check()
            return None
        by_process = self._values.pop(key)
        return [by_process[process] for process in range(self._num_processes)]

    def _wait_for(self, key: tuple[str, int], timeout_s: float, what: str) -> list[Any]:
        def ended() -> Any:
            return self.failure or self._refused or self._complete(key)

        with self._changed:
            self._changed.wait_for(ended, timeout_s)
            if self._refused is not None:
                raise ConfigError(f"group.process_id: {self._refused}; each learner process needs a number of its own")
            if (values := self._take(key)) is not None:
                return values
            missing = set(range(self._num_processes)) - set(self._values.get(key, ()))
        names = ", ".join(map(str, sorted(missing)))
        raise WaitTimeoutError(f"group: waited {timeout_s:.0f} s for learner processes {names} {what}")
