"""What the pool of hosts needs of a cluster, whatever that is made of. `gvz.cluster.ray_hosts` is Ray's."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from actors.pool import PoolConfig
from gvz.cluster.host import HostSpec
from gvz.core.errors import GvzError
from gvz.transport.messages import ParamsHeader

Call = Any
"""a call under way; hashable"""


class HostError(GvzError):
    """A call did not come back with an answer: the host, its node or the network is to blame."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Machine:
    """A node that lives."""

    id: str
    name: str
    """as a person knows it"""
    cpus: int
    """that the cluster may give away there"""
    has_learner: bool


class Remote(Protocol):
    """A process on some machine, made to hold one `gvz.cluster.host.Host`. Nothing here waits for it."""

    def greet(self, config: PoolConfig) -> Call:
        """-> bytes: `host.greet`"""
        ...

    def begin(self, spec: HostSpec) -> Call:
        """-> None: its host starts its actors"""
        ...

    def next_batch(self, assigned: Sequence[tuple[int, int]]) -> Call:
        """-> bytes: `Host.next_batch`; calls are answered in order"""
        ...

    def set_params(self, params: Any, header: ParamsHeader) -> Call:
        """-> None: `Host.set_params`; `params` are what `put` gave"""
        ...

    def close(self, timeout_s: float) -> Call:
        """-> bool: `Host.close`"""
        ...

    def kill(self) -> None:
        """Ends the process at once, in whatever state it is. Can be repeated."""
        ...


class Backend(Protocol):
    """A cluster that this process is connected to. One thread at a time uses it."""

    def machines(self) -> list[Machine]:
        """Those that live."""
        ...

    def start(self, machine: str, cpus: int) -> Remote:
        """Has a process started on the machine with this id, which keeps `cpus` of its cores reserved."""
        ...

    def put(self, params: np.ndarray) -> Any:
        """Makes float32[P] available to every machine."""
        ...

    def wait(self, calls: Sequence[Call], timeout_s: float) -> list[Call]:
        """Those that have ended, well or not; may wait for others until the time is over."""
        ...

    def result(self, call: Call) -> Any:
        """The answer of a call that has ended.

        Raises:
            HostError: it failed.
        """
        ...

    def clean(self, machine: str) -> Call:
        """Has a machine cleaned of what killed hosts have left there."""
        ...

    def close(self) -> None:
        """Ends the connection and all processes that were started. Can be repeated."""
        ...
