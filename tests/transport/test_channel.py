"""Messages over a socket: whole, in order, and never trusted."""

import socket
import struct
import threading

import pytest

from gvz.core.errors import TransportError, WaitTimeoutError
from gvz.transport import channel
from gvz.transport.channel import MAX_MESSAGE_BYTES, Channel
from gvz.transport.messages import Fault, Ready, Stop, encode


@pytest.fixture
def pair():
    left, right = socket.socketpair()
    a, b = Channel(left, peer="B", timeout_s=0.2), Channel(right, peer="A", timeout_s=0.2)
    yield a, b
    a.close()
    b.close()


def fault(message: str) -> Fault:
    return Fault(actor=1, lane=None, kind="exception", message=message)


def test_messages_arrive_whole_and_in_order(pair: tuple[Channel, Channel]):
    a, b = pair
    sent = [Ready(actor=0, pid=5), fault("x" * 1000), Stop()]
    for message in sent:
        a.send(message)
    assert b.receive() == sent
    assert b.receive() == []


def test_a_message_that_comes_in_pieces_is_taken_when_it_is_whole():
    left, right = socket.socketpair()
    ours, data = Channel(right, peer="A"), encode(Stop())
    *early, last = struct.pack("<I", len(data)) + data
    for byte in early:
        left.sendall(bytes([byte]))
        assert ours.receive() == []
    left.sendall(bytes([last]))
    assert ours.receive() == [Stop()]
    left.close()
    ours.close()


def test_a_message_larger_than_the_sockets_buffer_passes(pair: tuple[Channel, Channel]):
    a, b = pair
    large = fault("y" * 3_000_000)
    thread = threading.Thread(target=a.send, args=(large,))
    thread.start()
    assert b.wait_for_message() == large
    thread.join()


def test_a_peer_that_does_not_read_is_named(pair: tuple[Channel, Channel]):
    with pytest.raises(WaitTimeoutError, match="waited 0 s for B to read a message of 3000"):
        pair[0].send(fault("y" * 3_000_000))


def test_a_peer_that_does_not_speak_is_named(pair: tuple[Channel, Channel]):
    with pytest.raises(WaitTimeoutError, match="waited 0 s for a message from A"):
        pair[1].wait_for_message()


def test_a_closed_peer_is_noticed_after_what_it_said(pair: tuple[Channel, Channel]):
    a, b = pair
    a.send(Stop())
    a.close()
    assert b.receive() == [Stop()]
    assert b.closed
    assert b.receive() == []
    with pytest.raises(TransportError, match="A closed it before the message"):
        b.wait_for_message()


def test_sending_to_a_closed_peer_is_noticed_not_raised(pair: tuple[Channel, Channel]):
    a, b = pair
    b.close()
    a.send(Stop())
    assert a.closed


@pytest.mark.parametrize("read", [True, False])
def test_what_a_peer_said_before_its_end_is_there_after_a_message_to_it(pair: tuple[Channel, Channel], read: bool):
    a, b = pair
    a.send(Stop())
    if read:
        b.receive()
    said = [Ready(actor=0, pid=5), fault("x" * 100_000)]
    for message in said:
        b.send(message)
    b.close()
    a.send(Stop())
    assert a.closed
    assert a.receive() == said


def test_a_peer_that_never_stops_sending_is_heard_in_parts(
    pair: tuple[Channel, Channel], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(channel, "MAX_MESSAGE_BYTES", 100)
    data = encode(Stop())
    pair[0]._socket.sendall(10_000 * (struct.pack("<I", len(data)) + data))
    parts = [len(pair[1].receive()) for _ in range(4)]
    assert sum(parts) == 10_000
    assert max(parts) < 8_000


def test_an_absurd_length_is_refused():
    left, right = socket.socketpair()
    ours = Channel(right, peer="A")
    left.sendall(struct.pack("<I", MAX_MESSAGE_BYTES + 1))
    with pytest.raises(TransportError, match="A announced a message of 67108865 bytes, want at most 67108864"):
        ours.receive()
    left.close()
    ours.close()
