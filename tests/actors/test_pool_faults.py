"""The pool of actor processes under every fault: detected, replaced within a budget, nothing published lost."""

import contextlib
import errno
import os
import shutil
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import psutil
import pytest
from fake_env import config
from watched_pool import alive, playing, segments

from actors import supervisor
from actors.config import ActorsConfig
from actors.process_pool import ProcessPool
from gvz.core.errors import ResourceError, WorkerError
from gvz.transport.channel import Channel
from gvz.transport.messages import EpisodeStats, Message, Ready
from tests.waiting import wait_until


@pytest.mark.parametrize("fault", ["kill", "raise", "segfault"])
def test_a_dead_actor_is_replaced_and_nothing_published_is_lost(tmp_path: Path, fault: str):
    options = {} if fault == "kill" else {"fault": fault, "fault_at": 57, "fault_file": str(tmp_path / "struck")}
    with playing(config(tmp_path / "work", options)) as run:
        pids = run.until_all_ready()
        run.play(200)
        if fault == "kill":
            os.kill(pids[0], signal.SIGKILL)
        run.until(lambda: any(f.kind == "died" for f in run.faults()))
        run.until(lambda: len([m for m in run.messages if isinstance(m, Ready)]) == 3)
        run.play(500)
        assert run.pool.statistics().restarts == 1
        died = next(f for f in run.faults() if f.kind == "died")
    assert len({m.pid for m in run.messages if isinstance(m, Ready)}) == 3
    if fault != "kill":  # which may hit between two episodes
        assert run.checker.num_cuts == 2, "both games were in the middle of an episode"
    ending = {"kill": "was ended by SIGKILL", "raise": "exited with code 1", "segfault": "was ended by SIGSEGV"}[fault]
    assert died.message == f"actor {died.actor} {ending}; restart 1 of 20 in 0.50 s"
    if fault == "raise":
        told = next(f for f in run.faults() if f.kind == "exception")
        assert told.message == "RuntimeError: this step was meant to fail"
        assert "in step" in told.traceback
    if fault == "segfault":
        assert "Fatal Python error: Segmentation fault" in died.traceback
        assert "fake_env.py" in died.traceback


def test_many_kills_lose_nothing_and_leak_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(supervisor, "_STABLE_S", 0.0)  # no waiting: this actor is not to blame
    with playing(config(tmp_path, {})) as run:
        run.until_all_ready()
        me = psutil.Process()
        before = (me.num_fds(), len(me.children()), len(segments()))
        for kill in range(6):
            os.kill(run.pool.writer_statuses()[kill % 2].pid, signal.SIGKILL)
            run.until(lambda wanted=kill + 1: run.pool.statistics().restarts == wanted)
            run.until_all_ready()
            run.play(300)
        after = (me.num_fds(), len(me.children()), len(segments()))
        assert run.pool.statistics().restarts == 6
    assert after == before


@pytest.mark.parametrize("fault", ["stop", "hang"])
def test_a_stuck_actor_shows_its_stacks_and_is_replaced(tmp_path: Path, fault: str):
    # a slow game: when stopped, an actor is hardly ever at anything else than a decision
    options = (
        {"step_s": 0.005}
        if fault == "stop"
        else {"fault": "hang", "fault_at": 57, "fault_file": str(tmp_path / "struck")}
    )
    with playing(config(tmp_path / "work", options, actors=ActorsConfig(heartbeat_timeout_s=2.0))) as run:
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
    with playing(config(tmp_path, {}, actors=ActorsConfig(heartbeat_timeout_s=1.0))) as run:
        pids = run.until_all_ready()
        for pid in pids:  # the whole machine sleeps
            os.kill(pid, signal.SIGSTOP)
        time.sleep(2.0)
        for pid in pids:
            os.kill(pid, signal.SIGCONT)
        run.play(500)
        assert run.pool.statistics().restarts == 0


def test_an_actor_that_starts_too_slowly_is_named(tmp_path: Path):
    pool_config = config(tmp_path, {}, actors=ActorsConfig(start_timeout_s=0.05, max_restarts=0))
    said = r"had not started its games after \d+\.\d s"
    with playing(pool_config) as run, pytest.raises(WorkerError, match=said):
        run.until(lambda: False)


def test_a_spent_budget_is_an_error_that_tells_why(tmp_path: Path):
    actors = ActorsConfig(max_restarts=2, restart_window_s=100)
    pool_config = config(tmp_path, {"fault": "no_start", "fault_task": "b"}, actors=actors)
    with playing(pool_config) as run, pytest.raises(WorkerError) as raised:
        run.until(lambda: False)
    text = str(raised.value)
    assert "exited with code 1; that was end 3 within 100 s, and actors.max_restarts allows 2 restarts." in text
    assert f"The end of {tmp_path / 'actor_'}" in text
    assert text.endswith("RuntimeError: no engine today")
    assert "gave_up" in [f.kind for f in run.faults()], "what it said last came before the error"
    waits = [
        f.message.rsplit(" in ", 1)[1] for f in run.faults() if f.kind == "died" and f.actor == run.faults()[-1].actor
    ]
    assert waits[:2] == ["0.50 s", "1.00 s"], "each failed start waits longer"


def test_a_process_that_cannot_be_started_again_counts_as_one_that_failed(tmp_path: Path):
    with playing(config(tmp_path / "work", {}, actors=ActorsConfig(max_restarts=2))) as run:
        pids = run.until_all_ready()
        shutil.rmtree(tmp_path / "work")
        (tmp_path / "work").touch()  # where the logs go
        os.kill(pids[0], signal.SIGKILL)
        with pytest.raises(WorkerError, match=r"actor 0 could not be started \(.*exists.*\); that was end 3 within"):
            run.until(lambda: False)
    assert [fault.kind for fault in run.faults()] == ["died", "died", "gave_up"]


def test_a_first_process_that_cannot_be_started_is_an_error_with_advice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def refused(*_arguments: object, **_options: object) -> None:
        raise BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN))

    monkeypatch.setattr(subprocess, "Popen", refused)
    with pytest.raises(ResourceError, match=r"an actor cannot be started: .* unavailable; use fewer actors, or raise"):
        ProcessPool(config(tmp_path, {}))


def test_an_actor_that_tells_of_anothers_game_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    receive = Channel.receive

    def receive_a_strangers(channel: Channel) -> list[Message]:
        monkeypatch.setattr(Channel, "receive", receive)  # once
        stranger = next(m for m in run.messages if isinstance(m, EpisodeStats) and m.lane == 3)
        return [*receive(channel), stranger]

    with playing(config(tmp_path, {})) as run:
        run.until_all_ready()
        run.until(lambda: 3 in run.first_episodes())
        monkeypatch.setattr(Channel, "receive", receive_a_strangers)
        run.until(lambda: run.pool.statistics().restarts == 1)
        run.play(300)
    (fault,) = run.faults()
    assert "actor 0 sent what is no message of its own (got an episode of lane 3, task 1, want one of lanes [0, 1]" in (
        fault.message
    )


_PARENT = """
import os, sys, time
sys.path.append({tests!r})
from pathlib import Path
from actors.process_pool import ProcessPool
from fake_env import config
link = lambda file: os.readlink(file) if os.path.lexists(file) else ""
pool = ProcessPool(config(Path({work!r}), {{}}))
while pool.statistics().actors_ready < 2:
    pool.drain(100)
    pool.poll()
print(*[status.pid for status in pool.writer_statuses()], flush=True)
print(*[os.stat(file).st_ino for file in Path("/proc/self/fd").iterdir() if "memfd:gvz-" in link(file)], flush=True)
time.sleep(600)
"""


def open_segments() -> set[int]:
    """Inodes of the shared memory of ours that any process has open."""
    found = set()
    for file in Path("/proc").glob("[0-9]*/fd/*"):
        with contextlib.suppress(OSError):
            if "memfd:gvz-" in str(file.readlink()):
                found.add(file.stat().st_ino)
    return found


def test_a_killed_learner_takes_its_actors_along_and_leaves_nothing(tmp_path: Path):
    code = textwrap.dedent(_PARENT).format(tests=str(Path(__file__).parent), work=str(tmp_path))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout is not None
        pids = [int(word) for word in parent.stdout.readline().split()]
        segments = {int(word) for word in parent.stdout.readline().split()}
        assert len(pids) == 2
        assert segments
        assert all(alive(pid) for pid in pids)
        parent.kill()
    wait_until(lambda: not any(alive(pid) for pid in pids), "the actors' end")
    assert not segments & open_segments()
