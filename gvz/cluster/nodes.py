"""The machines of a cluster as each describes itself, and what a run of ours asks of them. Ray carries the question."""

import hashlib
import platform
import shutil
import socket
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gvz
from gvz.core import janitor
from gvz.core.errors import ConfigError, ResourceError
from gvz.run.machine import OWN_PACKAGES

SURVEY_TIMEOUT_S = 120.0
"""for the first worker process of each node; some seconds on an idle machine"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Node:
    """A node of a cluster."""

    id: str
    """Ray's, hexadecimal"""
    host: str
    ip: str
    cores: float
    """that Ray may give away"""
    gpus: float
    python: str
    ray: str
    gvizdoom: str
    """version, and a digest of the source: versions stay the same between two commits"""
    shm_free_bytes: int
    """in /dev/shm"""

    @property
    def name(self) -> str:
        """For messages: two nodes can share a machine in tests."""
        return f"{self.host} ({self.ip}, {self.id[:6]})"


def describe() -> dict[str, Any]:
    """What a machine says of itself: the fields of `Node` that Ray does not know."""
    import ray

    return {
        "host": socket.gethostname(),
        "python": platform.python_version(),
        "ray": ray.__version__,
        "gvizdoom": f"{gvz.__version__}, source {source_digest()}",
        "shm_free_bytes": shutil.disk_usage(janitor.SHM_DIR).free,
    }


def source_digest() -> str:
    """Of all Python files of our packages: the beginning of a SHA-256, hexadecimal."""
    found = hashlib.sha256()
    root = Path(gvz.__file__).parent.parent
    for file in sorted(file for package in OWN_PACKAGES for file in (root / package).rglob("*.py")):
        found.update(f"{file.relative_to(root)}\0".encode() + file.read_bytes())
    return found.hexdigest()[:8]


def on_nodes(function: Any, *arguments: Any) -> list[tuple[dict[str, Any], Any]]:
    """Calls a function of ours on every node that is alive, on no core: pairs of Ray's description and the answer.

    Raises:
        ConfigError: a node cannot import our packages, or does not answer.
    """
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    remote = ray.remote(num_cpus=0, max_retries=0)(function)
    alive = sorted(
        (node for node in ray.nodes() if node["Alive"]),
        key=lambda node: "node:__internal_head__" not in node["Resources"],
    )
    calls = []
    for node in alive:
        here = NodeAffinitySchedulingStrategy(node_id=node["NodeID"], soft=False)
        calls.append(remote.options(scheduling_strategy=here).remote(*arguments))
    answers = []
    for node, call in zip(alive, calls, strict=True):
        try:
            answers.append((node, ray.get(call, timeout=SURVEY_TIMEOUT_S)))
        except Exception as error:  # Ray's, or what the function raised there
            where = f"node {node['NodeName']} ({node['NodeManagerAddress']})"
            if "No module named" in str(error):
                raise ConfigError(
                    f"{where}: it cannot import our packages; install the same gvizdoom on every node"
                ) from error
            raise ConfigError(
                f"{where}: {type(error).__name__} instead of an answer within {SURVEY_TIMEOUT_S:.0f} s"
            ) from error
    return answers


def survey() -> tuple[Node, ...]:
    """Every node that is alive, the head first.

    Raises:
        ConfigError: a node cannot import our packages, or does not answer.
    """
    found = []
    for node, said in on_nodes(describe):
        shares = node["Resources"]
        found.append(
            Node(
                id=node["NodeID"],
                ip=node["NodeManagerAddress"],
                cores=shares.get("CPU", 0.0),
                gpus=shares.get("GPU", 0.0),
                **said,
            )
        )
    return tuple(found)


def check_nodes(nodes: Sequence[Node], *, shm_bytes: int = 0) -> None:
    """Compares every node with this machine.

    Args:
        nodes: of the cluster.
        shm_bytes: what each must have free in /dev/shm.

    Raises:
        ConfigError: another version of Python, Ray or gvizdoom.
        ResourceError: too little shared memory.
    """
    mine = describe()
    for node in nodes:
        for what in ("python", "ray", "gvizdoom"):
            if (theirs := getattr(node, what)) != mine[what]:
                raise ConfigError(
                    f"node {node.name}: got {what} {theirs}, want {mine[what]} as here; use one image on all nodes"
                )
        if node.shm_free_bytes < shm_bytes:
            raise ResourceError(
                f"node {node.name}: {node.shm_free_bytes / 1e6:.0f} MB free in /dev/shm, want {shm_bytes / 1e6:.0f}; "
                "give its container more: docker run --shm-size, an emptyDir of medium Memory in Kubernetes"
            )
