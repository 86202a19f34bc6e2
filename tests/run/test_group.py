"""Processes that act as one, here as threads without devices: what is agreed, refused, and noticed."""

import contextlib
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from gvz.cluster.config import ClusterConfig
from gvz.core import watchdog
from gvz.core.errors import ConfigError, GroupError, WaitTimeoutError
from gvz.core.stop import StopRequest
from gvz.launch import main
from gvz.run import link, relay
from gvz.run.config import CheckpointConfig
from gvz.run.config_files import config_from_dict, config_to_dict, load_config
from gvz.run.group import Several, _settings
from gvz.run.group_config import GroupConfig
from gvz.run.relay import Relay, free_port
from learner.agents.configs.ppo import PPOConfig
from learner.checkpoint import Restored
from learner.config import OnPolicyConfig
from tests.waiting import wait_until

CONFIG = load_config("rainbow_4task")
HOSTS = ClusterConfig(address="10.0.0.1:6379", hosts=2)


class WithoutDevices(Several):
    def _join_jax(self, host: str, port: int) -> None:
        assert port > 0


def in_threads(works: list[Callable[[], Any]], timeout_s: float = 60.0) -> list[Any]:
    """What each gave, or the error that it raised."""
    found: list[Any] = [None] * len(works)

    def run(i: int) -> None:
        try:
            found[i] = works[i]()
        except Exception as error:
            found[i] = error

    threads = [threading.Thread(target=run, args=(i,), daemon=True) for i in range(len(works))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(timeout_s)
        assert not thread.is_alive()
    return found


def joined(num_processes: int, **changes: Any) -> list[Any]:
    """A group, each process in a thread; `changes` are of the last one's configuration."""
    address = f"127.0.0.1:{free_port('127.0.0.1')}"

    def start(process: int) -> Several:
        group = GroupConfig(num_processes=num_processes, process_id=process, coordinator=address)
        config = replace(CONFIG, group=group, **(changes if process == num_processes - 1 else {}))
        return WithoutDevices(config, lambda _: None)

    return in_threads([lambda p=process: start(p) for process in range(num_processes)])


@contextlib.contextmanager
def group_of(num_processes: int):
    groups = joined(num_processes)
    with contextlib.ExitStack() as opened:
        for group in groups:
            opened.enter_context(group._opened)
        yield groups


def until_it_may_update(group: Several, num_saved: int) -> bool:
    """Until all are ready. It gives up before `in_threads` does."""
    return wait_until(lambda: group.may_update(True, False, num_saved), "a step of all", 30)


def until_no_link_is_open() -> None:
    """A link that stays open ends its process some time after its group has ended."""
    wait_until(lambda: not any(thread.name == "group" for thread in threading.enumerate()), "the end of all links", 30)


def test_a_step_is_done_when_all_are_ready_and_a_save_when_nobody_writes():
    with group_of(3) as groups:
        assert not groups[0].may_update(True, False, 100)
        assert not groups[1].may_update(True, True, 50)
        assert not groups[2].may_update(False, False, 100)
        assert not groups[0].may_update(True, False, 100)
        assert all(in_threads([lambda g=g: until_it_may_update(g, 100) for g in groups]))
        assert [group.may_save() for group in groups] == [False] * 3
        assert [group.num_common_saved for group in groups] == [50] * 3
        assert all(in_threads([lambda g=g: until_it_may_update(g, 200) for g in groups]))
        assert [group.may_save() for group in groups] == [True] * 3
        assert [group.num_common_saved for group in groups] == [200] * 3


def test_a_signal_to_one_stops_all_before_the_same_step_also_those_that_are_not_ready():
    stops = [StopRequest(), StopRequest()]
    with group_of(2) as groups:
        counts = [0, 0]

        def run(i: int) -> None:
            while not groups[i].stops(stops[i]):
                ready = i == 1 or counts[0] < 5  # process 0 lacks records from then on
                counts[i] += groups[i].may_update(ready, False, 0)
                if counts[1] == 5:
                    stops[1].signal = 15

        in_threads([lambda i=i: run(i) for i in range(2)])
    assert counts == [5, 5]
    assert [stop.exit_code for stop in stops] == [143, 143]


def test_all_go_on_from_the_newest_checkpoint_that_all_have():
    have = [[100, 200, 300], [100, 200], [100, 200, 250]]

    def read(steps: list[int], newest: int | None) -> Restored | None:
        fits = [step for step in steps if newest is None or step <= newest]
        return Restored(num_updates=fits[-1], arrays=None, host={}, damage=[]) if fits else None

    with group_of(3) as groups:
        works = [lambda g=g, s=s: g.restored(lambda n: read(s, n)) for g, s in zip(groups, have, strict=True)]
        assert [found.num_updates for found in in_threads(works)] == [200, 200, 200]
        works = [lambda g=g, s=s: g.restored(lambda n: read(s, n)) for g, s in zip(groups, [[1], [], [1]], strict=True)]
        assert in_threads(works) == [None, None, None]


def test_a_process_that_goes_is_known_at_once_and_one_that_is_done_may_go():
    with group_of(3) as groups:
        groups[1]._link.close()
        for group in (groups[0], groups[2]):
            with pytest.raises(GroupError, match=r"learner process 1 of 3 is gone, so the group ends; .*same commands"):
                until_it_may_update(group, 0)
            with pytest.raises(GroupError, match="is gone"), group.blamed():
                raise RuntimeError("Gloo all-reduce failed: connection reset by peer")
    with group_of(2) as groups:
        in_threads([lambda g=g: g._link.gather("done", None, 30, "to end") for g in groups])
        groups[0]._opened.close()
        wait_until(lambda: 0 in groups[1]._link._done, "the other's word that it is done", 30)
        time.sleep(0.2)
        groups[1]._link.check()


def test_a_silent_process_counts_as_gone(monkeypatch):
    monkeypatch.setattr(link, "BEAT_PERIOD_S", 0.1)
    monkeypatch.setattr(link, "SILENCE_TIMEOUT_S", 2.0)
    with group_of(2) as groups:
        groups[1]._link.send = lambda *_: None
        with pytest.raises(GroupError, match=r"learner process 1 of 2 is silent for 2 s"):
            groups[0]._link.wait_for_failure(30)


@pytest.mark.parametrize(("heard_s", "slept_s", "failed"), [(0.0, 1000.0, []), (-59.0, 2.0, [1])])
def test_time_in_which_a_process_was_stopped_itself_is_no_silence_of_others(heard_s, slept_s, failed, monkeypatch):
    """Ctrl-Z, or a paused container: it hears of the others when it goes on."""
    now_s, found, watching = [0.0], [], link.Link.__new__(link.Link)

    def sleep(_: float) -> None:
        now_s[0], watching._closed = slept_s, True  # after one look

    for module in (link, watchdog):
        monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: now_s[0], sleep=sleep))
    watching._clock = watchdog.AwakeClock(2 * link.BEAT_PERIOD_S)
    watching._closed, watching.failure, watching._values, watching._heard_s = False, None, {}, {1: heard_s}
    monkeypatch.setattr(watching, "send", lambda _: None)
    monkeypatch.setattr(watching, "_fail", lambda process, _: found.append(process))
    watching._watch()
    assert found == failed


def test_processes_that_differ_are_refused_on_both_sides_by_the_name_of_what_differs():
    found = joined(2, learner=replace(CONFIG.learner, batch_size=64))
    assert [type(error) for error in found] == [ConfigError, ConfigError]
    assert {str(error) for error in found} == {
        "group: learner.batch_size is 32 in learner process 0 and 64 in 1; want it the same"
    }
    until_no_link_is_open()
    for group in joined(2, name="another"):
        group._opened.close()
    compared = {name.partition(".")[0] for name in _settings(CONFIG)}
    assert compared >= {"seed", "tasks", "scenario", "env", "agent", "replay", "learner", "curriculum", "checkpoint"}


def test_processes_of_different_source_files_are_refused(monkeypatch):
    """Two commits can have one version, and each process works out the new parameters by itself."""
    digests = iter(("1a", "2b"))
    monkeypatch.setattr("gvz.run.group.source_digest", lambda: next(digests))
    found = joined(2)
    assert {type(error) for error in found} == {ConfigError}
    assert all("group: the version of the source files is" in str(error) for error in found)
    until_no_link_is_open()


def test_two_processes_with_one_number_and_strangers_are_turned_away(monkeypatch):
    monkeypatch.setattr(relay, "HELLO_TIMEOUT_S", 0.2)
    address = "127.0.0.1", free_port("127.0.0.1")
    the_relay = Relay(address, 2)
    no_hello = (b"GET / HTTP/1.1\r\n\r\n", b'{"kind": "hello"}\n', b"[]\n", b"[" * 100_000 + b"\n", b"\xff\xfe\n", b"")
    for said in no_hello:
        with socket.create_connection(address) as stranger:
            stranger.sendall(said)
            stranger.settimeout(30)
            assert stranger.recv(1) == b""
    links: list[link.Link] = []
    first = threading.Thread(target=lambda: links.append(link.Link(address, 0, 2, {})), daemon=True)
    first.start()
    wait_until(lambda: the_relay._connections, "the first one's connection", 30)
    for process in (0, 2):
        with pytest.raises(ConfigError, match=rf"group\.process_id: process_id {process} is taken, or not one of 2; e"):
            link.Link(address, process, 2, {})
    links.append(link.Link(address, 1, 2, {"of": 1}))
    assert set(links[-1].hellos[1]) == {"of"}
    first.join(30)
    for each in links:
        each.close()
    the_relay.close()


def test_a_port_of_something_else_is_said_to_be_perhaps_wrong():
    with socket.create_server(("127.0.0.1", 0)) as other:
        address = other.getsockname()

        def serve() -> None:
            with other.accept()[0] as connection:
                connection.sendall(b"SSH-2.0-OpenSSH_9.2\r\n")

        serving = threading.Thread(target=serve, daemon=True)
        serving.start()
        with pytest.raises(GroupError, match=rf"has not answered at 127\.0\.0\.1:{address[1]} \(is that group\.coord"):
            link.Link(address, 1, 2, {})
        serving.join(10)


def test_waits_for_the_others_are_bounded_and_say_for_whom(monkeypatch):
    monkeypatch.setattr(link, "JOIN_TIMEOUT_S", 0.3)
    address = "127.0.0.1", free_port("127.0.0.1")
    with pytest.raises(
        WaitTimeoutError, match=r"waited 0 s for learner process 0 at 127\.0\.0\.1:\d+ \(.*\); start it"
    ):
        link.Link(address, 1, 3, {})
    the_relay = Relay(address, 3)
    with pytest.raises(WaitTimeoutError, match=r"waited 0 s for learner processes 1, 2 to connect to 127\.0\.0\.1"):
        link.Link(address, 0, 3, {})
    until_no_link_is_open()
    the_relay.close()


def test_a_process_that_cannot_reach_jax_in_process_0_says_so(monkeypatch):
    """As behind a firewall that lets the coordinator's port through alone."""

    def join_in_process_1(self: Several, host: str, port: int) -> None:
        if self._process == 1:
            Several._join_jax(self, host, port)

    monkeypatch.setattr(WithoutDevices, "_join_jax", join_in_process_1)
    monkeypatch.setattr("gvz.run.group.JAX_TIMEOUT_S", 0.3)
    first, second = joined(2)
    first._opened.close()
    assert isinstance(second, WaitTimeoutError)
    assert str(second).startswith("group: waited 0 s for JAX's coordinator at 127.0.0.1:")
    assert str(second).endswith("(Connection refused); let learner processes reach all ports of each other's hosts")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({}, r"group\.coordinator: got None for 2 processes, want HOST:PORT"),
        ({"coordinator": "here", "process_id": 0}, r"group\.coordinator: got 'here'"),
        ({"coordinator": "here:0", "process_id": 0}, r"group\.coordinator: got 'here:0'"),
        ({"coordinator": "here:65536", "process_id": 0}, r"group\.coordinator: got 'here:65536'.* port of 1\.\.65535"),
        ({"coordinator": "[fd00::1]:1", "process_id": 0}, r"got '\[fd00::1\]:1' for 2 processes, .* IPv4 address"),
        ({"coordinator": "here:1", "process_id": 2}, r"group\.process_id: got 2, want 0\.\.1"),
        (
            {"coordinator": "here:1"},
            r"group\.process_id: got nothing for 2 processes, want 0\.\.1; without it SLURM_PROCID",
        ),
    ],
)
def test_a_group_that_is_not_whole_is_refused(values, message, monkeypatch):
    monkeypatch.delenv("SLURM_PROCID", raising=False)
    with pytest.raises(ConfigError, match=message):
        GroupConfig(num_processes=2, **values)


@pytest.mark.parametrize(("name", "value"), [("process_id", 1), ("coordinator", "10.0.0.1:9876")])
def test_an_option_of_a_group_without_a_number_of_processes_is_refused(name, value):
    with pytest.raises(ConfigError, match=rf"group\.{name}: got {value} without other .*; group\.num_processes says"):
        GroupConfig(**{name: value})


def test_slurm_says_which_process_this_is_and_each_has_a_directory_and_games_of_its_own(monkeypatch):
    monkeypatch.setenv("SLURM_PROCID", "1")
    config = replace(CONFIG, group=GroupConfig(num_processes=2, coordinator="here:1"))
    assert config.group.own_id == 1
    assert config.resolved_run_dir == CONFIG.resolved_run_dir / "process_1"
    assert config.games_seed != CONFIG.games_seed == CONFIG.seed
    saved = config_to_dict(config)
    monkeypatch.delenv("SLURM_PROCID")
    assert config_from_dict(saved).group.own_id == 1, "its policies can be evaluated without Slurm"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mode": "sync"}, r"mode: got sync with 2 learner processes, want async"),
        ({"max_processor_s": 5.0}, r"max_processor_s: got 5\.0 with 2 learner processes, want none"),
        ({"cluster": HOSTS}, r"cluster\.hosts: got 2 with 2 learner processes, want 0"),
        ({"agent": PPOConfig(), "learner": OnPolicyConfig(), "replay": None}, r"agent\.name: got ppo with 2 learner"),
        (
            {"checkpoint": CheckpointConfig(keep=1)},
            r"checkpoint\.keep: got 1 with 2 learner processes, want at least 2",
        ),
    ],
)
def test_what_a_group_cannot_do_is_refused(changes, message):
    with pytest.raises(ConfigError, match=message):
        replace(CONFIG, group=GroupConfig(num_processes=2, process_id=0, coordinator="here:1"), **changes)


@pytest.mark.parametrize(
    ("host", "message"),
    [
        ("8.8.8.8", r"8\.8\.8\.8 is a public address; the group asks nobody"),
        ("0.0.0.0", r"0\.0\.0\.0 stands for all addresses of a machine, public ones too; the group asks nobody"),
        ("no.such.host.invalid", "no machine has"),
    ],
)
def test_a_coordinator_that_is_public_or_unknown_is_refused_before_anything_listens(host, message):
    group = GroupConfig(num_processes=2, process_id=0, coordinator=f"{host}:1")
    with pytest.raises(ConfigError, match=rf"group\.coordinator: {message}"):
        WithoutDevices(replace(CONFIG, group=group), lambda _: None)


@pytest.mark.parametrize(("name", "what"), [("both", r"\.coordinator"), ("doom7", ": own host name 'doom7'")])
def test_a_name_with_a_public_address_beside_a_private_one_is_refused(name, what, monkeypatch):
    """The relay listens at IPv4, where the first address may be of IPv6."""
    known = {name: ["fd00::1", "8.8.8.8"]}
    monkeypatch.setattr(socket, "gethostname", lambda: "doom7")
    monkeypatch.setattr(
        socket,
        "getaddrinfo",
        lambda host, *_, **__: [(None, None, 6, "", (ip, 0)) for ip in known.get(host, ["10.0.0.1"])],
    )
    group = GroupConfig(num_processes=2, process_id=0, coordinator="both:1")
    with pytest.raises(ConfigError, match=rf"^group{what}: 8\.8\.8\.8 is a public address"):
        WithoutDevices(replace(CONFIG, group=group), lambda _: None)


@pytest.mark.parametrize(
    ("own", "coordinator", "message"),
    [
        ("8.8.8.8", "127.0.0.1", r"8\.8\.8\.8 is a public address; .*, which /etc/hosts can give to doom7"),
        (
            "127.0.1.1",
            "10.0.0.1",
            r"got 127\.0\.1\.1, where .*; change the line of doom7 in /etc/hosts, or begin group",
        ),
    ],
)
def test_an_own_host_name_that_is_public_or_of_this_machine_alone_is_refused(own, coordinator, message, monkeypatch):
    """JAX's transport of gradients listens at its address, and sends the others there."""
    named(own, monkeypatch)
    group = GroupConfig(num_processes=2, process_id=0, coordinator=f"{coordinator}:1")
    with pytest.raises(ConfigError, match=rf"^group: own host name 'doom7': {message}"):
        WithoutDevices(replace(CONFIG, group=group), lambda _: None)


def test_debians_address_of_an_own_host_name_is_good_enough_on_one_machine(monkeypatch):
    named("127.0.1.1", monkeypatch)
    for group in joined(2):
        group._opened.close()


def named(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """This machine's name has this address."""
    monkeypatch.setattr(socket, "gethostname", lambda: "doom7")
    monkeypatch.setattr("gvz.run.group.resolve", lambda host, _: [address] if host == "doom7" else [host])


def test_a_fresh_start_of_a_group_is_refused(tmp_path, capsys):
    group = "--group.num-processes 2 --group.process-id 0 --group.coordinator 127.0.0.1:1".split()
    assert main(["--fresh", "--run-dir", str(tmp_path), *group]) == 2
    assert capsys.readouterr().err == (
        "error: --fresh: got it for a group of learner processes; give all another --run-dir\n"
    )
