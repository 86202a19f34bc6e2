"""The connection to a Ray cluster. Whatever stands against it is one line, said before anything starts there."""

import atexit
import contextlib
import importlib.util
import json
import logging
import os
import platform
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil

from gvz.cluster.answer import Answer
from gvz.cluster.nodes import Node, check_nodes, survey
from gvz.core.addresses import require_private, resolve
from gvz.core.errors import ConfigError
from gvz.core.libraries import import_path

ANSWER_TIMEOUT_S = 10.0
"""for a connection of TCP to the address"""
PROBE_TIMEOUT_S = 60.0
"""for a process that imports Ray and asks the cluster who it is; a second on an idle core"""
SHUTDOWN_TIMEOUT_S = 20.0
"""for the farewell to a cluster, a second where its head is well"""
NAMESPACE = "gvizdoom"
_OURS = {"RAY_AUTH_MODE": "token", "RAY_USAGE_STATS_ENABLED": "0"}
"""environment of this process, set before it imports Ray, which reads it once"""
_PRIVATE = (
    "start Ray on a private network (--node-ip-address=10...), or allow it if a firewall stands before it "
    "(docs/CLUSTER.md, Safety): whoever reaches Ray can run code"
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Session:
    """An open connection."""

    address: str
    """IP:PORT of the head, [IP]:PORT of IPv6"""
    nodes: tuple[Node, ...]
    """those that were alive when it opened, the head first"""


@contextlib.contextmanager
def connect(address: str, *, shm_bytes: int = 0, public: bool = False, alike: bool = True) -> Generator[Session]:
    """Connects this process to a Ray cluster; the end of the block ends our tasks and actors there, and disconnects.
    For the main thread.

    Sets Ray's environment variables for this process: authentication by token, no usage statistics.

    Args:
        address: HOST:PORT of the head.
        shm_bytes: what each node must have free in /dev/shm.
        public: allow nodes whose addresses the whole Internet can reach.
        alike: refuse nodes that differ from this machine in a version.

    Raises:
        ConfigError: no Ray here, an address that is malformed, public or silent, a cluster that lets everybody in, no
            token or a wrong one, a machine that is no node, versions that differ.
        ResourceError: a node has too little shared memory.
    """
    host, port = parse_address(address)
    if importlib.util.find_spec("ray") is None:
        raise ConfigError(f"cluster {address}: Ray is not installed; pip install 'gvizdoom[cluster]'")
    found = resolve(host, f"cluster {address}")
    ip = next((ip for ip in found if ":" not in ip), found[0])  # Ray listens at IPv4 unless it is told otherwise
    if not public:
        require_private(ip, f"cluster {address}", _PRIVATE)
    require_token(os.environ)
    _require_answer(address, ip, port)
    os.environ.update(_OURS)
    where = f"[{ip}]:{port}" if ":" in ip else f"{ip}:{port}"
    _check_cluster(address, _probe(address, where, "token"), _probe(address, where, "disabled"))
    import ray

    ours = signal.getsignal(signal.SIGTERM)
    try:
        ray.init(where, namespace=NAMESPACE, log_to_driver=False, logging_level=logging.CRITICAL)
        signal.signal(signal.SIGTERM, ours)  # Ray's handler would end a command at once, with exit code 15
    except Exception as error:  # Ray's have no common class
        ray.shutdown()
        raise ConfigError(f"cluster {address}: Ray cannot connect: {_first_line(error)}") from error
    try:
        nodes = survey()
        for node in () if public else nodes:
            require_private(node.ip, f"cluster {address}: node {node.name}", _PRIVATE)
        if alike:
            check_nodes(nodes, shm_bytes=shm_bytes)
        yield Session(address=where, nodes=nodes)
    finally:
        _disconnect()


def _disconnect() -> None:
    """Ends Ray's part of this process. Where the head hangs, Ray waits for it without end."""
    import ray

    farewell = Answer(ray.shutdown)
    try:
        with contextlib.suppress(TimeoutError):
            farewell.result(SHUTDOWN_TIMEOUT_S)
    finally:
        if farewell.is_alive():
            atexit.unregister(ray.shutdown)


def parse_address(address: str) -> tuple[str, int]:
    """Host and port.

    Raises:
        ConfigError: it is not HOST:PORT; Ray's client (`ray://`) is refused.
    """
    if "://" in address:
        raise ConfigError(
            f"cluster {address}: want HOST:PORT of the head, without a scheme; Ray's client (ray://) is not enough: "
            "give the command on a node of the cluster"
        )
    host, _, port = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    if not host or not re.fullmatch(r"[0-9]{1,5}", port) or not 0 < int(port) < 2**16:
        raise ConfigError(f"cluster {address!r}: want HOST:PORT, such as 10.0.0.1:6379; `ray start --head` prints it")
    return host, int(port)


def require_token(environment: Mapping[str, str]) -> None:
    """Raises ConfigError if Ray would not use a token, or finds none."""
    if (mode := environment.get("RAY_AUTH_MODE", "token").lower()) != "token":
        raise ConfigError(f"RAY_AUTH_MODE={mode}: want token, here and on every node of the cluster")
    file = token_file(environment)
    if environment.get("RAY_AUTH_TOKEN") or (file.is_file() and file.stat().st_size):
        return
    raise ConfigError(
        f"no token of the cluster in RAY_AUTH_TOKEN, nor in {file}; copy the head's ~/.ray/auth_token to every node "
        "(`ray get-auth-token --generate` makes it)"
    )


def token_file(environment: Mapping[str, str]) -> Path:
    """Where Ray looks for the token if RAY_AUTH_TOKEN is not set."""
    return Path(environment.get("RAY_AUTH_TOKEN_PATH") or Path.home() / ".ray" / "auth_token")


def _require_answer(address: str, ip: str, port: int) -> None:
    try:
        socket.create_connection((ip, port), timeout=ANSWER_TIMEOUT_S).close()
    except OSError as error:
        raise ConfigError(
            f"cluster {address}: nothing answers there ({error.strerror or error}); is the head running? "
            f"RAY_AUTH_MODE=token ray start --head --port={port}"
        ) from error


def _probe(address: str, where: str, mode: str) -> dict[str, Any]:
    """What the cluster says of itself to a client with this mode of authentication (gvz/cluster/probe.py)."""
    command = [sys.executable, "-P", "-m", "gvz.cluster.probe", where]
    environment = {**os.environ, "RAY_AUTH_MODE": mode, "PYTHONPATH": import_path()}
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=PROBE_TIMEOUT_S, env=environment, check=True
        )
    except subprocess.SubprocessError as error:
        raise ConfigError(
            f"cluster {address}: it does not answer as the head of a Ray cluster does; want the port of "
            "`ray start --head` (6379), not that of a dashboard or a client"
        ) from error
    return json.loads(done.stdout.splitlines()[-1])


def _check_cluster(address: str, known: Mapping[str, Any], to_everybody: Mapping[str, Any]) -> None:
    """Raises ConfigError unless the cluster takes our token, asks for one, has our versions, and this is its node."""
    if "refused" in known:
        raise ConfigError(f"cluster {address}: it refuses our token; copy the head's ~/.ray/auth_token to this machine")
    if "refused" not in to_everybody:
        raise ConfigError(
            f"cluster {address}: it lets everybody run code, without a token; stop it, and start every node with "
            "RAY_AUTH_MODE=token (docs/CLUSTER.md)"
        )
    for what, mine in (("ray", version("ray")), ("python", platform.python_version())):
        if (theirs := known[what]) != mine:
            raise ConfigError(
                f"cluster {address}: got {what} {theirs}, want {mine} as here; use one image on all nodes"
            )
    here = {found.address for interface in psutil.net_if_addrs().values() for found in interface}
    if not here & set(known["nodes"]):
        raise ConfigError(
            f"cluster {address}: this machine is no node of it; first `ray start --address={address} --num-cpus=0` here"
        )


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]
