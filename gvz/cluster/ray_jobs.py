"""Jobs of experiments on the nodes of a Ray cluster: an actor round the process of each command."""

import math
import socket
import time
from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gvz.cluster.answer import Answer
from gvz.cluster.job_host import JobHost
from gvz.cluster.nodes import on_nodes
from gvz.cluster.session import connect, parse_address
from gvz.core.errors import ConfigError, GvzError
from gvz.experiments.jobs import Command
from gvz.experiments.places import memory_share
from gvz.experiments.process import LOST, TAKEN, Process
from gvz.run import shared_directory
from gvz.run.footprint import ENGINE_SHM_BYTES

NODES_PERIOD_S = 2.0
"""between two looks at which nodes are alive"""
NODES_TIMEOUT_S = 600.0
"""how long to wait for a node that a job fits on, when all those are gone"""
HEAD_TIMEOUT_S = 20.0
"""a head that takes no connection for this time is gone"""
ANSWER_S = 5.0
"""longest wait for the head before signals are looked at again"""
SILENT_TIMEOUT_S = 60.0
"""a head or a node that answers nothing for this time is lost: Ray never reports a machine that was only stopped"""
KILL_TIMEOUT_S = 10.0
JOB_SHM_BYTES = 4 * ENGINE_SHM_BYTES
"""in /dev/shm, for the games of the smallest job; every job looks itself whether its own fit"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Share:
    """What a job gets of a node."""

    cores: int = 2
    gpus: float = 0.0
    """while it trains: a part of one GPU, or whole ones. An evaluation uses none"""

    def __post_init__(self) -> None:
        if self.cores < 1:
            raise ConfigError(f"--job-cores: got {self.cores}, want at least 1")
        if self.gpus < 0 or (self.gpus > 1 and self.gpus % 1):
            raise ConfigError(f"--job-gpus: got {self.gpus:g}, want a part of one (0.5), or whole ones")

    def fits(self, cores: float, gpus: float, step: str | None) -> int:
        """How many such jobs a node with these cores and GPUs takes."""
        by_cores = math.floor(cores / self.cores)
        if not self.gpus or step != "train":
            return by_cores
        return min(
            by_cores, math.floor(gpus) * math.floor(1 / self.gpus) if self.gpus < 1 else math.floor(gpus / self.gpus)
        )


@contextmanager
def open_places(
    address: str, results: Path, cores: int, gpus: float | None, limit: int | None, *, public: bool = False
) -> Generator["ClusterPlaces"]:
    """Connects to a cluster for experiments.

    Args:
        address: HOST:PORT of its head.
        results: the results directory, absolute; made if it is not there.
        cores: of a job.
        gpus: likewise, while it trains; None: one if a node has any.
        limit: most jobs at once; None: as many as fit.
        public: allow nodes with public addresses.

    Raises:
        GvzError: what `connect` and `ClusterPlaces` raise, or a node does not see the results directory.
    """
    share = Share(cores=cores, gpus=gpus or 0.0)
    with connect(address, shm_bytes=JOB_SHM_BYTES, public=public) as session:
        results.mkdir(parents=True, exist_ok=True)
        with shared_directory.mark(results) as (path, text):
            for node, problem in on_nodes(shared_directory.problem, path, text):
                if problem and node["Resources"].get("CPU"):
                    raise ConfigError(f"--results: node {node['NodeName']} {problem}")
        if gpus is None and any(node.gpus for node in session.nodes):
            share = Share(cores=cores, gpus=1.0)
        yield ClusterPlaces(session.address, share, limit)


class RemoteProcess:
    """A command at work on a node, or waiting for one."""

    def __init__(self, log: Path, command: Command, share: Share):
        import ray

        self._gpus = share.gpus if command.step == "train" else 0.0
        # without a share of a GPU, Ray hides none
        environment = memory_share(1 / self._gpus) if self._gpus else {"CUDA_VISIBLE_DEVICES": ""}
        remote: Any = ray.remote(num_cpus=share.cores, num_gpus=self._gpus, max_restarts=0)(JobHost)
        self.step = command.step
        self.where: str = "a node that is to be found"
        self._actor = remote.remote()
        self._call = self._actor.start.remote(str(log), command.arguments, share.cores, environment)
        self._asked_s = time.monotonic()
        self._started = False
        self._code: int | None = None
        self.problem = ""

    def poll(self) -> int | None:
        """Exit code, TAKEN, LOST; None while it runs or waits for a node. Never waits itself."""
        import ray
        from ray.exceptions import RayTaskError

        if self._code is not None:
            return self._code
        if not ray.wait([self._call], timeout=0)[0]:
            if self._started and time.monotonic() - self._asked_s > SILENT_TIMEOUT_S:
                self._end(LOST)
            return self._code
        try:
            answer: Any = ray.get(self._call)
        except RayTaskError as error:  # the node is alive, and the job cannot run there
            self.problem = str(error).strip().splitlines()[-1]
            self._end(1)
            return self._code
        except Exception:  # Ray's errors have no common class; whatever it is, the node has not kept the job
            self._end(LOST)
            return self._code
        if not self._started and answer is None:
            self._end(TAKEN)
        elif not self._started:
            self._started, self.where = True, str(answer)
        elif answer is not None:
            self._end(answer)
        if self._code is None:
            self._call, self._asked_s = self._actor.poll.remote(), time.monotonic()
        return self._code

    def stop(self) -> None:
        """Asks the command to save what it has and to end; one that still waits for a node ends."""
        if self._code is None and not self._started:
            self._end(128 + 2)
        elif self._code is None:
            self._actor.stop.remote()

    def kill(self) -> None:
        import ray

        if self._code is None:
            if self._started:
                with suppress(Exception):  # a node that is gone runs nothing
                    ray.get(self._actor.kill.remote(), timeout=KILL_TIMEOUT_S)
            self._end(128 + 9)

    def _end(self, code: int) -> None:
        """Gives the share back to Ray. A command that still runs there is asked to save itself by the kernel."""
        import ray

        self._code = code
        with suppress(Exception):  # the actor may be gone already
            ray.kill(self._actor)


class ClusterPlaces:
    """The nodes of the cluster that this process is connected to."""

    _asking: Answer | None = None
    settle_s = 90.0
    """NFS keeps what it knows of a directory for up to 60 s"""

    def __init__(self, address: str, share: Share, limit: int | None = None):
        """At most `limit` jobs at once; None: as many as the nodes take.

        Raises:
            ConfigError: no node takes a job, or fewer than one is allowed.
        """
        if limit is not None and limit < 1:
            raise ConfigError(f"--jobs: got {limit}, want at least 1")
        self._address, self._share, self._limit = address, share, limit
        self._used: list[RemoteProcess] = []
        self._looked_s = self._fitted_s = -math.inf
        self._answered_s = time.monotonic()
        self._nodes: list[tuple[float, float]] = []
        self._look(SILENT_TIMEOUT_S)
        if not self._capacity("train"):
            raise ConfigError(
                f"cluster {address}: no node has {share.cores} cores and {share.gpus:g} GPUs for a job; "
                "lower --job-cores or --job-gpus, or start nodes that have them"
            )

    def room(self, step: str | None = None) -> bool:
        """Whether a command of this step (of any, if None) can start now.

        Raises:
            GvzError: the head is gone, or all nodes that a job fits on.
        """
        if time.monotonic() - self._looked_s > NODES_PERIOD_S:
            self._look()
        same = [used for used in self._used if step != "train" or used.step == step]
        open_to_all = self._limit is None or len(self._used) < self._limit
        return open_to_all and len(same) < self._capacity(step) and len(self._used) < self._capacity(None)

    def start(self, log: Path, command: Command) -> RemoteProcess:
        """An actor for the command; Ray chooses its node."""
        process = RemoteProcess(log, command, self._share)
        self._used.append(process)
        return process

    def end(self, process: Process) -> None:
        self._used = [used for used in self._used if used != process]

    def _capacity(self, step: str | None) -> int:
        return sum(self._share.fits(cores, gpus, step) for cores, gpus in self._nodes)

    def _look(self, wait_s: float = ANSWER_S) -> None:
        """Which nodes are alive."""
        self._looked_s = now_s = time.monotonic()
        asking = self._asking = self._asking or Answer(lambda: _nodes(self._address))
        try:
            nodes = asking.result(wait_s)
        except OSError as error:
            if now_s - self._answered_s > (SILENT_TIMEOUT_S if asking.is_alive() else HEAD_TIMEOUT_S):
                raise GvzError(
                    f"cluster {self._address}: its head is gone; the jobs save themselves and end. Start the cluster, "
                    "and give the same command again"
                ) from error
            self._nodes = []  # nothing begins before it answers again: Ray would wait for it
            return
        finally:
            self._asking = asking if asking.is_alive() else None
        self._answered_s = now_s
        shares = [node["Resources"] for node in nodes if node["Alive"]]
        self._nodes = [(share.get("CPU", 0.0), share.get("GPU", 0.0)) for share in shares]
        if self._capacity("train") or self._fitted_s == -math.inf:
            self._fitted_s = now_s
        elif now_s - self._fitted_s > NODES_TIMEOUT_S:
            raise GvzError(
                f"cluster {self._address}: no node that a job fits on for {NODES_TIMEOUT_S:.0f} s; start nodes, "
                "and give the same command again"
            )


def _nodes(address: str) -> list[dict[str, Any]]:
    """Ray's description of its nodes. Raises OSError: the head is gone, which is looked at first: Ray would end this
    process.
    """
    socket.create_connection(parse_address(address), timeout=HEAD_TIMEOUT_S).close()
    import ray

    return ray.nodes()
