"""`gvz cluster doctor` on a cluster of three nodes, and what it finds where something is wrong."""

import json
import socket
import time

import pytest

from gvz.cluster import checkup
from gvz.cluster.checkup import closed_ports, security
from gvz.cluster.nodes import Node
from gvz.cluster.ray_jobs import JOB_SHM_BYTES
from gvz.run import shared_directory


@pytest.mark.e2e
def test_every_node_is_checked(cluster, tmp_path):
    done = cluster.run("cluster", "doctor", cluster.address, "--shared", str(tmp_path), "--json")
    assert (done.returncode, done.stderr) == (0, "")
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert {row["state"] for row in rows} <= {"ok", "note"}  # clocks may jump on a machine that was asleep
    names = [row["name"] for row in rows]
    of_each = ("versions", "/dev/shm", "clock", "ports", "token", "directory")
    assert {name: names.count(name) for name in of_each} == dict.fromkeys(of_each, 3)
    assert rows[0]["found"].startswith("3 with 2 cores and 0 GPUs; ")
    assert "reaches all 7 of the head and the nodes" in rows[names.index("ports")]["found"]
    assert list(tmp_path.iterdir()) == []
    here = cluster.run("cluster", "doctor", cluster.address, "--shared", "/dev/null")
    assert (here.returncode, here.stdout) == (2, "")
    assert "/dev/null is no directory that you can write to" in here.stderr


def test_a_cluster_that_cannot_be_entered_is_one_line(refusal, monkeypatch):
    monkeypatch.setenv("RAY_AUTH_TOKEN", "0" * 32)
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)
    said = refusal("cluster", "doctor", "ray://10.0.0.1:10001")
    assert said.startswith("error: cluster ray://10.0.0.1:10001: want HOST:PORT")


def test_a_clock_that_is_ahead_or_behind_is_noted(monkeypatch):
    apart_s = {"same": 0.0, "ahead": 60.0, "behind": -60.0}
    answers = [({"NodeID": name}, time.time() + seconds) for name, seconds in apart_s.items()]
    monkeypatch.setattr(checkup, "on_nodes", lambda _: answers)
    found = {one.found.partition(":")[0]: one.state for one in checkup._clocks([])}
    assert found == {"same": "ok", "ahead": "note", "behind": "note"}


def test_closed_ports_are_named():
    with socket.create_server(("127.0.0.1", 0)) as open_port, socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        wanted = [("127.0.0.1", s.getsockname()[1], what) for s, what in ((open_port, "open"), (closed, "a node"))]
        (found,) = closed_ports(wanted)
    assert found == f"127.0.0.1:{wanted[1][1]} (a node: Connection refused)"


def test_a_node_with_too_little_shared_memory_is_bad():
    here = {"host": "n1", "ip": "10.0.0.1", "cores": 1.0, "gpus": 0.0, "python": "3", "ray": "2", "gvizdoom": "0"}
    nodes = [Node(id="1", shm_free_bytes=JOB_SHM_BYTES - lacking, **here) for lacking in (0, 1)]
    assert [checkup._memory(node).state for node in nodes] == ["ok", "bad"]


def test_tokens_that_are_not_asked_for_or_not_private_are_found(tmp_path):
    file = tmp_path / "token"
    file.write_text("0" * 32)
    file.chmod(0o644)
    here = {"RAY_AUTH_TOKEN_PATH": str(file), "RAY_USAGE_STATS_ENABLED": "0"}
    assert security(here) == ("RAY_AUTH_MODE=token was not in its environment when it started", False)
    assert security({**here, "RAY_AUTH_MODE": "token"}) == (f"others can read {file}; chmod 600", False)
    file.chmod(0o600)
    assert security({**here, "RAY_AUTH_MODE": "token"}) == ("", False)
    assert security({"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": "0" * 32}) == ("", True)


def test_the_problem_of_a_directory_begins_like_a_sentence_about_a_node():
    assert shared_directory.problem("/nowhere/file", "").startswith("does not see the files of /nowhere")
