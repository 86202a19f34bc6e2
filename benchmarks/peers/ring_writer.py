"""Writes blocks into a ring as fast as its reader frees slots: `python ring_writer.py DESCRIPTOR CAPACITY BLOCK`."""

import sys

import numpy as np
from serve import serve_rate

from gvz.transport.ring import RingWriter

_SHAPE = (84, 84, 3)
_TIMEOUT_S = 60.0


def main() -> None:
    """Attaches to the ring and serves."""
    descriptor, capacity, block = map(int, sys.argv[1:])
    ring = RingWriter.attach(descriptor, capacity, _SHAPE)
    frames = np.random.default_rng(0).integers(0, 256, (block, *_SHAPE), np.uint8)

    def write() -> int:
        ring.wait_for_space(block, _TIMEOUT_S)
        _, slots = ring.reserve(block)
        slots[...] = frames
        ring.commit()
        return block

    serve_rate(write)


if __name__ == "__main__":
    main()
