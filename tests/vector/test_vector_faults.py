"""Engines and workers of a vector environment that die, and what is left of it after every kind of end."""

import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.vector import AutoresetMode

import gvz
from gvz.core import janitor
from gvz.core.errors import EngineError, WorkerError
from gvz.vector import crew
from gvz.vector.env import DoomVectorEnv
from tests.waiting import wait_until

pytestmark = pytest.mark.engine
TASK = "defend_the_center/default"
TURN = np.array([1, 1])


@pytest.fixture(scope="module")
def envs() -> Iterator[DoomVectorEnv]:
    made = gvz.make_vec(TASK, 2, num_workers=2)
    yield made
    made.close()


def engine_of(envs: DoomVectorEnv, worker: int) -> psutil.Process:
    (engine,) = psutil.Process(envs._crew.pids[worker]).children()
    return engine


def test_a_crash_of_an_engine_truncates_its_episode_and_no_other(envs: DoomVectorEnv):
    envs.reset(seed=1)
    before, *_ = envs.step(TURN)
    engine_of(envs, 1).kill()
    observations, rewards, terminated, truncated, infos = envs.step(TURN)
    np.testing.assert_array_equal(observations[1], before[1])
    assert (observations[0] != before[0]).any()
    assert (rewards[1], terminated.tolist(), truncated.tolist()) == (0.0, [False, False], [False, True])
    assert infos["engine_crash"].tolist() == [False, True]
    assert "crash" in infos["engine_error"][1]
    assert infos["_engine_error"].tolist() == [False, True]
    assert envs.step(TURN)[4]["episode_frames"].tolist() == [12, 0]


def test_a_worker_that_dies_is_a_crash_to_its_games_and_its_seeds_go_on(envs: DoomVectorEnv):
    envs.reset(seed=1)
    before, *_, told = envs.step(TURN)
    pid = envs._crew.pids[1]
    os.kill(pid, signal.SIGKILL)
    observations, rewards, terminated, truncated, infos = envs.step(TURN)
    np.testing.assert_array_equal(observations[1], before[1])
    assert (rewards[1], terminated.tolist(), truncated.tolist()) == (0.0, [False, False], [False, True])
    assert infos["engine_crash"].tolist() == [False, True]
    assert infos["engine_error"][1] == f"worker 1 (pid {pid}) was ended by SIGKILL"
    assert infos["score"][1] == told["score"][1]
    assert infos["_solved_episode"].tolist() == [False, True]
    _, _, _, truncated, infos = envs.step(TURN)
    assert (truncated.tolist(), infos["engine_crash"].tolist()) == ([False, False], [False, False])
    assert infos["episode_seed"][1] == second_seeds(2)[1], "the second episode of its seed"


def second_seeds(seed: int) -> list[int]:
    """Of a game's first two episodes."""
    return np.random.Generator(np.random.PCG64(np.random.SeedSequence(seed))).integers(2**31, size=2).tolist()


def test_ctrl_c_and_a_closed_terminal_are_not_for_the_workers(envs: DoomVectorEnv):
    envs.reset(seed=1)
    before = list(envs._crew.pids)
    for pid in before:
        os.kill(pid, signal.SIGINT)
        os.kill(pid, signal.SIGHUP)
    _, _, _, truncated, _ = envs.step(TURN)
    assert not truncated.any()
    assert envs._crew.pids == before


def test_a_worker_that_dies_at_an_episodes_begin_begins_it_again(envs: DoomVectorEnv):
    first, _ = envs.reset(seed=1)
    os.kill(envs._crew.pids[0], signal.SIGKILL)
    again, infos = envs.reset(seed=1)
    np.testing.assert_array_equal(again, first)
    assert infos["engine_crash"].tolist() == [True, False]
    assert envs.step(TURN)[4]["engine_crash"].tolist() == [False, False]


def test_a_worker_that_gives_no_sign_of_life_is_replaced(envs: DoomVectorEnv, monkeypatch: pytest.MonkeyPatch):
    envs.reset(seed=1)
    envs.step(TURN)
    monkeypatch.setattr(crew, "SILENCE_TIMEOUT_S", 0.5)
    os.kill(envs._crew.pids[0], signal.SIGSTOP)
    infos = envs.step(TURN)[4]
    assert "finished no decision in" in infos["engine_error"][0]


def test_same_step_gives_the_lost_episode_its_end_and_begins_the_next():
    envs = gvz.make_vec(TASK, 2, num_workers=1, autoreset_mode=AutoresetMode.SAME_STEP)
    envs.reset(seed=1)
    before, *_ = envs.step(TURN)
    os.kill(envs._crew.pids[0], signal.SIGKILL)
    observations, _, _, truncated, infos = envs.step(TURN)
    assert truncated.tolist() == [True, True]
    for game in range(2):
        np.testing.assert_array_equal(infos["final_obs"][game], before[game])
        assert (observations[game] != before[game]).any()
    assert infos["final_info"]["engine_crash"].tolist() == [True, True]
    assert infos["final_info"]["episode_frames"].tolist() == [4, 4]
    assert infos["engine_crash"].tolist() == [False, False]
    assert infos["episode_frames"].tolist() == [0, 0]
    assert infos["episode_seed"].tolist() == [second_seeds(1)[1], second_seeds(2)[1]]
    envs.close()


def test_games_that_waited_for_an_action_when_their_worker_died_are_cut_too():
    envs = gvz.make_vec("health_gathering/default", 2, num_workers=1, batch_size=1, render_mode="rgb_array")
    envs.reset(seed=1)
    envs.send(TURN)
    (waiting,) = envs.recv()[4]["env_id"]
    before = envs._frames.copy(np.array([waiting]), envs._halves[[waiting]])
    os.kill(envs._crew.pids[0], signal.SIGKILL)
    infos = envs.recv()[4]
    assert infos["env_id"].tolist() == [1 - waiting]
    with pytest.raises(ResetNeeded, match=rf"render: games \[.*{waiting}.*\] have rendered nothing since their worker"):
        envs.render()
    envs.send(TURN[:1], [waiting])
    observation, reward, terminated, truncated, infos = envs.recv()
    np.testing.assert_array_equal(observation, before)
    assert (reward[0], terminated[0], truncated[0], infos["engine_crash"][0]) == (0.0, False, True, True)
    assert infos["reward_components"]["living"][0] == 0.0
    envs.send(TURN[:1], [waiting])
    infos = envs.recv()[4]
    assert (infos["episode_frames"][0], infos["engine_crash"][0]) == (0, False)
    envs.close()


def test_a_worker_that_died_unnoticed_has_no_screens_and_its_games_are_cut():
    envs = gvz.make_vec(TASK, 2, num_workers=1, render_mode="rgb_array")
    envs.reset(seed=1)
    process = psutil.Process(envs._crew.pids[0])
    process.kill()
    psutil.wait_procs([process], timeout=30)
    with pytest.raises(ResetNeeded, match=r"render: games \[0, 1\] have rendered nothing since their worker died"):
        envs.render()
    *_, truncated, infos = envs.step(TURN[:2])
    assert truncated.all()
    assert infos["engine_crash"].all()
    envs.close()


def test_death_upon_death_is_an_error_that_says_what_happened_and_closes_everything(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(crew, "_MAX_DEATHS", 0)
    envs = gvz.make_vec(TASK, 1)
    envs.reset(seed=1)
    process = psutil.Process(envs._crew.pids[0])
    with process.oneshot():
        os.kill(process.pid, signal.SIGSEGV)
    with pytest.raises(WorkerError, match=r"(?s)SIGSEGV; that was death 1 of this worker without .*worker.py"):
        envs.step(TURN[:1])
    with pytest.raises(ClosedEnvironmentError):
        envs.reset()


def test_a_whole_episode_makes_a_workers_death_forgotten(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(crew, "_MAX_DEATHS", 1)
    envs = gvz.make_vec(TASK, 1, frame_skip=35)
    for _ in range(2):
        envs.reset(seed=1)
        os.kill(envs._crew.pids[0], signal.SIGKILL)
        assert envs.step(TURN[:1])[4]["engine_crash"].all()
        envs.step(TURN[:1])
        while not np.logical_or(*envs.step(TURN[:1])[2:4]).all():
            pass
    envs.close()


def test_an_error_of_a_worker_is_raised_here_and_closes_everything(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(Path(__file__).parent)
    envs = gvz.make_vec(TASK, 2)
    pids = envs._crew.pids
    for _ in range(3):
        envs.reset(seed=1)
        engine_of(envs, 0).kill()
        assert envs.step(TURN)[4]["engine_crash"].tolist() == [True, False]
    envs.reset(seed=1)
    engine_of(envs, 0).kill()
    with pytest.raises(EngineError, match="worker 0: defend_the_center/default: 4 engine crashes without a whole"):
        envs.step(TURN)
    with pytest.raises(ClosedEnvironmentError):
        envs.step(TURN)
    assert not any(psutil.pid_exists(pid) for pid in pids)


@pytest.mark.parametrize("by", ["handler", "thread"])
def test_a_call_that_waits_ends_when_the_environment_is_closed(by: str, monkeypatch: pytest.MonkeyPatch):
    envs = gvz.make_vec(TASK, 1)
    envs.reset(seed=1)
    (pid,) = envs._crew.pids
    os.kill(pid, signal.SIGSTOP)
    monkeypatch.setattr(crew, "_STOP_TIMEOUT_S", 0.2)
    before = signal.signal(signal.SIGUSR2, lambda *_: envs.close())
    closing = threading.Timer(0.5, envs.close if by == "thread" else lambda: os.kill(os.getpid(), signal.SIGUSR2))
    closing.start()
    try:
        with pytest.raises(ClosedEnvironmentError, match="was closed in the middle of a call"):
            envs.step(TURN[:1])
    finally:
        closing.join()
        signal.signal(signal.SIGUSR2, before)
    assert not psutil.pid_exists(pid)


def test_an_interrupted_call_closes_everything():
    envs = gvz.make_vec(TASK, 2, num_workers=2)
    pids = envs._crew.pids
    envs.reset(seed=1)

    def interrupt() -> None:
        os.kill(os.getpid(), signal.SIGINT)
        os.kill(pids[0], signal.SIGCONT)

    os.kill(pids[0], signal.SIGSTOP)
    threading.Timer(0.2, interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        envs.step(TURN)
    with pytest.raises(ClosedEnvironmentError):
        envs.reset()
    assert not any(psutil.pid_exists(pid) for pid in pids)


PROGRAM = """
import os, sys, time, psutil, gvz
envs = gvz.make_vec("defend_the_center/default", 2, num_workers=2)
envs.reset(seed=1)
print(*(process.pid for process in psutil.Process().children(recursive=True)), flush=True)
sys.stdin.readline()
if sys.argv[1] == "raises":
    raise RuntimeError("this program was meant to fail")
if sys.argv[1] == "closes":
    envs.close()
while sys.argv[1] == "plays":
    envs.step(envs.action_space.sample())
"""


@pytest.mark.parametrize("end", ["ends", "closes", "raises", signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_nothing_is_left_after_the_programs_end(tmp_path: Path, end: str | signal.Signals):
    (tmp_path / "program.py").write_text(textwrap.dedent(PROGRAM))
    places = [tmp_path / "tmp", tmp_path / "run"]
    for place in places:
        place.mkdir(mode=0o700)
    process = subprocess.Popen(
        [sys.executable, "program.py", end if isinstance(end, str) else "plays"],
        cwd=tmp_path,
        env={**os.environ, "TMPDIR": str(places[0]), "GVZ_RUNTIME_DIR": str(places[1])},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert process.stdin is not None
    assert process.stdout is not None
    pids = [int(word) for word in process.stdout.readline().split()]
    assert len(pids) == 4, "two workers and their engines"
    files = {name for pid in pids for name in shared_memory_of(pid)}
    assert files
    process.stdin.write(b"\n")  # only now it goes on, so nothing has ended while its memory is looked at
    process.stdin.flush()
    if isinstance(end, signal.Signals):
        time.sleep(0.2)  # it plays
        process.send_signal(end)
    _, errors = process.communicate(timeout=60)
    code = {"ends": 0, "closes": 0, "raises": 1}.get(str(end), -int(end) if isinstance(end, signal.Signals) else 0)
    assert process.returncode == code, errors.decode()
    wait_until(lambda: not any(map(janitor.process_start, pids)), "the end of workers and engines", 30)
    assert not [name for name in files if Path(name).exists()]
    assert not list(places[0].iterdir())
    assert not list(places[1].rglob("*.json"))


def shared_memory_of(pid: int) -> set[str]:
    """Files of /dev/shm that a process has mapped."""
    maps = Path(f"/proc/{pid}/maps").read_text()
    return {line.split()[-1] for line in maps.splitlines() if " /dev/shm/" in line}
