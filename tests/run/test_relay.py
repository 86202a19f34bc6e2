"""What carries messages between learner processes: connections that come late, fail, or end in the middle."""

import errno
import os
import socket
import threading
from typing import Any

import pytest

from gvz.core.errors import GroupError
from gvz.run import link, relay
from gvz.run.relay import Forward, Relay, free_port


def test_a_process_that_goes_in_the_middle_of_a_message_is_the_one_that_is_named():
    address = "127.0.0.1", free_port("127.0.0.1")
    the_relay = Relay(address, 2)
    with socket.create_connection(address) as other:
        other.sendall(relay.encode({"kind": "hello", "from": 1, "number": 0, "value": {}}))
        assert other.recv(1000), "it has joined: a later process is told of it"
        first = link.Link(address, 0, 2, {})
        other.sendall(b'{"kind": "propose", "fr')
        other.shutdown(socket.SHUT_WR)
        with pytest.raises(GroupError, match="learner process 1 of 2 is gone"):
            first.wait_for_failure(30)
    first.close()
    the_relay.close()


def test_jax_in_process_0_may_come_late():
    address = "127.0.0.1", free_port("127.0.0.1")
    waiting = threading.Thread(target=relay.wait_for_listener, args=(address, 30.0))
    waiting.start()
    waiting.join(0.3)
    assert waiting.is_alive()
    with socket.create_server(address):
        waiting.join(30)
    assert not waiting.is_alive()


@pytest.mark.parametrize("number", [errno.ECONNABORTED, errno.EMFILE])
def test_a_connection_that_cannot_be_taken_does_not_keep_later_ones_out(number, monkeypatch):
    accept, failures = socket.socket.accept, iter([OSError(number, os.strerror(number))])

    def first_fails(server: socket.socket) -> tuple[socket.socket, Any]:
        for failure in failures:
            raise failure
        return accept(server)

    monkeypatch.setattr(socket.socket, "accept", first_fails)
    address = "127.0.0.1", free_port("127.0.0.1")
    the_relay = Relay(address, 1)
    link.Link(address, 0, 1, {}).close()
    assert next(failures, None) is None
    the_relay.close()


def test_a_forwarded_connection_outlives_the_other_end():
    with socket.create_server(("127.0.0.1", 0)) as server:
        near = socket.create_connection(("127.0.0.1", Forward(server.getsockname()[:2]).port))
        far, _ = server.accept()
        near.sendall(b"out")
        far.sendall(b"in")
        assert (far.recv(3), near.recv(2)) == (b"out", b"in")
        far.close()
        near.settimeout(0.3)
        with pytest.raises(TimeoutError):
            near.recv(1)
        near.close()
