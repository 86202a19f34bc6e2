"""The locks of an engine's two message queues, which an engine that is killed can take with it.

ViZDoom's client and engine talk through two queues of Boost.Interprocess in shared memory. Each has a lock that the
kernel does not free when its holder dies: the engine wakes the client while it holds the lock, so a kill often hits it
there. The client then waits without end. Only the client can still want such a lock, so this process frees it.
"""

import contextlib
import ctypes
import mmap
import struct
import threading
from collections.abc import Sequence
from pathlib import Path

from gvz.core import janitor

_OFFSET = 48
"""of the lock, a pthread_mutex_t, in a queue's file"""
_MUTEX = struct.Struct("iIiIi")
"""its first fields in glibc: locked, count, owner (a thread id), users, kind"""
_PROCESS_SHARED = 128
"""the kind of such a lock; of another kind, this is no lock that we know"""
_freeing = threading.Lock()


def mapped(instance_id: str) -> list[mmap.mmap]:
    """The queues of an engine in this process's memory; they stay readable when their files are removed."""
    found: list[mmap.mmap] = []
    for prefix in janitor.QUEUE_PREFIXES:
        with contextlib.suppress(FileNotFoundError), Path(janitor.SHM_DIR, prefix + instance_id).open("r+b") as file:
            found.append(mmap.mmap(file.fileno(), 0))
    return found


def free(queues: Sequence[mmap.mmap]) -> None:
    """Frees the locks that no thread of this process holds. Call it when the engine is dead."""
    with _freeing:  # the watchdog and a thread that closes the engine, at the same time
        for queue in queues:
            locked, _, owner, _, kind = _MUTEX.unpack_from(queue, _OFFSET)
            if locked and owner and kind == _PROCESS_SHARED and not Path(f"/proc/self/task/{owner}").exists():
                lock = ctypes.c_char.from_buffer(queue, _OFFSET)
                ctypes.CDLL(None).pthread_mutex_unlock(ctypes.byref(lock))
                del lock  # it would keep the mapping open
