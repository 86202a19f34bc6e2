"""Ray as the `Backend` of actor hosts. The only file of actor hosts that imports ray."""

import contextlib
from collections.abc import Callable, Generator, Sequence
from typing import Any

import numpy as np
import ray
from ray.exceptions import RayTaskError
from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

from actors.pool import PoolConfig
from gvz.cluster import host
from gvz.cluster.answer import Answer
from gvz.cluster.backend import Call, HostError, Machine
from gvz.cluster.host import Host, HostSpec
from gvz.core import janitor
from gvz.transport.messages import ParamsHeader

_RESULT_TIMEOUT_S = 10.0
"""for an answer that has come; it is in this machine's memory"""
_HEAD_TIMEOUT_S = 10.0
"""for an answer of the head; the hosts are asked for nothing meanwhile"""


class RemoteHost:
    """What runs on a machine: a `Host`, each kind of call in a thread of its own, so that none overtakes its like."""

    def __init__(self) -> None:
        self._host: Host | None = None

    @ray.method(concurrency_group="control")
    def greet(self, config: PoolConfig) -> bytes:
        return host.greet(config)

    @ray.method(concurrency_group="control")
    def begin(self, spec: HostSpec) -> None:
        self._host = Host(spec)

    @ray.method(concurrency_group="records")
    def next_batch(self, assigned: Sequence[tuple[int, int]]) -> bytes:
        return self._begun.next_batch(assigned)

    @ray.method(concurrency_group="params")
    def set_params(self, params: np.ndarray, header: ParamsHeader) -> None:
        self._begun.set_params(params, header)

    @ray.method(concurrency_group="control")
    def close(self, timeout_s: float) -> bool:
        return self._host is None or self._host.close(timeout_s)

    @property
    def _begun(self) -> Host:
        assert self._host is not None, "begin comes first"
        return self._host


@contextlib.contextmanager
def _as_host_error() -> Generator[None]:
    """Whatever Ray raises is the fault of a host, of its node or of the network."""
    try:
        yield
    except RayTaskError as error:
        raise HostError(f"{type(error.cause).__name__}: {error.cause}") from error
    except Exception as error:  # Ray's errors have no common class
        raise HostError(f"{type(error).__name__}: {error}") from error


class RayRemote:
    """`gvz.cluster.backend.Remote`: a Ray actor. Ray does not restart it: it would begin with its first episodes."""

    def __init__(self, machine: str, cpus: int):
        threads: Any = {"concurrency_groups": {"control": 1, "records": 1, "params": 1}}
        kind = ray.remote(**threads)(RemoteHost)
        place = NodeAffinitySchedulingStrategy(node_id=machine, soft=False)
        self._actor: Any = kind.options(num_cpus=cpus, max_restarts=0, scheduling_strategy=place).remote()

    def greet(self, config: PoolConfig) -> Call:
        with _as_host_error():
            return self._actor.greet.remote(config)

    def begin(self, spec: HostSpec) -> Call:
        with _as_host_error():
            return self._actor.begin.remote(spec)

    def next_batch(self, assigned: Sequence[tuple[int, int]]) -> Call:
        with _as_host_error():
            return self._actor.next_batch.remote(assigned)

    def set_params(self, params: Any, header: ParamsHeader) -> Call:
        with _as_host_error():
            return self._actor.set_params.remote(params, header)

    def close(self, timeout_s: float) -> Call:
        with _as_host_error():
            return self._actor.close.remote(timeout_s)

    def kill(self) -> None:
        with contextlib.suppress(HostError), _as_host_error():
            ray.kill(self._actor)


class RayBackend:
    """`gvz.cluster.backend.Backend`; `session` is the open connection, which it ends."""

    def __init__(self, session: contextlib.ExitStack):
        self._session = session
        self._learner = ray.get_runtime_context().get_node_id()
        self._asking: Answer | None = None

    def machines(self) -> list[Machine]:
        with _as_host_error():
            return [
                Machine(
                    id=node["NodeID"],
                    name=f"{node['NodeName']} ({node['NodeID'][:6]})",
                    cpus=int(node["Resources"].get("CPU", 0)),
                    has_learner=node["NodeID"] == self._learner,
                )
                for node in self._of_head(ray.nodes)
                if node["Alive"]
            ]

    def start(self, machine: str, cpus: int) -> RayRemote:
        with _as_host_error():
            return RayRemote(machine, cpus)

    def put(self, params: np.ndarray) -> Any:
        with _as_host_error():
            return ray.put(params)

    def wait(self, calls: Sequence[Call], timeout_s: float) -> list[Call]:
        with _as_host_error():
            return ray.wait(list(calls), num_returns=len(calls), timeout=timeout_s)[0]

    def result(self, call: Call) -> Any:
        with _as_host_error():
            return ray.get(call, timeout=_RESULT_TIMEOUT_S)

    def clean(self, machine: str) -> Call:
        place = NodeAffinitySchedulingStrategy(node_id=machine, soft=False)
        task = ray.remote(janitor.clean_dead_instances).options(num_cpus=0, scheduling_strategy=place)
        with _as_host_error():
            return self._of_head(task.remote)

    def close(self) -> None:
        self._session.close()

    def _of_head(self, call: Callable[[], Any]) -> Any:
        """What a call returns that the head has to answer. A head that hangs is waited for once."""
        if self._asking is not None and self._asking.is_alive():
            raise TimeoutError("the cluster's head does not answer")
        self._asking = Answer(call)
        return self._asking.result(_HEAD_TIMEOUT_S)
