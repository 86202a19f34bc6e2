"""Connecting to a Ray cluster: what stands against it is one line, with exit code 2, and soon."""

import os
import signal
import socket
import subprocess
import sys
import threading
from importlib.machinery import ModuleSpec
from types import ModuleType, SimpleNamespace

import pytest

from gvz.cluster import nodes, session
from gvz.cluster.nodes import Node, check_nodes, describe
from gvz.core import addresses, stop
from gvz.core.errors import ConfigError, ResourceError
from tests.cluster.conftest import RayCluster

CONNECT = """
import sys
from gvz.cluster.session import connect
from gvz.core.errors import GvzError
try:
    with connect(sys.argv[1], shm_bytes=int(sys.argv[2])) as found:
        print(len(found.nodes), found.nodes[0].cores, len({node.gvizdoom for node in found.nodes}))
except GvzError as error:
    print(error)
    sys.exit(error.exit_code)
"""


@pytest.fixture
def token(monkeypatch):
    monkeypatch.setenv("RAY_AUTH_TOKEN", "0" * 32)
    monkeypatch.delenv("RAY_AUTH_MODE", raising=False)


def connect(cluster: RayCluster, address: str = "", shm_bytes: int = 0, **environment: str):
    """In a process of its own: Ray can be entered once with one token."""
    return subprocess.run(
        [sys.executable, "-c", CONNECT, address or cluster.address, str(shm_bytes)],
        env={**cluster.environment, **environment},
        capture_output=True,
        text=True,
        timeout=200,
        check=False,
    )


def refusal(address: str) -> str:
    with pytest.raises(ConfigError) as caught, session.connect(address):
        pass
    assert caught.value.exit_code == 2
    return str(caught.value)


@pytest.mark.parametrize(
    ("address", "said"),
    [
        *((a, f"cluster {a!r}: want HOST:PORT") for a in ("10.0.0.1", "10.0.0.1:", ":6379", "10.0.0.1:0", "auto", "")),
        ("10.0.0.1:70000", "cluster '10.0.0.1:70000': want HOST:PORT"),
        ("ray://10.0.0.1:10001", "ray://"),
        ("nowhere.invalid:6379", "no machine has the name 'nowhere.invalid'"),
        ("8.8.8.8:6379", "8.8.8.8 is a public address"),
    ],
)
@pytest.mark.usefixtures("token")
def test_an_address_that_is_none_of_a_private_head_is_refused_before_anything_is_sent_there(address, said):
    assert said in refusal(address)


@pytest.mark.parametrize(("address", "parts"), [("h:1", ("h", 1)), ("[fd00::1]:6379", ("fd00::1", 6379))])
def test_an_address_has_two_parts(address, parts):
    assert session.parse_address(address) == parts


@pytest.mark.parametrize("address", ["10.0.0.1:6379", "[fd00::1]:6379"])
@pytest.mark.usefixtures("token")
def test_ray_gets_an_address_that_it_can_read_and_leaves_sigterm_to_the_command(address, monkeypatch):
    """As Ray 2.60: its `init` takes SIGTERM, and its parser wants brackets round an address of IPv6."""
    ray, got, ours = ModuleType("ray"), [], signal.getsignal(signal.SIGTERM)

    def init(where: str, **_) -> None:
        got.append(where)
        signal.signal(signal.SIGTERM, lambda number, _: sys.exit(number))

    vars(ray).update(__spec__=ModuleSpec("ray", None), init=init, shutdown=lambda: None)
    monkeypatch.setitem(sys.modules, "ray", ray)
    for name, value in session._OURS.items():
        monkeypatch.setenv(name, value)
    for name in ("_require_answer", "_probe", "_check_cluster"):
        monkeypatch.setattr(session, name, lambda *_: None)
    monkeypatch.setattr(session, "survey", lambda: ())
    try:
        with session.connect(address, alike=False) as found:
            assert signal.getsignal(signal.SIGTERM) == ours
        assert [found.address] == got == [address]
    finally:
        signal.signal(signal.SIGTERM, ours)


def test_a_cluster_is_left_although_its_head_does_not_answer(monkeypatch):
    """Ray's own farewell waits without end, also at the end of the process."""
    answers, ray = threading.Event(), ModuleType("ray")
    vars(ray).update(shutdown=answers.wait)
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setattr(session, "SHUTDOWN_TIMEOUT_S", 0.1)
    monkeypatch.setattr(stop, "stuck", set())
    session._disconnect()
    (ending,) = stop.stuck
    assert ending.is_alive()
    answers.set()
    ending.join(10.0)
    session._disconnect()
    assert stop.stuck == {ending}


@pytest.mark.usefixtures("token")
def test_of_a_name_with_addresses_of_both_kinds_that_of_ipv4_is_used(monkeypatch):
    """As `localhost` in many containers, where Ray is not at ::1."""
    found = [(None, None, 6, "", (ip, 0)) for ip in ("::1", "8.8.8.8")]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
    assert "8.8.8.8 is a public address" in refusal("both:6379")


@pytest.mark.parametrize("ip", ["127.0.0.1", "10.1.2.3", "192.168.0.7", "172.20.0.2", "100.64.1.1", "fd00::1"])
def test_private_addresses_are_allowed(ip):
    addresses.require_private(ip, "here", "")


@pytest.mark.parametrize("ip", ["0.0.0.0", "::"])
def test_all_addresses_of_a_machine_are_refused_because_public_ones_are_among_them(ip):
    with pytest.raises(ConfigError, match=rf"^here: {ip} stands for all addresses of a machine, public ones too; so$"):
        addresses.require_private(ip, "here", "so")


@pytest.mark.usefixtures("token")
def test_an_address_without_a_listener_is_refused():
    with socket.socket() as reserved:
        reserved.bind(("127.0.0.1", 0))
        assert "nothing answers there" in refusal(f"127.0.0.1:{reserved.getsockname()[1]}")


@pytest.mark.usefixtures("token")
def test_a_listener_that_is_not_ray_is_refused(monkeypatch):
    monkeypatch.setattr(session, "PROBE_TIMEOUT_S", 5.0)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        assert "does not answer as the head of a Ray cluster" in refusal(f"127.0.0.1:{silent.getsockname()[1]}")


def test_no_token_is_refused(monkeypatch, tmp_path):
    monkeypatch.delenv("RAY_AUTH_TOKEN", raising=False)
    monkeypatch.setenv("RAY_AUTH_TOKEN_PATH", str(tmp_path / "token"))
    monkeypatch.setenv("RAY_AUTH_MODE", "token")
    assert f"no token of the cluster in RAY_AUTH_TOKEN, nor in {tmp_path / 'token'}" in refusal("127.0.0.1:6379")
    (tmp_path / "token").write_text("0" * 32)
    session.require_token(os.environ)


@pytest.mark.usefixtures("token")
def test_a_session_without_authentication_is_refused(monkeypatch):
    monkeypatch.setenv("RAY_AUTH_MODE", "disabled")
    assert "RAY_AUTH_MODE=disabled: want token" in refusal("127.0.0.1:6379")


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)  # as importlib finds it where it is not installed
    want = "cluster 127.0.0.1:6379: Ray is not installed; pip install 'gvizdoom[cluster]'"
    assert refusal("127.0.0.1:6379") == want


KNOWN = {"ray": "0", "python": "3", "nodes": ["10.0.0.1"]}


def node(**changes) -> Node:
    fields = {**describe(), "id": "ab" * 28, "ip": "10.0.0.1", "cores": 4.0, "gpus": 0.0, **changes}
    return Node(**fields)


@pytest.mark.parametrize("what", ["python", "ray", "gvizdoom"])
def test_a_node_with_other_versions_is_refused(what):
    check_nodes([node()])
    with pytest.raises(ConfigError, match=rf"\(10.0.0.1, ababab\): got {what} 1.2.3, want .* as here; use one image"):
        check_nodes([node(), node(**{what: "1.2.3"})])


def test_the_digest_of_the_source_is_of_every_python_file_of_our_packages(monkeypatch, tmp_path):
    monkeypatch.setattr(nodes, "gvz", SimpleNamespace(__file__=str(tmp_path / "gvz" / "__init__.py")))
    digests = {nodes.source_digest()}
    for number, name in enumerate(("gvz/__init__.py", "gvz/a/b/deep.py", "learner/c.py", "gvz/a/b/deep.py")):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(f"x = {number}\n")
        digests.add(nodes.source_digest())
    assert len(digests) == 5
    (tmp_path / "gvz" / "notes.txt").touch()
    assert nodes.source_digest() in digests


def test_a_node_with_too_little_shared_memory_is_refused():
    check_nodes([node(shm_free_bytes=64_000_000)], shm_bytes=64_000_000)
    with pytest.raises(ResourceError, match="63 MB free in /dev/shm, want 64; give its container more") as caught:
        check_nodes([node(shm_free_bytes=63_000_000)], shm_bytes=64_000_000)
    assert caught.value.exit_code == 2


def test_a_head_with_other_versions_is_refused():
    with pytest.raises(ConfigError, match=r"cluster a:1: got ray 0, want .* as here; use one image on all nodes"):
        session._check_cluster("a:1", KNOWN, {"refused": True})


def test_a_machine_that_is_no_node_is_refused():
    mine = {"ray": describe()["ray"], "python": describe()["python"], "nodes": ["10.255.255.254"]}
    with pytest.raises(ConfigError, match="no node of it; first `ray start --address=a:1 --num-cpus=0` here"):
        session._check_cluster("a:1", mine, {"refused": True})


@pytest.mark.e2e
def test_a_cluster_is_entered_with_its_token_alone(cluster):
    done = connect(cluster)
    assert (done.returncode, done.stdout, done.stderr) == (0, "3 0.0 1\n", "")
    wrong = connect(cluster, RAY_AUTH_TOKEN="1" * 32)
    assert (wrong.returncode, wrong.stderr) == (2, "")
    assert "it refuses our token" in wrong.stdout
    too_little = connect(cluster, shm_bytes=10**15)
    assert (too_little.returncode, too_little.stderr) == (2, "")
    assert "free in /dev/shm, want 1000000000;" in too_little.stdout


@pytest.mark.e2e
def test_a_cluster_that_lets_everybody_in_is_refused():
    open_to_all = RayCluster(1, 1, RAY_AUTH_MODE="disabled")
    try:
        done = connect(open_to_all, RAY_AUTH_MODE="token")
    finally:
        open_to_all.close()
    assert (done.returncode, done.stderr) == (2, "")
    assert "it lets everybody run code, without a token" in done.stdout
