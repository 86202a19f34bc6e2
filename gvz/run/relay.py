"""What carries messages between the processes of a group: lines of JSON over TCP. Standard library only.

Process 0 runs a `Relay`, to which every process connects, itself too. It hands each message to all. A process that is
gone is known at once, by its closed connection, and one that is silent after a while.
"""

import contextlib
import json
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

MAX_LINE_BYTES = 2**20
HELLO_TIMEOUT_S = 20.0
"""for a connection's first line; who sends none is no process of the group"""
_ACCEPT_RETRY_S = 0.1
"""after a connection that could not be taken"""


class Relay:
    """Threads that hand every line from any process of the group to all of them; a later one is told what was said."""

    def __init__(self, address: tuple[str, int], num_processes: int):
        """Listens.

        Raises:
            OSError: it cannot listen there.
        """
        self._num_processes = num_processes
        self._server = socket.create_server(address, backlog=2 * num_processes)
        self._lock = threading.Lock()
        self._connections: dict[int, socket.socket] = {}
        self._said: list[bytes] = []
        _start(self._accept, "group relay")

    def close(self) -> None:
        close(self._server)
        for connection in self._connections.values():
            close(connection)

    def _accept(self) -> None:
        for connection in _accepted(self._server):
            _start(lambda c=connection: self._serve(c), "group relay, a process")

    def _serve(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.settimeout(HELLO_TIMEOUT_S)
        process, lines = None, connection.makefile("rb")
        with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
            process = self._join(connection, lines.readline(MAX_LINE_BYTES))
            connection.settimeout(None)
            while (line := lines.readline(MAX_LINE_BYTES)).endswith(b"\n"):  # else it went in the middle of one
                self._hand_on(line)
        close(connection)
        if process is not None:
            self._hand_on(encode({"kind": "gone", "from": process}))

    def _join(self, connection: socket.socket, hello: bytes) -> int:
        """Takes a process in. Raises ValueError, KeyError, TypeError: it is none of the group."""
        process = decode(hello)["from"]
        with self._lock:
            if process in self._connections or process not in range(self._num_processes):
                why = f"process_id {process} is taken, or not one of {self._num_processes}"
                connection.sendall(encode({"kind": "refused", "from": 0, "value": why}))
                raise ValueError(why)
            connection.sendall(b"".join(self._said))
            self._connections[process] = connection
        self._hand_on(hello)
        return process

    def _hand_on(self, line: bytes) -> None:
        with self._lock:
            if len(self._connections) < self._num_processes:
                self._said.append(line)
            for connection in self._connections.values():
                with contextlib.suppress(OSError):  # it is gone, which its own thread says
                    connection.sendall(line)


class Forward:
    """A local port whose connections lead to another address, and stay open when that one is gone.

    JAX ends its process at once, with a page of C++, when the connection to its coordinator closes. Through this it is
    not closed, and the group has the time to end in order.
    """

    def __init__(self, target: tuple[str, int]):
        self._target = target
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._server.getsockname()[1]
        _start(self._accept, "group forward")

    def _accept(self) -> None:
        for near in _accepted(self._server):
            try:
                far = socket.create_connection(self._target, timeout=HELLO_TIMEOUT_S)
            except OSError:  # not there yet: JAX tries again
                near.close()
                continue
            for connection in (near, far):
                connection.settimeout(None)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            _start(lambda a=near, b=far: _pump(a, b, closes=True), "group forward, out")
            _start(lambda a=far, b=near: _pump(a, b, closes=False), "group forward, in")


def free_port(host: str) -> int:
    """A port that nobody listens to now."""
    with socket.create_server((host, 0)) as server:
        return server.getsockname()[1]


def wait_for_listener(address: tuple[str, int], timeout_s: float) -> None:
    """Returns when somebody listens there. Raises OSError: why there is no connection after this time."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        left_s = deadline_s - time.monotonic()
        try:
            socket.create_connection(address, timeout=max(left_s, 0.1)).close()
            return
        except OSError:
            if left_s < 0:
                raise
            time.sleep(0.1)


def encode(message: dict[str, Any]) -> bytes:
    return json.dumps(message).encode() + b"\n"


def decode(line: bytes) -> dict[str, Any]:
    """Raises ValueError: it is no message."""
    try:
        message = json.loads(line)
    except RecursionError as error:
        raise ValueError("nested too deeply") from error
    if not isinstance(message, dict):
        raise ValueError("not a message")
    return message


def close(connection: socket.socket) -> None:
    """Closes it for all threads that use it."""
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
    connection.close()


def _accepted(server: socket.socket) -> Iterator[socket.socket]:
    """Its connections until it is closed; those after one that failed, or after a lack of open files, too."""
    while server.fileno() >= 0:
        try:
            connection, _ = server.accept()
        except OSError:
            time.sleep(_ACCEPT_RETRY_S)
            continue
        yield connection


def _pump(source: socket.socket, sink: socket.socket, *, closes: bool) -> None:
    with contextlib.suppress(OSError):
        while data := source.recv(65536):
            sink.sendall(data)
    if closes:
        close(sink)


def _start(work: Any, name: str) -> None:
    threading.Thread(target=work, name=name, daemon=True).start()
