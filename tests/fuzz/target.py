"""What a fuzz target is, and how an input is tried. Imports the standard library only."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

MAX_CPU_S = 5.0
"""more for one input of some kilobytes is a hang"""


def _nothing() -> None:
    pass


@dataclass(frozen=True, kw_only=True, slots=True)
class Target:
    """A parser, and how to tell whether it keeps its promise: a named error or a right answer, whatever the bytes."""

    run: Callable[[bytes], bool]
    """feeds the parser; tells whether it took the bytes for good, and raises only if the promise is broken"""
    seeds: Sequence[bytes]
    """examples, the first one good"""
    once_broken: Sequence[bytes] = ()
    """inputs that broke the promise before the parser was mended"""
    words: Sequence[bytes] = ()
    """pieces that mean something to the parser"""
    max_bytes: int = 8192
    """length of the inputs that the long form makes"""
    num_inputs: int = 300
    """tried by the short form"""
    close: Callable[[], None] = _nothing
    """gives back what is not in the target's directory"""


def attempt(target: Target, data: bytes) -> bool:
    """Tries an input; tells whether the parser took it.

    Raises:
        AssertionError, or whatever else the parser let out: the promise is broken.
    """
    start_s = time.thread_time()  # not the wall's: the machine may be busy
    taken = target.run(data)
    used_s = time.thread_time() - start_s
    assert used_s < MAX_CPU_S, f"{len(data)} bytes took {used_s:.1f} s"
    return taken
