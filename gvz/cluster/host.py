"""A host: the ordinary pool of actor processes on a machine that is not the learner's. It knows nothing of Ray.

One thread, the pump, owns the pool for its whole life, because actors end with the thread that started them. It watches
the actors, gathers their records and keeps those of one batch ready. It takes nothing out of the rings while that batch
waits, so full rings hold the actors back, as on one machine. The other methods are called by threads of their own.
"""

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np

from actors.placement import actor_cores
from actors.pool import PoolConfig, PoolStatistics
from actors.process_pool import ProcessPool
from gvz.cluster import hello, wire
from gvz.core import janitor
from gvz.core.errors import ResourceError, WaitTimeoutError
from gvz.transport.messages import Message, ParamsHeader, StepBlock

ANSWER_S = 1.0
"""`next_batch` answers within this time, if with an empty batch: a sign of life"""
_WAIT_S = 0.01
_GATHER_S = 0.25
"""records of a host that plays slowly wait this long for others"""
_ABANDONED_S = 3600.0
"""a host that nobody asks for this time ends: its learner cannot be reached"""


@dataclass(frozen=True, kw_only=True, slots=True)
class HostSpec:
    """What one incarnation of a host plays."""

    run_id: str
    host: int
    incarnation: int
    pool: PoolConfig
    """the host's actors; its work_dir and cores are found on the host"""
    state: dict[str, Any]
    """as `Pool.state()` of these actors"""
    batch_records: int
    compress: bool


@dataclass(frozen=True, kw_only=True, slots=True)
class _Gathered:
    """What the pump has for the next batch."""

    messages: list[Message]
    blocks: list[StepBlock]


class Host:
    """One incarnation of a host; `close` ends it."""

    def __init__(self, spec: HostSpec):
        """Starts the pump, which starts the actors; does not wait for them."""
        self._spec = spec
        self._changed = threading.Condition()
        self._gathered: _Gathered | None = None
        self._statistics: PoolStatistics | None = None
        self._params: tuple[np.ndarray, ParamsHeader] | None = None
        self._assigned: list[tuple[int, int]] = []
        self._asked_s = time.monotonic()
        self._closing, self._ended, self._failure, self._num_batches = False, False, "", 0
        self._pump = threading.Thread(target=self._run, name="gvz-host-pump", daemon=True)
        self._pump.start()

    def next_batch(self, assigned: Sequence[tuple[int, int]] = ()) -> bytes:
        """The next batch (`wire`), an empty one if none is ready in time. For one thread alone: batches are numbered.

        `assigned` are lanes and the tasks of their next episodes.
        """
        with self._changed:
            self._asked_s = time.monotonic()
            self._assigned += assigned
            self._changed.wait_for(lambda: self._gathered is not None or self._ended, ANSWER_S)
            gathered, self._gathered = self._gathered, None
            statistics, spec = self._statistics, self._spec
            header = wire.BatchHeader(
                run_id=spec.run_id,
                host=spec.host,
                incarnation=spec.incarnation,
                number=self._num_batches,
                actors_ready=statistics.actors_ready if statistics else 0,
                restarts=statistics.restarts if statistics else 0,
                waited_for_space_s=statistics.waited_for_space_s if statistics else 0.0,
                failure=(self._failure or "it was closed") if gathered is None and self._ended else "",
            )
            self._num_batches += 1
        if gathered is None:
            return wire.pack(header, [], [], compress=False)
        return wire.pack(header, gathered.messages, gathered.blocks, compress=spec.compress)

    def set_params(self, params: np.ndarray, header: ParamsHeader) -> None:
        """The actors' next steps are chosen by `params` float32[P]; what came before and was not taken yet is not."""
        with self._changed:
            self._params = params, header

    def close(self, timeout_s: float) -> bool:
        """Ends all actors; tells whether they have ended within the time."""
        self._closing = True
        self._pump.join(timeout_s)
        return not self._pump.is_alive()

    def _run(self) -> None:
        spec = self._spec
        try:
            with janitor.temporary_directory() as directory:
                cores = tuple(actor_cores(spec.pool.actors.placement, spec.pool.num_actors))
                config = msgspec.structs.replace(spec.pool, cores=cores, work_dir=directory / "work")
                with ProcessPool(config, spec.state) as pool:
                    self._pump_records(pool)
        except Exception as error:  # the boundary of the host: the learner is to hear of it
            self._failure = f"{type(error).__name__}: {error}"
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _pump_records(self, pool: ProcessPool) -> None:
        messages: list[Message] = []
        blocks: list[StepBlock] = []
        since_s = time.monotonic()
        while not self._closing:
            self._hand_on(pool)
            messages += pool.poll()
            if self._gathered is not None:  # only this thread sets it
                time.sleep(_WAIT_S)
                continue
            missing = self._spec.batch_records - sum(map(len, blocks))
            if not (blocks or messages):
                since_s = time.monotonic()
            blocks += pool.drain(missing, wait_s=_WAIT_S)
            if sum(map(len, blocks)) >= self._spec.batch_records or time.monotonic() - since_s > _GATHER_S:
                with self._changed:
                    self._gathered = _Gathered(messages=messages, blocks=blocks)
                    self._statistics = pool.statistics()
                    self._changed.notify_all()
                messages, blocks = [], []

    def _hand_on(self, pool: ProcessPool) -> None:
        """The learner's newest parameters and tasks -> actors."""
        with self._changed:
            params, self._params = self._params, None
            assigned, self._assigned = self._assigned, []
            silent_s = time.monotonic() - self._asked_s
        if silent_s > _ABANDONED_S:
            raise WaitTimeoutError(f"host {self._spec.host} waited {silent_s:.0f} s for the learner to ask for records")
        if params is not None:
            pool.publish(*params)
        for lane, task in assigned:
            pool.assign(lane, task)


def greet(config: PoolConfig) -> bytes:
    """This machine's `Hello` in msgpack, after it was cleaned of what dead runs have left on it."""
    janitor.clean_dead_instances()
    found = hello.hello(config)
    try:
        hello.check_machine(config)
    except ResourceError as error:
        found = msgspec.structs.replace(found, refusal=str(error))
    return msgspec.msgpack.encode(found)
