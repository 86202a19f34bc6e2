"""The pool of actor processes under every fault: detected, replaced within a budget, nothing published lost."""

import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import psutil
import pytest
from fake_env import FRAME_SHAPE, Checker, config

from actors import supervisor
from actors.config import ActorsConfig
from actors.pool import ActorPool, PoolConfig
from actors.process import ActorProcess
from gvz import janitor
from gvz.errors import ConfigError, ResumeError, WorkerError
from gvz.transport.messages import EpisodeStats, Fault, Message, ParamsHeader, Ready
from gvz.transport.ring import WriterState

DEADLINE_S = 240.0


class Run:
    """A pool that is drained and polled until something has happened, every record checked."""

    def __init__(self, pool: ActorPool, pool_config: PoolConfig):
        self.pool = pool
        self.checker = Checker(pool_config)
        self.messages: list[Message] = []

    def until(self, done: Callable[[], bool]) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not done():
            assert time.monotonic() < deadline, self.messages
            self.checker.add(self.pool.drain(100, wait_s=0.01))
            self.messages += self.pool.poll()

    def play(self, num_records: int) -> None:
        wanted = self.checker.num_records + num_records
        self.until(lambda: self.checker.num_records >= wanted)

    def faults(self) -> list[Fault]:
        return [m for m in self.messages if isinstance(m, Fault)]

    def first_episodes(self) -> dict[int, int]:
        """Number of the first episode that each lane has reported."""
        return {m.lane: m.episode for m in reversed(self.messages) if isinstance(m, EpisodeStats)}

    def until_all_ready(self) -> list[int]:
        """Process ids, by actor."""
        self.until(lambda: self.pool.statistics().actors_ready == 2)
        return [status.pid for status in self.pool.writer_statuses()]


def segments() -> set[Path]:
    return {path for path in Path("/dev/shm").iterdir() if path.name.startswith(f"gvz-{os.getpid()}-")}


def alive(pid: int) -> bool:
    return janitor.process_start(pid) is not None


def test_records_come_from_all_actors_and_episodes_are_reported(tmp_path: Path):
    pool_config = config(tmp_path, {})
    with ActorPool(pool_config) as pool:
        run = Run(pool, pool_config)
        pids = run.until_all_ready()
        for pid in pids:
            assert os.getsid(pid) == pid, "a terminal's Ctrl-C does not reach the actors"
            os.kill(pid, signal.SIGINT)  # and another's changes nothing
        run.play(2000)
        stats = pool.statistics()
        assert len(segments()) == 2
    assert not segments()
    assert not any(alive(pid) for pid in pids)
    assert sorted(m.actor for m in run.messages if isinstance(m, Ready)) == [0, 1]
    episodes = [m for m in run.messages if isinstance(m, EpisodeStats)]
    assert {m.lane for m in episodes} == {0, 1, 2, 3}
    assert all(m.length_steps == 10 and m.reward == 55.0 and not m.cut for m in episodes)
    assert run.checker.num_cuts == 0
    assert stats.restarts == 0
    assert stats.episodes == len(episodes)
    assert stats.env_steps == pytest.approx(run.checker.num_records * 10 / 11, rel=0.02)
    assert stats.waited_for_records_s > 0


def test_full_rings_hold_the_actors_back_and_lose_nothing(tmp_path: Path):
    pool_config = config(tmp_path, {}, actors=ActorsConfig(ring_capacity=16))
    with ActorPool(pool_config) as pool:
        run = Run(pool, pool_config)
        run.until_all_ready()
        run.play(100)
        time.sleep(1.0)  # the learner is busy with something else
        assert {status.state for status in pool.writer_statuses()} == {WriterState.WAITING_FOR_SPACE}
        assert pool.statistics().waited_for_space_s > 1.0
        run.play(200)
        assert pool.statistics().restarts == 0
    assert run.checker.num_cuts == 0


def test_draining_is_fair_and_bounded(tmp_path: Path):
    pool_config = config(tmp_path, {}, actors=ActorsConfig(ring_capacity=64))
    with ActorPool(pool_config) as pool:
        pids = Run(pool, pool_config).until_all_ready()
        time.sleep(0.5)  # both rings are full
        assert sorted(len(block) for block in pool.drain(11)) == [5, 6]
        assert pool.drain(0) == []
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
        actors = [int(pool.drain(1)[0].steps["lane"][0]) // 2 for _ in range(6)]
        assert min(actors.count(0), actors.count(1)) >= 2, "single records come from the fuller ring"
        numbers = [len(block) for block in pool.drain(200)]
        assert sum(numbers) > 100, "what one does not have the other gives"
        pool.close(grace_s=0.0)


@pytest.mark.parametrize("fault", ["kill", "raise", "segfault"])
def test_a_dead_actor_is_replaced_and_nothing_published_is_lost(tmp_path: Path, fault: str):
    options = {} if fault == "kill" else {"fault": fault, "fault_at": 57, "fault_file": str(tmp_path / "struck")}
    pool_config = config(tmp_path / "work", options)
    with ActorPool(pool_config) as pool:
        run = Run(pool, pool_config)
        pids = run.until_all_ready()
        run.play(200)
        if fault == "kill":
            os.kill(pids[0], signal.SIGKILL)
        start = time.monotonic()
        run.until(lambda: any(f.kind == "died" for f in run.faults()))
        assert time.monotonic() - start < 10
        run.until(lambda: len([m for m in run.messages if isinstance(m, Ready)]) == 3)
        run.play(500)
        assert pool.statistics().restarts == 1
        died = next(f for f in run.faults() if f.kind == "died")
    assert len({m.pid for m in run.messages if isinstance(m, Ready)}) == 3
    if fault != "kill":  # which may hit between two episodes
        assert run.checker.num_cuts == 2, "both games were in the middle of an episode"
    ending = {"kill": "was ended by SIGKILL", "raise": "exited with code 1", "segfault": "was ended by SIGSEGV"}[fault]
    assert died.message == f"actor {died.actor} {ending}; restart 1 of 20 in 0.50 s"
    if fault == "raise":
        told = next(f for f in run.faults() if f.kind == "exception")
        assert (told.fatal, told.message) == (True, "RuntimeError: this step was meant to fail")
        assert "in step" in told.traceback
    if fault == "segfault":
        assert "Fatal Python error: Segmentation fault" in died.traceback
        assert "fake_env.py" in died.traceback


def test_many_kills_lose_nothing_and_leak_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(supervisor, "_STABLE_S", 0.0)  # no waiting: this actor is not to blame
    pool_config = config(tmp_path, {})
    with ActorPool(pool_config) as pool:
        run = Run(pool, pool_config)
        run.until_all_ready()
        me = psutil.Process()
        before = (me.num_fds(), len(me.children()), len(segments()))
        for kill in range(6):
            os.kill(pool.writer_statuses()[kill % 2].pid, signal.SIGKILL)
            run.until(lambda wanted=kill + 1: pool.statistics().restarts == wanted)
            run.until_all_ready()
            run.play(300)
        after = (me.num_fds(), len(me.children()), len(segments()))
        assert pool.statistics().restarts == 6
    assert after == before


@pytest.mark.parametrize("fault", ["stop", "hang"])
def test_a_stuck_actor_shows_its_stacks_and_is_replaced(tmp_path: Path, fault: str):
    # a slow game: when stopped, an actor is hardly ever at anything else than a decision
    options = (
        {"step_s": 0.005}
        if fault == "stop"
        else {"fault": "hang", "fault_at": 57, "fault_file": str(tmp_path / "struck")}
    )
    pool_config = config(tmp_path / "work", options, actors=ActorsConfig(heartbeat_timeout_s=2.0))
    with ActorPool(pool_config) as pool:
        run = Run(pool, pool_config)
        pids = run.until_all_ready()
        run.play(200)
        if fault == "stop":
            os.kill(pids[1], signal.SIGSTOP)
        run.until(lambda: bool(run.faults()))
        run.until(lambda: len([m for m in run.messages if isinstance(m, Ready)]) == 3)
        run.play(500)
    (stuck,) = run.faults()
    assert stuck.kind == "stuck"
    assert "gave no sign of life for 2." in stuck.message
    assert "(actors.heartbeat_timeout_s); it was acting" in stuck.message
    if fault == "hang":
        assert "in strike" in stuck.traceback, "faulthandler wrote where it hangs"
        assert run.checker.num_cuts == 2, "both games were in the middle of an episode"


def test_the_learners_own_sleep_is_not_the_actors_silence(tmp_path: Path):
    pool_config = config(tmp_path, {}, actors=ActorsConfig(heartbeat_timeout_s=1.0))
    with ActorPool(pool_config) as pool:
        run = Run(pool, pool_config)
        pids = run.until_all_ready()
        for pid in pids:  # the whole machine sleeps
            os.kill(pid, signal.SIGSTOP)
        time.sleep(2.0)
        for pid in pids:
            os.kill(pid, signal.SIGCONT)
        run.play(500)
        assert pool.statistics().restarts == 0


def test_an_actor_that_starts_too_slowly_is_named(tmp_path: Path):
    pool_config = config(tmp_path, {}, actors=ActorsConfig(start_timeout_s=0.05, max_restarts=0))
    with ActorPool(pool_config) as pool, pytest.raises(WorkerError, match=r"had not started its games after \d+\.\d s"):
        Run(pool, pool_config).until(lambda: False)


def test_a_spent_budget_is_an_error_that_tells_why(tmp_path: Path):
    pool_config = config(
        tmp_path, {"fault": "no_start", "fault_task": "b"}, actors=ActorsConfig(max_restarts=2, restart_window_s=100)
    )
    with ActorPool(pool_config) as pool:
        run = Run(pool, pool_config)
        with pytest.raises(WorkerError) as raised:
            run.until(lambda: False)
    text = str(raised.value)
    assert "exited with code 1; that was end 3 within 100 s, and actors.max_restarts allows 2 restarts." in text
    assert f"The end of {tmp_path / 'actor_'}" in text
    assert text.endswith("RuntimeError: no engine today")
    assert [f.kind for f in run.faults() if f.fatal][-1] == "gave_up", "what it said last came before the error"
    waits = [
        f.message.rsplit(" in ", 1)[1] for f in run.faults() if f.kind == "died" and f.actor == run.faults()[-1].actor
    ]
    assert waits[:2] == ["0.50 s", "1.00 s"], "each failed start waits longer"


def test_a_process_that_cannot_be_started_again_counts_as_one_that_failed(tmp_path: Path):
    pool_config = config(tmp_path / "work", {}, actors=ActorsConfig(max_restarts=2))
    with ActorPool(pool_config) as pool:
        run = Run(pool, pool_config)
        pids = run.until_all_ready()
        shutil.rmtree(tmp_path / "work")
        (tmp_path / "work").touch()  # where the logs go
        os.kill(pids[0], signal.SIGKILL)
        with pytest.raises(WorkerError, match=r"actor 0 could not be started \(.*exists.*\); that was end 3 within"):
            run.until(lambda: False)
    assert [fault.kind for fault in run.faults()] == ["died", "died", "gave_up"]
    assert run.faults()[-1].fatal


def test_an_actor_that_tells_of_anothers_game_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pool_config = config(tmp_path, {})
    receive = ActorProcess.receive

    def receive_a_strangers(process: ActorProcess) -> list[Message]:
        monkeypatch.setattr(ActorProcess, "receive", receive)  # once
        stranger = next(m for m in run.messages if isinstance(m, EpisodeStats) and m.lane == 3)
        return [*receive(process), stranger]

    with ActorPool(pool_config) as pool:
        run = Run(pool, pool_config)
        run.until_all_ready()
        run.until(lambda: 3 in run.first_episodes())
        monkeypatch.setattr(ActorProcess, "receive", receive_a_strangers)
        run.until(lambda: pool.statistics().restarts == 1)
        run.play(300)
    (fault,) = run.faults()
    assert "actor 0 sent what is no message of its own (got an episode of lane 3, task 1, want lane: task of {" in (
        fault.message
    )


def test_a_new_process_begins_new_episodes_even_if_the_old_one_wrote_nothing(tmp_path: Path):
    options = {"fault": "no_start", "fault_file": str(tmp_path / "struck")}
    pool_config = config(tmp_path / "work", options)
    with ActorPool(pool_config) as pool:
        run = Run(pool, pool_config)
        run.until(lambda: len(run.first_episodes()) == 4)
        episodes = np.array(pool.state()["next_episodes"])
    assert (episodes > 0).all()
    assert sorted(run.first_episodes().values()) == [0, 0, 1, 1]


def test_a_resumed_pool_goes_on_with_new_episodes(tmp_path: Path):
    pool_config = config(tmp_path, {})
    with ActorPool(pool_config) as pool:
        run = Run(pool, pool_config)
        run.play(300)
        state = pool.state()
    assert max(int(step["episode"]) for step in run.checker.last.values()) < max(state["next_episodes"])
    with ActorPool(pool_config, state) as pool:
        resumed = Run(pool, pool_config)
        resumed.until(lambda: len(resumed.first_episodes()) == 4)
    assert [resumed.first_episodes()[lane] for lane in range(4)] == state["next_episodes"]


def test_a_state_of_another_size_is_refused(tmp_path: Path):
    with pytest.raises(ResumeError, match=r"got 3 lanes, want 4 \(2 actors with 2 games\)"):
        ActorPool(config(tmp_path, {}), {"next_episodes": [0, 0, 0]})


def constant_policy() -> bytes:
    """Plays its first parameter."""

    def act(params, _obs, task, _key, _epsilon):
        return jnp.full(len(task), params[0][0].astype(jnp.int32))

    arguments = (
        [jax.ShapeDtypeStruct((1000,), jnp.float32)],
        jax.ShapeDtypeStruct((2, *FRAME_SHAPE[:2], 4 * FRAME_SHAPE[2]), jnp.uint8),
        jax.ShapeDtypeStruct((2,), jnp.int32),
        jax.ShapeDtypeStruct((2,), jnp.uint32),
        jax.ShapeDtypeStruct((), jnp.float32),
    )
    return bytes(jax.export.export(jax.jit(act), platforms=["cpu"])(*arguments).serialize())


def test_published_parameters_are_acted_by_and_recorded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    pool_config = config(tmp_path / "work", {}, policy=constant_policy(), num_params=1000, layout_hash=99)
    with ActorPool(pool_config) as pool:
        run = Run(pool, pool_config)
        assert sum(path.stat().st_size for path in segments()) == pool_config.shared_memory_bytes() + 3 * 64
        time.sleep(0.2)
        assert pool.drain(100) == [], "nobody acts before there are parameters"
        for version in (1, 2, 3):
            header = ParamsHeader(version=version, num_updates=0, layout_hash=99)
            pool.publish(np.full(1000, version, np.float32), header)
            seen: set[int] = set()
            deadline = time.monotonic() + DEADLINE_S
            while seen != {0, 1}:
                assert time.monotonic() < deadline
                run.messages += pool.poll()
                for block in pool.drain(100, wait_s=0.01):
                    steps = block.steps[block.steps["terminated"] == 0]
                    np.testing.assert_array_equal(steps["action"], steps["params_version"])
                    if (steps["params_version"] == version).any():
                        seen.add(int(steps["lane"][0]) // 2)
    assert not run.faults()
    assert list((tmp_path / "cache" / "xla").iterdir()), "the compiled function is kept for the next start"


def test_closing_is_quick_bounded_and_repeatable(tmp_path: Path):
    options = {"fault": "hang", "fault_at": 20}
    pool_config = config(tmp_path, options)
    pool = ActorPool(pool_config)
    run = Run(pool, pool_config)
    pids = run.until_all_ready()
    os.kill(pids[0], signal.SIGSTOP)
    start = time.monotonic()
    pool.close(grace_s=0.5)
    pool.close()
    assert time.monotonic() - start < 5.0
    assert not any(alive(pid) for pid in pids)
    assert not segments()


def test_closing_while_the_actors_start_leaves_nothing(tmp_path: Path):
    pool = ActorPool(config(tmp_path, {}))
    pids = {child.pid for child in psutil.Process().children()}
    pool.close()
    assert len(pids) >= 2
    assert not any(alive(pid) for pid in pids)
    assert not segments()


_PARENT = """
import os, sys, time
sys.path.append({tests!r})
from pathlib import Path
from actors.pool import ActorPool
from fake_env import config
pool = ActorPool(config(Path({work!r}), {{}}))
while pool.statistics().actors_ready < 2:
    pool.drain(100)
    pool.poll()
print(*[status.pid for status in pool.writer_statuses()], flush=True)
time.sleep(600)
"""


def test_a_killed_learner_takes_its_actors_along_and_the_next_start_cleans_up(tmp_path: Path):
    code = textwrap.dedent(_PARENT).format(tests=str(Path(__file__).parent), work=str(tmp_path))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pids = [int(word) for word in parent.stdout.readline().split()]
        assert len(pids) == 2
        assert all(alive(pid) for pid in pids)
        parent.kill()
    deadline = time.monotonic() + 10.0
    while any(alive(pid) for pid in pids):
        assert time.monotonic() < deadline, "actors outlive their learner"
        time.sleep(0.05)
    left = [path for path in Path("/dev/shm").iterdir() if path.name.startswith(f"gvz-{parent.pid}-")]
    assert len(left) == 2
    removed = janitor.clean_dead_instances()
    assert not any(path.exists() for path in left)
    assert {f"shared memory {path.name}" for path in left} <= set(removed)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"tasks": ("a", "b", "c", "d", "e")}, "got 2 actors with 2 games for 5 tasks, want at least one game a task"),
        ({"num_actors": 2**15, "games_per_actor": 3}, "got 98304 games, want at most 65536"),
    ],
)
def test_sizes_that_do_not_fit_are_refused(tmp_path: Path, changes: dict[str, Any], text: str):
    with pytest.raises(ConfigError, match=text):
        config(tmp_path, {}, **changes)


@pytest.mark.parametrize(("asked", "games", "got"), [(256, 4, 256), (256, 6, 258), (8, 9, 18), (8, 4, 8)])
def test_rings_hold_whole_steps_at_least_two(tmp_path: Path, asked: int, games: int, got: int):
    pool_config = config(tmp_path, {}, games_per_actor=games, actors=ActorsConfig(ring_capacity=asked))
    assert pool_config.ring_capacity == got
