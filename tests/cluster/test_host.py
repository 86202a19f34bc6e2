"""A host without Ray: batches in order, nothing lost, parameters and tasks in, its own end, and nothing left."""

import time
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from fake_env import Checker, config, export_act

from actors.config import ActorsConfig
from actors.pool import PoolConfig
from actors.preprocess import ObservationBatch
from gvz.cluster import host, wire
from gvz.cluster.hello import Hello, differences, hello
from gvz.cluster.host import Host, HostSpec
from gvz.core import janitor
from gvz.transport.messages import EpisodeStats, Message, ParamsHeader, Ready
from tests.test_segmentation import write_network

DEADLINE_S = 120.0


def spec(pool: PoolConfig, first_episode: int = 0, **changes) -> HostSpec:
    lanes = pool.lanes
    state = {"next_episodes": [first_episode] * len(lanes), "tasks": [lane % len(pool.tasks) for lane in lanes]}
    return HostSpec(
        **{"run_id": "r", "host": 1, "incarnation": 3, "batch_records": 100, "compress": True, **changes},
        pool=pool,
        state=state,
    )


def second_half(work_dir: Path, options: dict, **changes) -> PoolConfig:
    """Actors 2 and 3 of 4."""
    return msgspec.structs.replace(config(work_dir, options, **changes), first_actor=2, run_actors=4)


class Asker:
    """Asks a host for batches, and checks all that comes."""

    def __init__(self, pool: PoolConfig, playing: Host):
        self.pool, self.host = pool, playing
        self.checker = Checker(pool)
        self.headers: list[wire.BatchHeader] = []
        self.messages: list[Message] = []

    def until(self, done: Callable[[], bool], assigned: tuple[tuple[int, int], ...] = ()) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not done():
            assert time.monotonic() < deadline, self.messages
            batch = wire.unpack(self.host.next_batch(assigned), self.pool.record_dtype, self.pool.frame_shape, 100)
            self.headers.append(batch.header)
            self.messages += batch.messages
            self.checker.add([batch.block])
            assigned = ()


def test_batches_come_in_order_and_lose_nothing(tmp_path: Path):
    pool = second_half(tmp_path, {"length": 20})
    playing = Host(spec(pool, first_episode=5))
    try:
        asker = Asker(pool, playing)

        def largest() -> int:
            return max(header.num_records for header in asker.headers)

        asker.until(lambda: asker.checker.num_records >= 1000 and len(asker.checker.last) == 4 and largest() >= 100)
    finally:
        assert playing.close(30.0)
    assert [header.number for header in asker.headers] == list(range(len(asker.headers)))
    assert {(h.run_id, h.host, h.incarnation) for h in asker.headers} == {("r", 1, 3)}
    assert largest() == 100
    assert sorted(asker.checker.last) == [4, 5, 6, 7], "the lanes of actors 2 and 3 with two games each"
    assert {m.actor for m in asker.messages if isinstance(m, Ready)} == {2, 3}
    episodes = [m for m in asker.messages if isinstance(m, EpisodeStats)]
    assert min(m.episode for m in episodes) == 5
    assert asker.checker.num_cuts == 0
    assert asker.headers[-1].actors_ready == 2
    assert janitor.dead_instances() == []


def test_an_unasked_host_holds_its_actors_back(tmp_path: Path):
    pool = second_half(tmp_path, {"length": 20})
    playing = Host(spec(pool))
    try:
        asker = Asker(pool, playing)
        asker.until(lambda: asker.checker.num_records >= 100)
        time.sleep(2.0)  # in which it could have played some ten thousand
        asker.until(lambda: asker.headers[-1].waited_for_space_s > 1.0)
    finally:
        assert playing.close(30.0)


def test_a_lane_gets_another_task_and_actors_the_parameters(tmp_path: Path):
    games = ObservationBatch.of(config(tmp_path, {}), 2)
    policy = export_act(lambda leaves, *_: leaves[0][:2].astype("int32"), [(4,)], games)
    pool = second_half(tmp_path, {"length": 20}, policy=policy, num_params=4, layout_hash=7)
    playing = Host(spec(pool))
    try:
        asker = Asker(pool, playing)
        playing.set_params(np.full(4, 3.0, np.float32), ParamsHeader(version=9, num_updates=0, layout_hash=7))
        asker.until(lambda: len(asker.checker.last) == 4)
        assert {int(step["action"]) for step in asker.checker.last.values() if not step["terminated"]} <= {3}
        assert {int(step["params_version"]) for step in asker.checker.last.values()} == {9}
        asker.checker.assigned = {4: 1}
        asker.until(lambda: asker.checker.last[4]["task"] == 1, assigned=((4, 1),))
    finally:
        assert playing.close(30.0)


def test_an_empty_answer_is_a_sign_of_life(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(host, "ANSWER_S", 0.05)
    pool = second_half(tmp_path, {"step_s": 30.0})
    playing = Host(spec(pool))
    try:
        for number in range(3):
            header, _ = wire.read_header(playing.next_batch())
            assert (header.number, header.num_records, header.failure) == (number, 0, "")
    finally:
        assert playing.close(30.0)


def test_a_host_whose_actors_fail_for_good_says_why(tmp_path: Path):
    pool = second_half(tmp_path, {"fault": "no_start"}, actors=ActorsConfig(max_restarts=0))
    playing = Host(spec(pool))
    asker = Asker(pool, playing)
    asker.until(lambda: bool(asker.headers and asker.headers[-1].failure))
    assert "no engine today" in asker.headers[-1].failure
    assert asker.headers[-1].failure.startswith("WorkerError: actor ")
    assert playing.close(30.0)


def test_a_host_that_nobody_asks_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(host, "_ABANDONED_S", 0.5)
    pool = second_half(tmp_path, {})
    playing = Host(spec(pool))
    playing._pump.join(DEADLINE_S)
    asker = Asker(pool, playing)
    asker.until(lambda: bool(asker.headers and asker.headers[-1].failure))
    assert asker.headers[-1].failure.startswith("WaitTimeoutError: host 1 waited ")


# --------------------------------------------------------------------------------------------- hello


@pytest.mark.engine
def test_a_machine_says_what_it_would_play(tmp_path: Path):
    pool = PoolConfig(
        tasks=("defend_the_center/default", "seek_and_kill/procedural-train-10"),
        num_actors=1,
        games_per_actor=2,
        seed=1,
        env_entry_point="gvz.env:make_env",
        env_config={"frame_height": 36},
        frame_shape=(36, 84, 3),
        stack_size=4,
        num_actions=3,
        policy=b"",
        num_params=0,
        layout_hash=0,
        actors=ActorsConfig(),
        work_dir=Path(),
    )
    ours = hello(pool)
    assert differences(ours, ours) == []
    theirs = msgspec.msgpack.decode(host.greet(pool), type=Hello)
    assert theirs == ours
    assert set(ours.maps) == set(pool.tasks)
    assert hello(msgspec.structs.replace(pool, seed=2)).maps != ours.maps, "the map of an episode is drawn by the seed"
    segmented = msgspec.structs.replace(pool, env_config={"frames": "segmented"})
    network = str(write_network(tmp_path / "other.onnx"))
    other = msgspec.structs.replace(pool, env_config={"frames": "segmented", "segmenter": network})
    assert set(hello(segmented).maps.values()).isdisjoint(hello(other).maps.values())


def test_differences_are_named():
    ours = Hello(versions={"python": "3.11.7", "jax": "1"}, code="a", schemas=(4, 1), maps={"t": "m"})
    for change, text in (
        ({"versions": {"python": "3.11.8", "jax": "1"}}, "python: got 3.11.8, want 3.11.7"),
        ({"versions": {"python": "3.11.7"}}, "jax: got none, want 1"),
        ({"maps": {"t": "n"}}, "maps or networks of t: got n, want m"),
        ({"schemas": (3, 1)}, "schemas of messages and batches: got (3, 1), want (4, 1)"),
        ({"code": "b"}, "source files of GViZDoom: got digest b, want a"),
    ):
        assert differences(ours, msgspec.structs.replace(ours, **change)) == [text]


def test_a_machine_without_room_refuses(tmp_path: Path):
    pool = config(tmp_path, {}, num_actors=1000, games_per_actor=60)  # engines alone take 660 GB of /dev/shm
    assert "want" in msgspec.msgpack.decode(host.greet(pool), type=Hello).refusal
