"""How the learner's process handles memory that was freed.

A train step on a CPU takes some 85 MB of scratch memory and frees them again. glibc gives blocks of that size back to
the kernel at once, so that every step has them mapped, cleared and faulted in again, 4 KB at a time: 21,000 page faults
a step, and 29% of the processor time of an hour of `rainbow_4task` on two cores. With the memory kept, a step takes 94
to 106 ms instead of 134 (alternating, two rounds; 2026-11-21, 2-core AMD EPYC).
"""

import contextlib
import ctypes

_M_TRIM_THRESHOLD, _M_MMAP_MAX, _M_ARENA_MAX = -1, -4, -8
"""of glibc's malloc.h"""
_MOST_KEPT_BYTES = 2**31 - 1


def keep_freed_memory() -> None:
    """Has malloc keep freed blocks of any size for the next step, up to 2 GB at the end of the heap.

    All threads allocate from one heap: XLA runs a step in a thread of its own, and a thread's own arena has room for 64
    MB and takes larger blocks from the kernel, whatever the thresholds are. So call it before other threads allocate.

    Does nothing where the C library is not glibc. The pages of a larger block that is not needed again, as a
    checkpoint's copy of the replay, go back to the kernel with `release_freed_memory`.
    """
    with contextlib.suppress(AttributeError):  # musl has no mallopt
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_M_ARENA_MAX, 1)
        mallopt(_M_MMAP_MAX, 0)
        mallopt(_M_TRIM_THRESHOLD, _MOST_KEPT_BYTES)


def release_freed_memory() -> None:
    """Gives all freed pages back to the kernel; the next step faults its own in again, once."""
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
