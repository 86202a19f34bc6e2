"""A cluster of three nodes on this machine. Ray runs in processes of its own, so nothing of it stays in pytest's."""

import json
import os
import secrets
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

FAKE_GAMES = Path(__file__).parents[1] / "actors"
sys.path.append(str(FAKE_GAMES))
SCRIPT = Path(__file__).with_name("three_nodes.py")
QUICK_DEATHS = {
    "RAY_health_check_initial_delay_ms": "1000",
    "RAY_health_check_period_ms": "1000",
    "RAY_health_check_timeout_ms": "1000",
    "RAY_health_check_failure_threshold": "3",
}


class RayCluster:
    """A head without cores for jobs, and other nodes with `num_cores` each.

    Attributes:
        address: HOST:PORT.
        environment: of a command that may use the cluster.
    """

    def __init__(self, num_nodes: int, num_cores: int, **environment: str):
        self._directory = Path(tempfile.mkdtemp(prefix="gr-"))  # Ray's sockets are in it, and their paths must be short
        (self._directory / "ray").mkdir()
        shared = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
        ours = {"RAY_TMPDIR": str(self._directory), "RAY_USAGE_STATS_ENABLED": "0", "RAY_AUTH_MODE": "token"}
        self.environment = {**shared, **ours, "RAY_AUTH_TOKEN": secrets.token_hex(16), **environment}
        self._process = subprocess.Popen(
            [sys.executable, str(SCRIPT), str(num_nodes), str(num_cores)],
            env={**self.environment, **QUICK_DEATHS},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self.address: str = self._answer()["address"]

    def tell(self, command: str) -> int:
        """A command of three_nodes.py; returns the number of nodes."""
        assert self._process.stdin is not None
        self._process.stdin.write(f"{command}\n")
        self._process.stdin.flush()
        return self._answer()["nodes"]

    def kill_node_of(self, process: psutil.Process) -> None:
        """Ends the node that a process runs on, and all that runs there, as a power cut would."""
        (raylet,) = [parent for parent in process.parents() if parent.name() == "raylet"]
        self.tell(f"kill {raylet.pid}")

    def run(self, *arguments: str, timeout_s: float = 240, **environment: str) -> subprocess.CompletedProcess[str]:
        """A command of gvz, on the head's machine."""
        return subprocess.run(
            [sys.executable, "-m", "gvz.cli", *arguments],
            env={**self.environment, **environment},
            capture_output=True,
            text=True,
            timeout=timeout_s,
            check=False,
        )

    def close(self) -> None:
        """Ends it; nothing of it may be left."""
        children = psutil.Process(self._process.pid).children(recursive=True)
        try:
            self._process.communicate(timeout=60)
        finally:
            _, alive = psutil.wait_procs(children, timeout=30)
            for process in alive:
                process.kill()
            self._process.kill()
            shutil.rmtree(self._directory)
        assert not alive

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        assert line, f"the cluster did not start: exit code {self._process.wait(timeout=60)}"
        return json.loads(line)


@pytest.fixture(scope="package")
def cluster() -> Iterator[RayCluster]:
    """Of all tests of this folder together; a test that ends a node adds one. Ray takes processor time as long as it is
    there.
    """
    made = RayCluster(3, num_cores=1)
    yield made
    made.close()
