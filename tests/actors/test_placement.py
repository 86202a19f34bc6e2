"""Actors and their engines on one core: which, and that the processes really are kept to it."""

import os
from collections.abc import Iterator
from pathlib import Path

import msgspec
import psutil
import pytest
from test_doom import config

from actors import placement
from actors.placement import actor_cores, cores_left, give_back, in_words
from actors.process_pool import ProcessPool
from gvz.core.errors import ConfigError


@pytest.fixture(autouse=True)
def no_cores_held(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    tmp_path.chmod(0o700)
    monkeypatch.setenv("GVZ_RUNTIME_DIR", str(tmp_path))
    yield
    give_back()


@pytest.fixture
def four_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0, 1, 2, 3})
    monkeypatch.setattr(placement, "num_cores", lambda: 4)
    monkeypatch.setattr(placement.psutil, "cpu_percent", lambda *_, **__: [5.0, 95.0, 5.0, 5.0])


@pytest.mark.usefixtures("four_cores")
def test_actors_get_cores_of_their_own_where_there_is_room():
    assert actor_cores("pinned", 3) == [3, 2, 1]
    assert actor_cores("pinned", 5) == [3, 2, 1, 0, 3]
    assert actor_cores("free", 1) == [None]
    assert actor_cores("auto", 2) == [3, 2]  # core 0 is idle, too: the learner's
    assert actor_cores("auto", 3) == [None] * 3  # core 1 is busy
    assert actor_cores("auto", 4) == [None] * 4
    assert cores_left([3, 2]) == {0, 1}
    assert cores_left([3, 2, 1, 0]) == {0, 1, 2, 3}
    assert cores_left([None]) == {0, 1, 2, 3}


@pytest.mark.usefixtures("four_cores")
def test_a_quota_of_processor_time_leaves_no_room_for_own_cores(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(placement, "num_cores", lambda: 2)
    assert actor_cores("auto", 1) == [3]
    assert actor_cores("auto", 2) == [None] * 2


@pytest.mark.usefixtures("four_cores")
def test_runs_that_start_at_once_have_different_cores(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)))
    monkeypatch.setattr(placement, "num_cores", lambda: 8)
    monkeypatch.setattr(placement.psutil, "cpu_percent", lambda *_, **__: [5.0] * 8)
    assert actor_cores("auto", 2) == [7, 6], "core 5 is the learner's"
    assert actor_cores("auto", 2) == [7, 6], "the next pool of the same process"
    first = list(placement._locks)
    monkeypatch.setattr(placement, "_locks", [])  # as in another process
    assert actor_cores("auto", 5) == [None] * 5
    assert actor_cores("auto", 4) == [4, 3, 2, 1]
    give_back()
    for lock in first:  # the first run ends
        lock.close()
    assert actor_cores("auto", 5) == [7, 6, 5, 4, 3]


def test_the_log_says_where_actors_are():
    assert in_words([3, 2]) == "each actor with its engines on one core (2, 3)"
    assert in_words([None]) == in_words([]) == "actors and engines on any core"


def test_every_actor_wants_a_core_or_none(tmp_path):
    with pytest.raises(ConfigError, match=r"got cores \(3,\), want one for each of 2 actors, or none"):
        msgspec.structs.replace(config(tmp_path, num_actors=2), cores=(3,))


@pytest.mark.engine
def test_an_actor_and_its_engines_are_kept_to_its_core_and_the_learner_to_the_others(tmp_path):
    mine = os.sched_getaffinity(0)
    cores = actor_cores("pinned", 1)
    pool_config = msgspec.structs.replace(config(tmp_path, num_actors=1, second_task="gore"), cores=tuple(cores))
    with ProcessPool(pool_config) as pool:
        while pool.statistics().actors_ready < 1:
            pool.drain(64, wait_s=0.05)
            pool.poll()
        actor = psutil.Process(pool.writer_statuses()[0].pid)
        engines = [child for child in actor.children(recursive=True) if "vizdoom" in child.name()]
        assert len(engines) == 2
        for process in (actor, *engines):
            threads = [os.sched_getaffinity(thread.id) for thread in process.threads()]
            assert threads == [set(cores)] * len(threads)
        assert os.sched_getaffinity(0) == cores_left(cores)
    assert os.sched_getaffinity(0) == mine
