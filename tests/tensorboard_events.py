"""Reads TensorBoard's event files: length u64, its checksum u32, the event, its checksum u32, and so on."""

import struct
from pathlib import Path

from tensorboardX.proto.event_pb2 import Event


def read_events(directory: Path) -> list[Event]:
    """The events of a directory, in the order of its files' names, which is that of the starts."""
    found = []
    for file in sorted(directory.glob("events*")):
        data, at = file.read_bytes(), 0
        while at < len(data):
            (length,) = struct.unpack_from("<Q", data, at)
            found.append(Event.FromString(data[at + 12 : at + 12 + length]))
            at += 16 + length
    return found
