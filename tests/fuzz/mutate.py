"""Inputs for the short form: seeds, and what chance makes of them. Imports the standard library only."""

import random
from collections.abc import Iterator

from tests.fuzz.target import Target


def inputs(target: Target, rng: random.Random) -> Iterator[bytes]:
    """Nothing at all, what broke the parser once, the seeds; then without end what chance makes of the seeds."""
    yield b""
    yield from target.once_broken
    yield from target.seeds
    while True:
        yield mutated(rng.choice(target.seeds), target, rng)


def mutated(data: bytes, target: Target, rng: random.Random) -> bytes:
    """`data` with a few pieces of it cut out, multiplied, or replaced by noise, words or parts of other seeds."""
    for _ in range(rng.choice((1, 1, 2, 3, 8))):
        start = rng.randrange(len(data) + 1)
        piece = data[start : start + rng.choice((0, 1, 1, 4, 16, 200))]
        other = rng.choice(target.seeds)
        at = rng.randrange(len(other) + 1)
        put = rng.choice(
            (
                b"",
                rng.randbytes(len(piece) or 1),
                bytes(byte ^ (1 << rng.randrange(8)) for byte in piece[:1]) + piece[1:],
                rng.choice(target.words or [b"\0"]),
                piece * rng.choice((2, 2, 50)),
                other[at : at + rng.choice((4, 16, 200))],
            )
        )
        data = data[:start] + put + data[start + len(piece) :]
    return data if rng.random() < 0.9 else data[: rng.randrange(len(data) + 1)]
