"""What the thread that speaks with the hosts says, without a cluster."""

import threading
import time
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from fake_env import config

from actors.pool import lanes_to_begin_with
from gvz.cluster import session
from gvz.cluster.backend import HostError, Machine
from gvz.cluster.config import ClusterConfig
from gvz.cluster.dispatcher import Dispatcher
from gvz.cluster.hello import Hello
from gvz.cluster.placement import Placement
from gvz.cluster.supervised import SupervisedHost
from gvz.core import stop
from gvz.core.errors import ConfigError
from gvz.transport.messages import ParamsHeader


def test_hosts_that_give_no_answer_are_named_at_the_start(tmp_path):
    """As where jobs of others hold a node's cores: Ray starts the host when they are free."""

    backend: Any = SimpleNamespace(
        machines=lambda: [Machine(id="1", name="n1", cpus=8, has_learner=False)],
        start=lambda *_: SimpleNamespace(greet=lambda _: "call", kill=lambda: None),
        wait=lambda *_: [],
    )
    pool, cluster = config(tmp_path, {}), ClusterConfig(address="h:1", hosts=1)
    host = SupervisedHost(0, pool, lanes_to_begin_with(pool, None), cluster)
    dispatcher = Dispatcher(backend, [host], cluster, Hello(versions={}, code="", schemas=(0, 0), maps={}))
    dispatcher._round()
    with pytest.raises(ConfigError, match=r"0 of 1 hosts came to play within 0 s, .*; no answer yet from n1; do other"):
        dispatcher.begin(0.0)


def test_a_host_is_started_where_there_is_room_first_on_machines_without_one(tmp_path):
    sizes = {"a": 2, "b": 4, "c": 2, "d": 1, "e": 1}
    machines = [Machine(id=name, name=name, cpus=cpus, has_learner=name == "b") for name, cpus in sizes.items()]
    backend: Any = SimpleNamespace(machines=lambda: machines)
    pool, cluster = config(tmp_path, {}, num_actors=2), ClusterConfig(address="h:1", hosts=5, min_hosts=5)
    hosts = [SupervisedHost(n, pool, lanes_to_begin_with(pool, None), cluster) for n in range(5)]
    placement, chosen = Placement(backend, hosts, cluster), list[str | None]()
    for host in hosts:
        host.avoid = "a"  # where its last life ended
        machine = placement.choose(host)
        chosen.append(machine and machine.name)
        life: Any = machine and SimpleNamespace(machine=machine.id)
        host.incarnation = life
    assert chosen == ["c", "b", "a", "b", None]
    with pytest.raises(
        ConfigError, match="got 5 hosts of 2 cores each, but the cluster's nodes have a 2, b 4, c 2, d 1, e 1"
    ):
        placement.check_room()
    ends = [placement.note_end("b", was_stable=stable) for stable in (False, False, True, False, False, False)]
    assert ends == [False] * 5 + [True], "three in a row"
    hosts[1].incarnation = hosts[3].incarnation = None
    assert placement.choose(hosts[4]) is None, "b is set aside"


@pytest.fixture
def greeted(tmp_path) -> Dispatcher:
    """Of one host, which has other source files, answers at once and notes the parameters that it is sent."""
    ours = Hello(versions={}, code="a", schemas=(0, 0), maps={})
    answers = {"greet": msgspec.msgpack.encode(msgspec.structs.replace(ours, code="b")), "begin": None}
    remote = SimpleNamespace(greet=lambda _: "greet", begin=lambda _: "begin", kill=lambda: None)
    backend: Any = SimpleNamespace(
        machines=lambda: [Machine(id="1", name="n1", cpus=8, has_learner=False)],
        start=lambda *_: remote,
        wait=lambda calls, _: calls,
        result=answers.get,
        put=lambda params: params.tolist(),
    )
    pool, cluster = config(tmp_path, {}), ClusterConfig(address="h:1", hosts=1, publish_period_s=3000.0)
    return Dispatcher(backend, [SupervisedHost(0, pool, lanes_to_begin_with(pool, None), cluster)], cluster, ours)


def test_other_source_files_are_refused_before_the_run_alone(greeted):
    """Later somebody may have edited them: an actor that is restarted on one machine takes these, too."""
    with pytest.raises(ConfigError, match="cluster node n1: source files of GViZDoom: got digest b, want a; install"):
        greeted.begin(10.0)
    greeted._greeting = False
    greeted._hosts[0].incarnation = None
    greeted._hosts[0].start_at_s = 0.0
    greeted._round()
    greeted._round()
    assert greeted.num_playing == 1


def test_the_newest_parameters_go_out_once_a_period_and_age_from_their_publication(greeted):
    greeted._hosts[0].incarnation = SimpleNamespace(playing_s=0.0)
    sent = []
    for version, waited_s in ((1, 0.0), (2, 0.0), (3, 3100.0), (4, 2900.0)):
        greeted._sent_s -= waited_s
        greeted.publish([version], ParamsHeader(version=version, num_updates=0, layout_hash=0))
        greeted._put_params()
        sent.append(greeted._sent[0])
    assert sent == [[1], [1], [3], [3]]
    greeted._published_s = {version: time.monotonic() - 1000.0 * (5 - version) for version in (3, 4)}
    batch: Any = SimpleNamespace(block=SimpleNamespace(steps={"params_version": np.array([1, 3, 4, 4])}))
    assert greeted._params_age_s(batch) == pytest.approx(1500, abs=100), "1 is as old as 3, or older"


def test_a_head_that_hangs_is_waited_for_once_and_only_for_a_while(monkeypatch):
    """Ray waits for it without end, and with it waited the dispatcher, its other hosts and the end of a run."""
    for name, value in session._OURS.items():
        monkeypatch.setenv(name, value)  # Ray reads them when it is imported; tests that come later need them
    from gvz.cluster import ray_hosts

    answers = threading.Event()
    monkeypatch.setattr(ray_hosts.ray, "nodes", lambda: [] if answers.wait() else None)
    monkeypatch.setattr(ray_hosts, "_HEAD_TIMEOUT_S", 0.2)
    monkeypatch.setattr(stop, "stuck", set())
    backend = ray_hosts.RayBackend.__new__(ray_hosts.RayBackend)  # connecting is the other tests' matter
    backend._asking = None
    with pytest.raises(HostError, match="Ray gave no answer within"):
        backend.machines()
    (asking,) = stop.stuck
    begin_s = time.monotonic()
    monkeypatch.setattr(ray_hosts, "_HEAD_TIMEOUT_S", 30.0)
    for ask in (backend.machines, lambda: backend.clean("0" * 56)):
        with pytest.raises(HostError, match="the cluster's head does not answer"):
            ask()
    assert time.monotonic() - begin_s < 20.0
    answers.set()
    asking.join(10.0)
    assert backend.machines() == []
