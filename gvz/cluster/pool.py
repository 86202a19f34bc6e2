"""A pool whose actors are on other machines; the training loop does not notice. It knows nothing of Ray."""

import contextlib
import dataclasses
import time
from typing import Any

import msgspec
from numpy.typing import ArrayLike

from actors.pool import STOP_TIMEOUT_S, LaneState, Pool, PoolConfig, PoolStatistics, lanes_to_begin_with, num_decisions
from gvz.cluster.backend import Backend
from gvz.cluster.config import ClusterConfig
from gvz.cluster.dispatcher import Dispatcher
from gvz.cluster.hello import hello
from gvz.cluster.supervised import SupervisedHost
from gvz.transport.messages import Message, ParamsHeader, StepBlock

_THREAD_S = 10.0
"""longest wait for the dispatcher's thread at the end"""


class ClusterPool(Pool):
    """The `Pool` of actor hosts. A host plays a slice of the run's lanes, which stays its own."""

    def __init__(self, config: PoolConfig, cluster: ClusterConfig, backend: Backend, state: dict[str, Any] | None):
        """Starts the hosts, and waits until they play. The backend is the pool's from now on, if this succeeds.

        Args:
            config: what is played, by `cluster.hosts` hosts with an equal share of the actors.
            cluster: how.
            backend: a cluster that this process is connected to.
            state: what `state()` returned in the run that is resumed.

        Raises:
            ConfigError: the cluster has not the room, or a machine differs from this one.
            ResumeError: `state` is of a pool of another size.
        """
        self._backend, self._env_steps, self._waited_s = backend, 0, 0.0
        self._closed = False
        lanes = lanes_to_begin_with(config, state)
        self._hosts = [_host(index, config, cluster, lanes) for index in range(cluster.hosts)]
        self._dispatcher = Dispatcher(backend, self._hosts, cluster, hello(config))
        self._inbox = self._dispatcher.inbox
        try:
            self._dispatcher.begin(config.actors.start_timeout_s)
            self._dispatcher.start()
        except BaseException:
            self.close(grace_s=0.0)
            raise

    def publish(self, params: ArrayLike, header: ParamsHeader) -> None:
        """As `Pool.publish`; at most every `cluster.publish_period_s` the newest go out. Never waits."""
        self._dispatcher.publish(params, header)

    def assign(self, lane: int, task: int) -> None:
        host = self._hosts[lane // len(self._hosts[0].pool.lanes)]
        with self._inbox.changed:
            host.assign(lane, task)

    def drain(self, max_records: int, wait_s: float = 0.0) -> list[StepBlock]:
        """As `Pool.drain`: in the order in which they came. A batch that was taken whole gives its credit back."""
        start_s, blocks = time.monotonic(), list[StepBlock]()
        with self._inbox.changed:
            if wait_s > 0.0:
                self._inbox.changed.wait_for(lambda: bool(self._inbox.batches), wait_s)
                self._waited_s += time.monotonic() - start_s
            while self._inbox.batches and max_records > 0:
                host, block = self._inbox.batches.popleft()
                taken = StepBlock(block.steps[:max_records], block.frames[:max_records])
                if len(taken) < len(block):
                    rest = StepBlock(block.steps[max_records:], block.frames[max_records:])
                    self._inbox.batches.appendleft((host, rest))
                else:
                    host.waiting_batches -= 1
                max_records -= len(taken)
                self._env_steps += num_decisions(taken.steps)
                blocks.append(taken)
        return blocks

    def poll(self) -> list[Message]:
        """As `Pool.poll`; the watching is the dispatcher's.

        Raises:
            WorkerError: fewer hosts than `cluster.min_hosts` have played for too long; what was said before it came
                with the poll before.
        """
        with self._inbox.changed:
            messages, self._inbox.messages = self._inbox.messages, []
            if not messages and self._inbox.failure is not None:
                raise self._inbox.failure
        return messages

    def state(self) -> dict[str, Any]:
        """As `Pool.state`: lanes go on with new episodes. The same as that of any pool with as many lanes."""
        with self._inbox.changed:
            states = [dataclasses.asdict(host.lanes) for host in self._hosts]
        return {name: [value for state in states for value in state[name]] for name in states[0]}

    def statistics(self) -> PoolStatistics:
        """As `Pool.statistics`; waiting is counted as far as the hosts have told."""
        with self._inbox.changed:
            lives = [host.incarnation for host in self._hosts]
            newest = [life.newest for life in lives if life is not None and life.newest is not None]
            playing = [host for host in self._hosts if host.is_playing]
            counts = self._inbox.counts
            return PoolStatistics(
                env_steps=self._env_steps,
                restarts=sum(host.actor_restarts for host in self._hosts) + sum(h.restarts for h in newest),
                actors_ready=sum(h.actors_ready for h in newest),
                waited_for_space_s=sum(host.waited_for_space_s for host in self._hosts)
                + sum(h.waited_for_space_s for h in newest),
                waited_for_records_s=self._waited_s,
                more={
                    "cluster/hosts": len(playing),
                    "cluster/host_restarts": counts["host_restarts"],
                    "cluster/cut_episodes": counts["cut_episodes"],
                    "cluster/dropped_records": counts["dropped_records"],
                    "cluster/received_bytes": counts["received_bytes"],
                    "cluster/params_age_s": sum(h.params_age_s for h in playing) / max(1, len(playing)),
                },
            )

    def close(self, *, grace_s: float = STOP_TIMEOUT_S) -> None:
        if self._closed:
            return
        self._closed = True
        try:
            self._dispatcher.stop(_THREAD_S)
            self._dispatcher.end_hosts(grace_s)
        finally:
            self._backend.close()


def cluster_pool(config: PoolConfig, cluster: ClusterConfig, state: dict[str, Any] | None) -> ClusterPool:
    """Connects to the Ray cluster and starts the hosts there. In the main thread.

    Raises:
        ConfigError, ResourceError: as `gvz.cluster.session.connect`; the rest as `ClusterPool`.
    """
    from gvz.cluster.session import connect

    assert cluster.address is not None
    session = contextlib.ExitStack()
    try:
        session.enter_context(connect(cluster.address, public=cluster.public))
        from gvz.cluster.ray_hosts import RayBackend

        return ClusterPool(config, cluster, RayBackend(session), state)
    except BaseException:
        session.close()
        raise


def _host(index: int, config: PoolConfig, cluster: ClusterConfig, lanes: LaneState) -> SupervisedHost:
    """A host with its share of the actors and lanes."""
    num_actors = config.num_actors // cluster.hosts
    pool = msgspec.structs.replace(
        config, num_actors=num_actors, first_actor=index * num_actors, run_actors=config.num_actors, cores=()
    )
    own = slice(pool.lanes.start, pool.lanes.stop)
    return SupervisedHost(
        index, pool, LaneState(next_episodes=lanes.next_episodes[own], tasks=lanes.tasks[own]), cluster
    )
