"""The pool of actor processes: records, fairness, parameters, resumption, its end."""

import os
import signal
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
from fake_env import config, first_param_policy
from watched_pool import DEADLINE_S, Run, alive, playing, segments

from actors.config import ActorsConfig
from actors.process_pool import ProcessPool
from gvz.core.errors import ConfigError, ResumeError
from gvz.transport.messages import EpisodeStats, ParamsHeader, Ready


def test_records_come_from_all_actors_and_episodes_are_reported(tmp_path: Path):
    with playing(config(tmp_path, {})) as run:
        pids = run.until_all_ready()
        for pid in pids:
            assert os.getpgid(pid) == pid, "a terminal's Ctrl-C does not reach the actors"
            os.kill(pid, signal.SIGINT)  # and another's changes nothing
        run.play(2000)
        stats = run.pool.statistics()
        assert len(segments()) == 2
    assert not segments()
    assert not any(alive(pid) for pid in pids)
    assert sorted(m.actor for m in run.messages if isinstance(m, Ready)) == [0, 1]
    episodes = [m for m in run.messages if isinstance(m, EpisodeStats)]
    assert {m.lane for m in episodes} == {0, 1, 2, 3}
    assert all(m.length_steps == 10 and m.reward == 55.0 and not m.cut for m in episodes)
    assert run.checker.num_cuts == 0
    assert stats.restarts == 0
    assert stats.env_steps == pytest.approx(run.checker.num_records * 10 / 11, rel=0.02)
    assert stats.waited_for_records_s > 0


def test_full_rings_hold_the_actors_back_and_lose_nothing(tmp_path: Path):
    with playing(config(tmp_path, {}, actors=ActorsConfig(ring_capacity=16))) as run:
        run.until_all_ready()
        run.play(100)
        run.until_all_full()
        time.sleep(1.0)  # the learner is busy with something else
        assert run.pool.statistics().waited_for_space_s > 1.0
        run.play(200)
        assert run.pool.statistics().restarts == 0
    assert run.checker.num_cuts == 0


def test_draining_is_fair_and_bounded(tmp_path: Path):
    with playing(config(tmp_path, {}, actors=ActorsConfig(ring_capacity=64))) as run:
        pids = run.until_all_ready()
        run.until_all_full()
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)  # so they do not fill the rings again
        assert sorted(len(block) for block in run.pool.drain(11)) == [5, 6]
        assert run.pool.drain(0) == []
        actors = [int(run.pool.drain(1)[0].steps["lane"][0]) // 2 for _ in range(6)]
        assert min(actors.count(0), actors.count(1)) >= 2, "single records come from the fuller ring"
        numbers = [len(block) for block in run.pool.drain(200)]
        assert sum(numbers) > 100, "what one does not have the other gives"
        run.pool.close(grace_s=0.0)


def test_a_new_process_begins_new_episodes_even_if_the_old_one_wrote_nothing(tmp_path: Path):
    options = {"fault": "no_start", "fault_file": str(tmp_path / "struck")}
    with playing(config(tmp_path / "work", options)) as run:
        run.until(lambda: len(run.first_episodes()) == 4)
        episodes = np.array(run.pool.state()["next_episodes"])
    assert (episodes > 0).all()
    assert sorted(run.first_episodes().values()) == [0, 0, 1, 1]


def test_a_resumed_pool_goes_on_with_new_episodes(tmp_path: Path):
    pool_config = config(tmp_path, {})
    with playing(pool_config) as run:
        run.play(300)
        run.until_all_full()
        unread = np.concatenate([actor.ring.peek(1000).steps for actor in run.pool._actors])
        state = run.pool.state()
    assert (unread["episode"] < np.array(state["next_episodes"])[unread["lane"]]).all()
    with playing(pool_config, state) as resumed:
        resumed.until(lambda: len(resumed.first_episodes()) == 4)
    assert [resumed.first_episodes()[lane] for lane in range(4)] == state["next_episodes"]


def test_a_lane_plays_its_new_task_from_its_next_episode_on_also_after_a_restart_and_a_resume(tmp_path: Path):
    pool_config = config(tmp_path, {})
    with playing(pool_config) as run:
        run.until_all_ready()
        run.checker.assigned = {0: 1, 2: 1}
        run.pool.assign(2, 1)
        run.until(lambda: any(isinstance(m, EpisodeStats) and (m.lane, m.task) == (2, 1) for m in run.messages))
        run.pool.assign(0, 1)
        os.kill(run.pool.writer_statuses()[0].pid, signal.SIGKILL)
        run.until(lambda: run.pool.statistics().restarts == 1 and run.pool.statistics().actors_ready == 2)
        before = len(run.messages)
        run.until(lambda: any(isinstance(m, EpisodeStats) and m.lane == 0 for m in run.messages[before:]))
        state = run.pool.state()
    tasks = {lane: [m.task for m in run.messages if isinstance(m, EpisodeStats) and m.lane == lane] for lane in (0, 2)}
    assert tasks[0][-1] == 1
    assert sorted(tasks[2]) == tasks[2], "task 0 first, then task 1"
    assert state["tasks"] == [1, 1, 1, 1]
    with playing(pool_config, state) as resumed:
        resumed.checker.assigned = run.checker.assigned
        resumed.until(lambda: len(resumed.checker.last) == 4)
    assert {int(step["task"]) for step in resumed.checker.last.values()} == {1}


def test_a_state_of_another_size_is_refused(tmp_path: Path):
    with pytest.raises(ResumeError, match=r"got 3 lanes, want 4 \(2 actors with 2 games\)"):
        ProcessPool(config(tmp_path, {}), {"next_episodes": [0, 0, 0], "tasks": [0, 1, 0]})


def test_published_parameters_are_acted_by_and_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR")
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    pool_config = config(tmp_path / "work", {}, policy=first_param_policy(1000), num_params=1000, layout_hash=99)
    with playing(pool_config) as run:
        assert sum(segments().values()) == pool_config.shared_memory_bytes() + 3 * 64
        time.sleep(0.2)
        assert run.pool.drain(100) == [], "nobody acts before there are parameters"
        for version in (1, 2, 3):
            header = ParamsHeader(version=version, num_updates=0, layout_hash=99)
            run.pool.publish(np.full(1000, version, np.float32), header)
            seen: set[int] = set()
            deadline = time.monotonic() + DEADLINE_S
            while seen != {0, 1}:
                assert time.monotonic() < deadline
                run.messages += run.pool.poll()
                for block in run.pool.drain(100, wait_s=0.01):
                    steps = block.steps[block.steps["terminated"] == 0]
                    np.testing.assert_array_equal(steps["action"], steps["params_version"])
                    if (steps["params_version"] == version).any():
                        seen.add(int(steps["lane"][0]) // 2)
    assert not run.faults()
    assert list((tmp_path / "cache" / "xla").iterdir()), "the compiled function is kept for the next start"


def test_closing_is_quick_bounded_and_repeatable(tmp_path: Path):
    options = {"fault": "hang", "fault_at": 20}
    pool_config = config(tmp_path, options)
    pool = ProcessPool(pool_config)
    run = Run(pool, pool_config)
    pids = run.until_all_ready()
    os.kill(pids[0], signal.SIGSTOP)
    start = time.monotonic()
    pool.close(grace_s=0.5)
    pool.close()
    assert time.monotonic() - start < 60  # on a loaded machine; the grace is half a second
    assert not any(alive(pid) for pid in pids)
    assert not segments()


def test_closing_while_the_actors_start_leaves_nothing(tmp_path: Path):
    pool = ProcessPool(config(tmp_path, {}))
    pids = {child.pid for child in psutil.Process().children()}
    pool.close()
    assert len(pids) >= 2
    assert not any(alive(pid) for pid in pids)
    assert not segments()


def test_more_games_than_records_can_name_are_refused(tmp_path: Path):
    with pytest.raises(ConfigError, match="got 98304 games, want at most 65536"):
        config(tmp_path, {}, num_actors=2**15, games_per_actor=3)
    config(tmp_path, {}, tasks=("a", "b", "c", "d", "e"))  # fewer games than tasks, which they may draw


@pytest.mark.parametrize(("asked", "games", "got"), [(256, 4, 256), (256, 6, 258), (8, 9, 18), (8, 4, 8)])
def test_rings_hold_whole_steps_at_least_two(tmp_path: Path, asked: int, games: int, got: int):
    pool_config = config(tmp_path, {}, games_per_actor=games, actors=ActorsConfig(ring_capacity=asked))
    assert pool_config.ring_capacity == got
