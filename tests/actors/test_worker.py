"""A worker process from within: its first message, its waits, its end."""

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
from fake_env import FRAME_SHAPE, config, first_param_policy

from actors import worker
from actors.pool import lanes_to_begin_with
from actors.process import log_path, start_actor
from actors.worker import Worker
from gvz.core import records
from gvz.core.errors import WaitTimeoutError
from gvz.transport.broadcast import BroadcastWriter
from gvz.transport.channel import Channel
from gvz.transport.messages import ActorSpec, Fault, ParamsHeader, Ready, Stop
from gvz.transport.ring import RingReader, WriterState
from tests.full_disk import full_disk
from tests.waiting import make_pause

LAYOUT, NUM_PARAMS = 5, 4


@pytest.fixture
def spec(tmp_path: Path) -> ActorSpec:
    pool_config = config(tmp_path, {}, num_actors=1)
    return pool_config.actor_specs(lanes_to_begin_with(pool_config, None))[0]


@pytest.fixture
def ring(spec: ActorSpec) -> Iterator[RingReader]:
    reader = RingReader.create("gvz-test", spec.ring_capacity, FRAME_SHAPE)
    yield reader
    reader.close()


@pytest.fixture
def channels() -> Iterator[tuple[Channel, Channel]]:
    ours, theirs = socket.socketpair()
    learner, actor = Channel(ours, peer="the actor"), Channel(theirs, peer="the learner")
    yield learner, actor
    learner.close()
    actor.close()


@pytest.fixture
def queue() -> Iterator[BroadcastWriter]:
    writer = BroadcastWriter.create("gvz-test", NUM_PARAMS, LAYOUT)
    yield writer
    writer.close()


@pytest.fixture
def make_worker(
    spec: ActorSpec, ring: RingReader, channels: tuple[Channel, Channel], queue: BroadcastWriter
) -> Callable[[], Worker]:
    """Makes a worker that waits for parameters."""
    acting = msgspec.structs.replace(
        spec, policy=first_param_policy(NUM_PARAMS), num_params=NUM_PARAMS, layout_hash=LAYOUT
    )
    return lambda: Worker(acting, channels[1], ring.descriptor, queue.descriptor)


def params(version: int) -> tuple[np.ndarray, ParamsHeader]:
    header = ParamsHeader(version=version, num_updates=version, layout_hash=LAYOUT)
    return np.full(NUM_PARAMS, version, np.float32), header


def start(first: bytes | None, parent_pid: int) -> subprocess.CompletedProcess[str]:
    """Runs a worker to its end, `first` being all that ever comes on its socket."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        process = subprocess.Popen(
            [sys.executable, "-m", "actors.worker", str(parent_pid), str(theirs.fileno()), "-1"],
            pass_fds=[theirs.fileno()],
            stderr=subprocess.PIPE,
            text=True,
        )
        theirs.close()
        if first is not None:
            ours.sendall(first)
        ours.close()
        _, stderr = process.communicate(timeout=60)
    return subprocess.CompletedProcess(process.args, process.returncode, None, stderr)


def test_a_worker_without_a_spec_says_so():
    done = start(None, os.getpid())
    assert done.returncode == 1
    assert "the learner closed it before the message that was waited for" in done.stderr


def test_a_first_message_that_is_no_spec_is_refused():
    ours, theirs = socket.socketpair()
    with ours, theirs:
        Channel(ours, peer="").send(Stop())
        done = start(theirs.recv(1000), os.getpid())
    assert done.returncode == 1
    assert "first message: got Stop, want ActorSpec" in done.stderr


def test_a_worker_whose_parent_has_gone_ends_at_once():
    done = start(None, os.getpid() + 1)
    assert (done.returncode, done.stderr) == (1, "")


def test_what_it_fails_of_is_said_also_where_the_disk_with_its_log_is_full(tmp_path: Path, ring: RingReader):
    pool_config = config(tmp_path, {"fault": "no_start"}, num_actors=1)
    with full_disk(0):  # the process inherits it
        process = start_actor(pool_config.actor_specs(lanes_to_begin_with(pool_config, None))[0], ring, None)
    try:
        assert process.wait(60)
        (fault,) = process.channel.receive()
        assert isinstance(fault, Fault)
        assert (fault.kind, fault.message) == ("exception", "RuntimeError: no engine today")
    finally:
        process.end(grace_s=0.0)


def test_told_to_stop_it_ends_well(spec: ActorSpec, ring: RingReader, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_max_isa=AVX2")
    process = start_actor(spec, ring, None)
    try:
        while not any(isinstance(message, Ready) for message in process.channel.receive()):
            assert process.exit_text() is None
            ring.read(100)
        environment = Path(f"/proc/{process.pid}/environ").read_text().split("\0")
        flags = "XLA_FLAGS=--xla_cpu_max_isa=AVX2 --xla_cpu_multi_thread_eigen=false"
        assert flags in environment, "the user's flags hold for actors too"
        process.channel.send(Stop())
        assert process.wait(30)
        assert process.exit_text() == "exited with code 0"
        assert ring.writer_status().state == WriterState.STOPPED
        assert records.last_lines(log_path(spec)) == []
    finally:
        process.end(grace_s=0.0)


def test_it_hears_of_the_end_also_where_its_ring_never_fills(
    spec: ActorSpec, ring: RingReader, channels: tuple[Channel, Channel], monkeypatch: pytest.MonkeyPatch
):
    actor, steps = Worker(spec, channels[1], ring.descriptor, None), []

    def step() -> None:
        steps.append(1)
        assert len(steps) < 10, "it was told to stop"
        if len(steps) == 3:
            channels[0].send(Stop())

    monkeypatch.setattr(actor._loop, "step", step)
    actor.run()
    assert len(steps) == 3


def test_a_learner_that_never_reads_is_given_up(
    spec: ActorSpec, ring: RingReader, channels: tuple[Channel, Channel], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(worker, "SPACE_TIMEOUT_S", 0.05)
    with pytest.raises(WaitTimeoutError, match=r"waited 0\.\d s for the learner to read; 0 of \d+ records are free"):
        Worker(spec, channels[1], ring.descriptor, None).run()


def test_a_learner_that_never_publishes_is_given_up(
    make_worker: Callable[[], Worker], channels: tuple[Channel, Channel], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(worker, "PARAMS_TIMEOUT_S", 0.05)
    with pytest.raises(WaitTimeoutError, match="actor 0 waited 0 s for the learner to publish the first parameters"):
        make_worker().run()
    channels[0].send(Stop())
    make_worker().run()  # told to stop, it does not wait


def test_taking_parameters_keeps_to_its_share_of_the_time(
    make_worker: Callable[[], Worker], queue: BroadcastWriter, monkeypatch: pytest.MonkeyPatch
):
    actor = make_worker()
    assert not actor._take_params()
    for share, taken in ((1e9, True), (1e9, True), (1e-9, True), (1e-9, False)):
        monkeypatch.setattr(worker, "MAX_PARAMS_SHARE", share)
        queue.publish(*params(1))
        assert actor._take_params() == taken


def test_a_pause_ends_no_wait_for_parameters_and_delays_no_taking_of_them(
    make_worker: Callable[[], Worker], queue: BroadcastWriter, monkeypatch: pytest.MonkeyPatch
):
    actor, pause, looks = make_worker(), make_pause(monkeypatch), []

    def stopped_once() -> bool:
        looks.append(1)
        if len(looks) == 2:
            pause(7200)
        elif len(looks) == 4:
            queue.publish(*params(1))
        return False

    set_params = actor._loop.set_params
    monkeypatch.setattr(actor._loop, "set_params", lambda *newest: (pause(7200), set_params(*newest)))
    monkeypatch.setattr(actor, "_must_stop", stopped_once)
    assert actor._wait_for_params()
    queue.publish(*params(2))
    pause(60)
    assert actor._take_params()
