"""What a host sends the learner: batches of step records, in bytes. Nothing in them is a pickle.

A batch is one byte, WIRE_VERSION; the length of the header, a u32; the header in msgpack; the step records; the frames.
Records are sorted by lane and keep their order within one. So neighbouring frames are of one game, and a block of them
shrinks to 0.40 of its size, where single frames shrink to 0.60 (zstd-1, 1,013 frames; 2026-11, x86-64). Frames are
compressed in blocks of BLOCK_FRAMES. The size of every part is checked before any memory is taken for it.
"""

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from gvz.core.errors import ConfigError, TransportError
from gvz.transport.messages import Count, Message, StepBlock, decode, encode

try:
    import zstandard
except ModuleNotFoundError as error:
    raise ConfigError("cluster: zstandard is not installed; pip install 'gvizdoom[cluster]'") from error

WIRE_VERSION = 1
"""increased by one when the meaning or layout of anything in this file changes"""
BLOCK_FRAMES = 64
LEVEL = 1
"""3 saves another quarter of the bytes for twice the time"""
_PREFIX = struct.Struct("<BI")
_MAX_HEADER_BYTES = 2**24
"""some 30,000 messages"""

Positive = Annotated[float, msgspec.Meta(ge=0.0)]


class BatchHeader(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What stands before the records of a batch."""

    run_id: str
    """of the start of the run; every start has another"""
    host: Count
    incarnation: Count
    """how often this host was replaced before"""
    number: Count
    """0, 1, 2, ... within the incarnation: a lost batch shows"""
    num_records: Count = 0
    compressed: bool = False
    frame_bytes: list[Count] = []
    """of each block of frames, as sent"""
    messages: list[bytes] = []
    """of the actors, in order (gvz.transport.messages)"""
    actors_ready: Count = 0
    restarts: Count = 0
    """of actors, since the host began"""
    waited_for_space_s: Positive = 0.0
    """likewise, summed over actors"""
    failure: str = ""
    """why the host has ended, if it has; then this is its last batch"""


@dataclass(frozen=True, slots=True)
class Batch:
    """A batch as the learner takes it."""

    header: BatchHeader
    messages: list[Message]
    block: StepBlock

    def __len__(self) -> int:
        return self.header.num_records


_HEADER = msgspec.msgpack.Decoder(BatchHeader)


def pack(header: BatchHeader, messages: Sequence[Message], blocks: Sequence[StepBlock], *, compress: bool) -> bytes:
    """A batch of all records of `blocks`, which are of one dtype and frame shape, and of what the actors said."""
    parts: list[bytes] = []
    num_records = sum(map(len, blocks))
    if num_records:
        steps = np.concatenate([block.steps for block in blocks])
        order = np.argsort(steps["lane"], kind="stable")
        frames = np.concatenate([block.frames for block in blocks])[order]
        parts = [steps[order].tobytes(), *_packed_frames(frames, compress)]
    header = msgspec.structs.replace(
        header,
        num_records=num_records,
        compressed=compress,
        frame_bytes=[len(part) for part in parts[1:]],
        messages=[encode(message) for message in messages],
    )
    encoded = msgspec.msgpack.encode(header)
    return b"".join((_PREFIX.pack(WIRE_VERSION, len(encoded)), encoded, *parts))


def unpack(data: bytes, dtype: np.dtype, frame_shape: tuple[int, int, int], max_records: int) -> Batch:
    """The batch in `data`, whose records are of `dtype` and `frame_shape`.

    Raises:
        TransportError: it is none, or larger than `max_records`; nothing larger than that is ever allocated.
    """
    header, at = read_header(data)
    count, frame_size = header.num_records, math.prod(frame_shape)
    if count > max_records:
        raise TransportError(f"batch: got {count} records, want at most {max_records}")
    num_blocks = -(-count // BLOCK_FRAMES)
    want = at + count * dtype.itemsize + sum(header.frame_bytes)
    if len(header.frame_bytes) != num_blocks or len(data) != want:
        raise TransportError(
            f"batch: got {len(data)} bytes with {len(header.frame_bytes)} blocks of frames, want {want} bytes with "
            f"{num_blocks} for {count} records"
        )
    messages = [decode(message) for message in header.messages]
    steps = np.frombuffer(data, dtype, count, at).copy()
    at += steps.nbytes
    frames = np.empty((count, *frame_shape), np.uint8)
    decompressor = zstandard.ZstdDecompressor()
    for first, size in zip(range(0, count, BLOCK_FRAMES), header.frame_bytes, strict=True):
        block = frames[first : first + BLOCK_FRAMES]
        part = memoryview(data)[at : at + size]
        if header.compressed:
            part = _decompressed(decompressor, part, len(block) * frame_size)
        if len(part) != block.nbytes:
            raise TransportError(f"batch: got {len(part)} bytes of {len(block)} frames, want {block.nbytes}")
        block.reshape(-1)[:] = np.frombuffer(part, np.uint8)
        at += size
    return Batch(header, messages, StepBlock(steps, frames))


def read_header(data: bytes) -> tuple[BatchHeader, int]:
    """(The header of a batch, where its records begin).

    Raises:
        TransportError: it is not a batch of this version.
    """
    if len(data) < _PREFIX.size or data[0] != WIRE_VERSION:
        raise TransportError(f"batch of {len(data)} bytes: want version {WIRE_VERSION} in its first byte")
    _, size = _PREFIX.unpack_from(data)
    end = _PREFIX.size + size
    if size > _MAX_HEADER_BYTES or end > len(data):
        raise TransportError(f"batch of {len(data)} bytes: got a header of {size} bytes, want less")
    try:
        return _HEADER.decode(memoryview(data)[_PREFIX.size : end]), end
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise TransportError(f"batch of {len(data)} bytes: {error}") from error


def _packed_frames(frames: np.ndarray, compress: bool) -> list[bytes]:
    """Blocks of uint8[N, H, W, C]."""
    blocks = [frames[first : first + BLOCK_FRAMES].tobytes() for first in range(0, len(frames), BLOCK_FRAMES)]
    if not compress:
        return blocks
    compressor = zstandard.ZstdCompressor(level=LEVEL, write_checksum=True)
    return [compressor.compress(block) for block in blocks]


def _decompressed(decompressor: zstandard.ZstdDecompressor, part: memoryview, size: int) -> memoryview:
    try:
        found = zstandard.get_frame_parameters(part).content_size
        if found != size:  # also what states no size
            raise TransportError(f"batch: got a block of {found} bytes, want {size}")
        return memoryview(decompressor.decompress(part, allow_extra_data=False))
    except zstandard.ZstdError as error:
        raise TransportError(f"batch: a block of frames is damaged: {error}") from error
