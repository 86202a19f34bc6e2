"""The checks of `gvz cluster doctor`: each node as it describes itself, and its ways to the others."""

import os
import socket
import stat
import time
from collections.abc import Generator, Mapping, Sequence
from pathlib import Path

from gvz.cluster.nodes import Node, check_nodes, on_nodes
from gvz.cluster.ray_jobs import JOB_SHM_BYTES
from gvz.cluster.session import Session, connect, parse_address, token_file
from gvz.core.errors import GvzError
from gvz.run import shared_directory
from gvz.run.doctor import Finding
from gvz.run.footprint import format_bytes

PORT_TIMEOUT_S = 5.0
CLOCK_TOLERANCE_S = 1.0
"""more than a call to an idle node takes; records of runs have times of one second"""


def findings(address: str, shared: Path | None, *, public: bool = False) -> Generator[Finding]:
    """What is found, check by check, each over all nodes.

    Args:
        address: HOST:PORT of the head.
        shared: a directory that all nodes are to see.
        public: allow nodes with public addresses.

    Raises:
        ConfigError: the cluster cannot be entered.
    """
    with connect(address, public=public, alike=False) as session:
        nodes = session.nodes
        cores, gpus = (sum(getattr(node, what) for node in nodes) for what in ("cores", "gpus"))
        names = ", ".join(node.name for node in nodes)
        yield Finding("nodes", "ok", f"{len(nodes)} with {cores:g} cores and {gpus:g} GPUs; {names}")
        for node in nodes:
            yield _versions(node)
        for node in nodes:
            yield _memory(node)
        yield from _clocks(nodes)
        yield from _ports(session)
        yield from _security()
        if shared is not None:
            yield from _directory(shared)


def _versions(node: Node) -> Finding:
    try:
        check_nodes([node])
    except GvzError as error:
        return Finding("versions", "bad", str(error))
    return Finding("versions", "ok", f"{node.name}: Python {node.python}, Ray {node.ray}, gvizdoom {node.gvizdoom}")


def _memory(node: Node) -> Finding:
    found = f"{node.name}: {format_bytes(node.shm_free_bytes)} free"
    if node.shm_free_bytes < JOB_SHM_BYTES:
        remedy = "docker run --shm-size=4g, an emptyDir of medium Memory in Kubernetes"
        return Finding("/dev/shm", "bad", f"{found}, want {format_bytes(JOB_SHM_BYTES)} for the smallest run", remedy)
    return Finding("/dev/shm", "ok", found)


def _clocks(nodes: Sequence[Node]) -> Generator[Finding]:
    """Asked once more: by now every node has a worker that waits for work."""
    begin_s = time.time()
    names = {node.id: node.name for node in nodes}
    for answered, theirs_s in on_nodes(clock):
        name = names.get(answered["NodeID"], answered["NodeID"])  # one may have come or left since
        apart_s = max(begin_s - theirs_s, theirs_s - time.time(), 0.0)
        if apart_s > CLOCK_TOLERANCE_S:
            yield Finding("clock", "note", f"{name}: {apart_s:.1f} s apart from here", "run an NTP client on all nodes")
        else:
            yield Finding("clock", "ok", f"{name}: less than {max(apart_s, time.time() - begin_s):.2f} s apart")


def clock() -> float:
    """Unix time of this machine."""
    return time.time()


def _ports(session: Session) -> Generator[Finding]:
    """Every node's way to the head, and to the ports of every other node's daemon."""
    import ray

    wanted = [(*parse_address(session.address), "the head")]
    for node in ray.nodes():
        if node["Alive"]:
            ip = node["NodeManagerAddress"]
            wanted += [(ip, node["NodeManagerPort"], "a node"), (ip, node["ObjectManagerPort"], "a node's objects")]
    for node, closed in on_nodes(closed_ports, wanted):
        name = node["NodeManagerAddress"]
        if closed:
            remedy = "open these between the nodes; ray start takes --node-manager-port and --object-manager-port"
            yield Finding("ports", "bad", f"{name} does not reach {', '.join(closed)}", remedy)
        else:
            yield Finding("ports", "ok", f"{name} reaches all {len(wanted)} of the head and the nodes")


def closed_ports(wanted: Sequence[tuple[str, int, str]]) -> list[str]:
    """Those that this machine gets no connection to, in words."""
    closed = []
    for host, port, what in wanted:
        try:
            socket.create_connection((host, port), timeout=PORT_TIMEOUT_S).close()
        except OSError as error:
            closed.append(f"{host}:{port} ({what}: {error.strerror or error})")
    return closed


def _security() -> Generator[Finding]:
    for node, (problem, statistics) in on_nodes(security):
        name = node["NodeManagerAddress"]
        if problem:
            yield Finding("token", "bad", f"{name}: {problem}")
        else:
            yield Finding("token", "ok", f"{name}: asked for, and private")
        if statistics:
            yield Finding(
                "statistics", "note", f"{name} sends usage statistics", "start it with RAY_USAGE_STATS_ENABLED=0"
            )


def security(environment: Mapping[str, str] = os.environ) -> tuple[str, bool]:
    """(What is wrong with this node's token, in words; whether Ray sends usage statistics)."""
    statistics = environment.get("RAY_USAGE_STATS_ENABLED") != "0"
    if environment.get("RAY_AUTH_MODE", "").lower() != "token":
        return "RAY_AUTH_MODE=token was not in its environment when it started", statistics
    file = token_file(environment)
    if not environment.get("RAY_AUTH_TOKEN") and file.exists() and file.stat().st_mode & (stat.S_IRWXG | stat.S_IRWXO):
        return f"others can read {file}; chmod 600", statistics
    return "", statistics


def _directory(directory: Path) -> Generator[Finding]:
    with shared_directory.mark(directory) as (path, text):
        for node, problem in on_nodes(shared_directory.problem, path, text):
            name = node["NodeManagerAddress"]
            if problem:
                yield Finding("directory", "bad", f"{name} {problem}")
            else:
                yield Finding("directory", "ok", f"{name} sees {directory.resolve()} and our lock in it")
