"""Control messages over a stream socket: four bytes of length (little-endian), then msgpack."""

import select
import socket
import struct

from gvz.core.errors import TransportError, WaitTimeoutError
from gvz.transport.messages import Message, decode, encode

MAX_MESSAGE_BYTES = 64 * 2**20
"""the largest message is an ActorSpec with its policy; a larger one is damaged"""
_RECEIVE_BYTES = 65536


class Channel:
    """One end of a connected socket. Sending waits at most `timeout_s`; receiving never waits unless asked to."""

    def __init__(self, connection: socket.socket, *, peer: str, timeout_s: float = 60.0):
        self._socket = connection
        self._socket.settimeout(timeout_s)
        self._poll = select.poll()
        self._poll.register(connection, select.POLLIN)
        self._timeout_s = timeout_s
        self._peer = peer
        self._buffer = bytearray()
        self.closed = False
        """the peer has closed its end; nothing more will arrive"""

    def fileno(self) -> int:
        return self._socket.fileno()

    def send(self, message: Message) -> None:
        """Sends a complete message. If the peer has closed its end, sets `closed` instead; what it said before is kept.

        Raises:
            WaitTimeoutError: the peer does not read.
        """
        data = encode(message)
        try:
            self._socket.sendall(struct.pack("<I", len(data)) + data)
        except TimeoutError as error:
            raise WaitTimeoutError(
                f"channel: waited {self._timeout_s:.0f} s for {self._peer} to read a message of {len(data)} bytes"
            ) from error
        except (BrokenPipeError, ConnectionResetError):
            while not self.closed and self._poll.poll(0):
                self._fill()
            self.closed = True

    def receive(self) -> list[Message]:
        """All messages that have arrived completely.

        Raises:
            TransportError: what arrived is not a message.
        """
        # at most the longest message at a time: a peer that never stops sending must not fill the memory
        while not self.closed and len(self._buffer) < 4 + MAX_MESSAGE_BYTES and self._poll.poll(0):
            self._fill()
        messages: list[Message] = []
        while (message := self._take()) is not None:
            messages.append(message)
        return messages

    def wait(self) -> None:
        """Waits until something arrives, or the peer closes its end, however long that takes."""
        self._poll.poll()

    def wait_for_message(self) -> Message:
        """The next message.

        Raises:
            WaitTimeoutError: none came in time. TransportError: the peer closed its end, or sent something else.
        """
        while (message := self._take()) is None:
            if self.closed:
                raise TransportError(f"channel: {self._peer} closed it before the message that was waited for")
            try:
                self._fill()
            except TimeoutError as error:
                raise WaitTimeoutError(
                    f"channel: waited {self._timeout_s:.0f} s for a message from {self._peer}"
                ) from error
        return message

    def close(self) -> None:
        self.closed = True
        self._socket.close()

    def _fill(self) -> None:
        """Moves bytes that have arrived into the buffer."""
        try:
            data = self._socket.recv(_RECEIVE_BYTES)
        except ConnectionResetError:
            data = b""
        self.closed = not data
        self._buffer += data

    def _take(self) -> Message | None:
        """The first message of the buffer, if it is complete."""
        if len(self._buffer) < 4:
            return None
        (length,) = struct.unpack_from("<I", self._buffer)
        if length > MAX_MESSAGE_BYTES:
            raise TransportError(
                f"channel: {self._peer} announced a message of {length} bytes, want at most {MAX_MESSAGE_BYTES}"
            )
        if len(self._buffer) < 4 + length:
            return None
        data = bytes(self._buffer[4 : 4 + length])
        del self._buffer[: 4 + length]
        return decode(data)
