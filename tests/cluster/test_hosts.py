"""Actor hosts on a cluster of three nodes: every fault is noticed, named and mended, and what was lost is counted.

Ray runs in this process with the token of this module's cluster; no other module enters Ray here.
"""

import contextlib
import dataclasses
import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import psutil
import pytest
from fake_env import config, export_act
from watched_pool import Run

from actors.config import ActorsConfig
from actors.pool import PoolConfig
from actors.preprocess import ObservationBatch
from benchmarks.soak import processes
from gvz.cluster import dispatcher, supervised
from gvz.cluster.config import ClusterConfig
from gvz.cluster.pool import ClusterPool, cluster_pool
from gvz.core import janitor
from gvz.core.errors import ConfigError, ResumeError, WorkerError
from gvz.transport.messages import EpisodeStats, Fault, ParamsHeader, Ready
from tests.cluster.conftest import FAKE_GAMES, RayCluster
from tests.processes import arguments
from tests.waiting import wait_until

pytestmark = pytest.mark.e2e
DEADLINE_S = 200.0
ROOT = Path(__file__).parents[2]
NUM_ACTORS = 4
"""two on each of two hosts, with two games each"""


@pytest.fixture(scope="module")
def nodes() -> Iterator[RayCluster]:
    """A head without cores, and two nodes with two each. Games of this directory can be imported there. Ray waits half
    a second, not five, for the end of a host that was stopped, before it sends SIGKILL.
    """
    path = os.pathsep.join([str(ROOT), str(FAKE_GAMES)])
    made = RayCluster(3, num_cores=2, PYTHONPATH=path, RAY_kill_worker_timeout_milliseconds="500")
    yield made
    made.close()


@pytest.fixture(scope="module")
def backend_of(nodes: RayCluster) -> Iterator[Callable[[], Any]]:
    """Makes backends of one connection, which stays open: to connect takes seconds."""
    with pytest.MonkeyPatch.context() as patch:
        for name, value in nodes.environment.items():
            if name.startswith("RAY_"):
                patch.setenv(name, value)
        ours = signal.getsignal(signal.SIGTERM)
        import ray

        ray.init(nodes.address, namespace="gvizdoom", log_to_driver=False, logging_level=50)
        signal.signal(signal.SIGTERM, ours)
        from gvz.cluster.ray_hosts import RayBackend

        yield lambda: RayBackend(contextlib.ExitStack())
        ray.shutdown()


class Played(Run):
    """A pool of hosts in a test."""

    pool: ClusterPool

    def until_all_ready(self, num_actors: int = NUM_ACTORS) -> None:
        self.until(lambda: self.pool.statistics().actors_ready == num_actors)

    def until_fault(self, kind: str) -> Fault:
        self.until(lambda: any(m.kind == kind for m in self.faults()))
        return next(m for m in self.faults() if m.kind == kind)

    def until_replaced(self, count: int = 1) -> None:
        """Another incarnation plays, in all lanes."""
        self.until(lambda: self.more("host_restarts") >= count and self.more("hosts") == 2)
        self.until_all_ready()
        self.play(500)

    def more(self, name: str) -> float:
        return self.pool.statistics().more[f"cluster/{name}"]

    def node_of(self, host: int) -> str:
        life = self.pool._hosts[host].incarnation
        assert life is not None
        return life.name


@pytest.fixture
def play(backend_of, tmp_path: Path, nodes: RayCluster):
    """Starts a pool of two hosts; it is closed at the end of the test, and nothing of it may be left."""
    with contextlib.ExitStack() as stack:

        def start(options: dict[str, Any], *, actors: ActorsConfig | None = None, state: Any = None, **changes: Any):
            pool_changes = {k: changes.pop(k) for k in list(changes) if k in PoolConfig.__struct_fields__}
            pool_config = config(
                tmp_path / "work",
                options,
                actors=actors or ActorsConfig(placement="free"),
                **{"num_actors": NUM_ACTORS, **pool_changes},
            )
            limits = {"hosts": 2, "batch_records": 64, "silence_timeout_s": 20.0, **changes}
            cluster = ClusterConfig(address=nodes.address, **limits)
            pool = stack.enter_context(ClusterPool(pool_config, cluster, backend_of(), state))
            return Played(pool, pool_config)

        yield start
    wait_until(lambda: not processes() and not janitor.dead_instances(), "the end of hosts, actors and what they made")


def host_of(process: psutil.Process) -> int:
    """The host's index: its actors' logs are named by their numbers."""
    for child in process.children(recursive=True):
        if "actors.worker" in arguments(child):
            with contextlib.suppress(psutil.Error, OSError):
                log = Path(f"/proc/{child.pid}/fd/1").readlink().stem
                return int(log.removeprefix("actor_")) // 2
    return -1


def params_decide(tmp_path: Path) -> dict[str, Any]:
    """Options of a pool whose actions are the first two of four parameters."""
    games = ObservationBatch.of(config(tmp_path, {}), 2)
    policy = export_act(lambda leaves, *_: leaves[0][:2].astype("int32"), [(4,)], games)
    return {"policy": policy, "num_params": 4, "layout_hash": 7}


# --------------------------------------------------------------------------------------------- play


def test_hosts_on_different_nodes_play_all_lanes_by_the_newest_parameters(play, tmp_path: Path):
    played = play({"length": 20}, **params_decide(tmp_path), publish_period_s=0.2)

    def publish(version: int) -> None:
        header = ParamsHeader(version=version, num_updates=version, layout_hash=7)
        played.pool.publish(np.full(4, version, np.float32), header)

    publish(1)
    played.until(lambda: len(played.checker.last) == 8)
    assert {int(s["params_version"]) for s in played.checker.last.values()} == {1}
    assert len({played.node_of(0), played.node_of(1)}) == 2
    for version in (2, 3, 4):
        publish(version)
    played.until(lambda: {int(s["params_version"]) for s in played.checker.last.values()} == {4})
    assert {int(s["action"]) for s in played.checker.last.values() if not s["terminated"]} <= {4}
    assert played.checker.num_cuts == 0
    assert {m.actor for m in played.messages if isinstance(m, Ready)} == {0, 1, 2, 3}
    assert {m.lane for m in played.messages if isinstance(m, EpisodeStats)} <= set(range(8))
    assert 0.0 < played.more("params_age_s") < DEADLINE_S
    assert played.faults() == []


def test_a_learner_that_takes_nothing_holds_the_hosts_back_and_a_lane_gets_its_task(play):
    played = play({"length": 20}, credits=2)
    played.until_all_ready()
    hosts = played.pool._hosts  # from here on the learner takes nothing
    wait_until(lambda: [host.waiting_batches for host in hosts] == [2, 2], "two batches of each host")
    time.sleep(0.8)
    assert [host.waiting_batches for host in hosts] == [2, 2], "two credits a host, and no batch more"
    played.checker.assigned = {1: 0, 6: 1}
    for lane, task in played.checker.assigned.items():
        played.pool.assign(lane, task)
    played.until(lambda: {1, 6} <= played.checker.last.keys())
    played.until(lambda: all(played.checker.last[lane]["task"] == task for lane, task in ((1, 0), (6, 1))))
    assert played.pool.statistics().waited_for_space_s > 0.5
    state = played.pool.state()
    assert state["tasks"] == [0, 0, 0, 1, 0, 1, 1, 1]
    assert min(state["next_episodes"]) > 0


def test_a_run_goes_on_with_new_episodes_and_other_hosts(play):
    first = {"next_episodes": [100] * 8, "tasks": [1, 0, 0, 1, 0, 1, 0, 1]}
    played = play({"length": 20}, state=first, hosts=1, num_actors=2, games_per_actor=4)
    played.checker.assigned = {0: 1, 1: 0}
    played.until(lambda: len(played.checker.last) == 8)
    assert min(int(s["episode"]) for s in played.checker.last.values()) >= 100
    assert played.pool.state()["tasks"] == first["tasks"]


def test_a_host_without_a_node_waits_and_the_others_play(play):
    played = play({"length": 20}, hosts=3, num_actors=6)
    told = played.until_fault("host_start")
    assert told.message == "host 2 waits: no node has room for 2 cores"
    played.until(lambda: len(played.checker.last) == 8)
    assert played.more("hosts") == 2


# --------------------------------------------------------------------------------------------- faults


@pytest.mark.parametrize("fault", ["kill", "hang_answers"])
def test_a_host_that_dies_or_is_silent_is_replaced(play, fault: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(supervised, "_FIRST_BACKOFF_S", 0.05)
    played = play({"length": 50, "step_s": 0.001}, silence_timeout_s=3.0)
    played.until_all_ready()
    played.play(500)
    before = played.node_of(0)
    victim = next(p for p in processes("host") if host_of(p) == 0)
    victim.send_signal(signal.SIGKILL if fault == "kill" else signal.SIGSTOP)
    told = played.until_fault("host_died" if fault == "kill" else "host_silent")
    assert told.actor == -1
    assert told.message.startswith(f"host 0 on {before} ")
    assert ("ActorDiedError" if fault == "kill" else "gave no sign of life for 3.") in told.message
    assert "episodes cut, replaced in" in told.message
    played.until_replaced()
    assert 0 < played.more("cut_episodes") <= 4
    assert played.checker.num_cuts == played.more("cut_episodes"), "the replay hears of each by a new first record"
    # a host that was given up is ended, also if it was stopped
    wait_until(lambda: not victim.is_running() or victim.status() == psutil.STATUS_ZOMBIE, "the given-up host's end")


def test_a_host_that_parameters_do_not_reach_is_replaced(play, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Although its batches come: it would play old ones for the rest of the run."""
    import ray

    from gvz.cluster.ray_hosts import RayRemote

    monkeypatch.setattr(supervised, "_FIRST_BACKOFF_S", 0.05)
    cut_off: list[RayRemote] = []
    never, set_params = ray.remote(num_cpus=0)(lambda: time.sleep(600)), RayRemote.set_params

    def first_is_cut_off(remote: RayRemote, params: Any, header: ParamsHeader) -> Any:
        if not cut_off:
            cut_off.append(remote)
        return never.remote() if remote in cut_off else set_params(remote, params, header)

    monkeypatch.setattr(RayRemote, "set_params", first_is_cut_off)
    played = play({"length": 20}, **params_decide(tmp_path), silence_timeout_s=3.0)
    played.pool.publish(np.full(4, 1, np.float32), ParamsHeader(version=1, num_updates=1, layout_hash=7))
    told = played.until_fault("host_silent")
    assert "did not take parameters for 3." in told.message
    played.until_replaced()


def test_an_actor_that_dies_is_its_hosts_matter(play):
    played = play({"length": 20})
    played.until_all_ready()
    processes("actor")[0].kill()
    told = played.until_fault("died")
    assert "was ended by SIGKILL; restart 1 of 20" in told.message
    played.until(lambda: len([m for m in played.messages if isinstance(m, Ready)]) == NUM_ACTORS + 1)
    played.play(300)
    assert (played.pool.statistics().restarts, played.more("host_restarts")) == (1, 0)


def test_a_node_that_dies_is_replaced_by_another(play, nodes: RayCluster):
    nodes.tell("add")
    played = play({"length": 50})
    played.until_all_ready()
    before = {played.node_of(0), played.node_of(1)}
    assert len(before) == 2, "hosts of two cores on three nodes of two"
    nodes.kill_node_of(processes("host")[0])
    told = played.until_fault("host_died")
    played.until_replaced()
    after = {played.node_of(0), played.node_of(1)}
    assert len(after & before) == 1, "the third node has taken over"
    assert next(iter(before - after)) in told.message
    assert played.checker.num_cuts == played.more("cut_episodes") > 0


def test_a_lost_batch_costs_the_incarnation(play):
    played = play({"length": 50})
    played.until_all_ready()
    victim = played.pool._hosts[1]
    with played.pool._inbox.changed:
        assert victim.incarnation is not None
        victim.incarnation.next_batch += 1
    told = played.until_fault("host_answer")
    assert "want (" in told.message
    assert "a batch was lost" in told.message
    played.until_replaced()
    assert played.checker.num_cuts == played.more("cut_episodes")


def test_answers_that_overtake_each_other_are_taken_in_order(play, monkeypatch: pytest.MonkeyPatch):
    from gvz.cluster.ray_hosts import RayBackend

    wait, num_reversed = RayBackend.wait, 0

    def reversed_wait(backend: Any, calls: Any, timeout_s: float) -> Any:
        nonlocal num_reversed
        time.sleep(0.1)  # so that several have come
        found = wait(backend, calls, timeout_s)[::-1]
        num_reversed += len(found) > 2
        return found

    played = play({"length": 20}, credits=4)
    played.until_all_ready()
    with monkeypatch.context() as patch:
        patch.setattr(RayBackend, "wait", reversed_wait)
        played.until(lambda: num_reversed >= 5)
        played.play(1000)
    assert played.faults() == []
    assert played.checker.num_cuts == 0


def test_what_comes_too_late_is_dropped_and_counted(play, monkeypatch: pytest.MonkeyPatch):
    from gvz.cluster.ray_hosts import RayRemote

    played = play({"length": 50, "step_s": 0.001}, silence_timeout_s=3.0)
    played.until_all_ready()
    victim = next(p for p in processes("host") if host_of(p) == 0)
    with monkeypatch.context() as patch:
        patch.setattr(RayRemote, "kill", lambda _: None)  # the network is cut: the host does not hear of its end
        lost = played.pool._hosts[0].incarnation
        victim.send_signal(signal.SIGSTOP)
        played.until_fault("host_silent")
        victim.send_signal(signal.SIGCONT)
        told = played.until_fault("late_batch")
    assert lost is not None
    lost.remote.kill()
    assert "records, which were dropped" in told.message
    played.until_replaced()
    late = [fault.message.split() for fault in played.faults() if fault.kind == "late_batch"]
    dropped = sum(int(words[words.index("records,") - 1]) for words in late)
    assert played.more("dropped_records") == dropped > 0
    assert played.checker.num_cuts == played.more("cut_episodes")


def test_hosts_that_never_play_set_their_nodes_aside_and_the_run_ends_in_order(play, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(supervised, "_FIRST_BACKOFF_S", 0.01)
    limits = ActorsConfig(placement="free", max_restarts=0)
    played = play({"fault": "no_start"}, actors=limits)
    played.until(lambda: [fault.kind for fault in played.faults()].count("node_set_aside") == 2)
    thread = played.pool._dispatcher
    thread._config = dataclasses.replace(thread._config, patience_s=1.0)
    with pytest.raises(WorkerError) as raised:
        played.until(lambda: False)
    text = str(raised.value)
    assert "hosts: 0 of 2 play, want at least cluster.min_hosts 1; waited" in text
    assert "WorkerError: actor" in text
    kinds = [fault.kind for fault in played.faults()]
    assert kinds.count("host_failed") >= 6
    assert "no engine today" in next(f.traceback for f in played.faults() if f.kind == "host_failed")


# --------------------------------------------------------------------------------------------- refusals


def test_what_differs_on_a_node_is_one_line_before_any_game_starts(play, monkeypatch: pytest.MonkeyPatch):
    real = dispatcher.differences

    def other(ours, theirs):
        return real(msgspec.structs.replace(ours, versions={**ours.versions, "jax": "0.0.1"}), theirs)

    monkeypatch.setattr(dispatcher, "differences", other)
    with pytest.raises(ConfigError, match=r"cluster node .*: jax: got .*, want 0.0.1; install the same on every node"):
        play({})


def test_too_few_cores_and_another_number_of_lanes_are_refused(play):
    with pytest.raises(ConfigError, match=r"got 2 hosts of 50 cores each, but the cluster's nodes have .* 2, "):
        play({}, cpus_per_host=50)
    with pytest.raises(ResumeError, match=r"got 4 lanes, want 8 \(4 actors with 2 games\)"):
        play({}, state={"next_episodes": [0] * 4, "tasks": [0] * 4})


@pytest.mark.parametrize(
    ("fields", "text"),
    [
        ({"hosts": 65, "address": "h:1"}, r"cluster.hosts: got 65, want 0..64"),
        ({"hosts": 2}, r"cluster.hosts: got 2 without cluster.address; give both"),
        ({"address": "h:1"}, r"cluster.address: got 'h:1' without cluster.hosts; give both"),
        ({"hosts": 2, "address": "h:1", "min_hosts": 3}, r"cluster.min_hosts: got 3, want 1..2"),
        ({"credits": 0}, r"cluster.credits: got 0, want 1..64"),
        ({"silence_timeout_s": 1.0}, r"cluster.silence_timeout_s: got 1.0, want at least 3 seconds"),
    ],
)
def test_a_wrong_number_is_named(fields: dict[str, Any], text: str):
    with pytest.raises(ConfigError, match=text):
        ClusterConfig(**fields)


def test_a_wrong_address_is_one_line():
    with pytest.raises(ConfigError, match="want HOST:PORT"):
        cluster_pool(config(Path(), {}), ClusterConfig(address="ray://h:1", hosts=1), None)
