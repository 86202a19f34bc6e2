"""Engines that die under an environment: the episode is cut and marked, the next one whole, the end an error.
Calls that are interrupted.
"""

import itertools
import shutil
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium.error import AlreadyPendingCallError, ResetNeeded

from gvz.core.errors import EngineError
from gvz.engine.engine import Engine
from gvz.env import DoomEnv
from gvz.multi_task import MultiTaskEnv
from tests.episodes import TURN, fingerprint, idle_to_the_end

pytestmark = pytest.mark.engine


def test_a_crash_truncates_the_episode_and_the_next_one_is_whole():
    env = DoomEnv("defend_the_center/default", render_mode="rgb_array")
    whole = fingerprint(env, 7)
    env.reset(seed=1)
    before = env.step(TURN)
    screen = env.render()
    assert env._engine is not None
    env._engine.kill()
    observation, reward, terminated, truncated, info = env.step(TURN)
    np.testing.assert_array_equal(observation, before[0])
    np.testing.assert_array_equal(env.render(), screen)
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert info["engine_crash"] is True
    assert "crash" in info["engine_error"]
    assert info["episode_frames"] == before[4]["episode_frames"]
    assert set(info["reward_components"].values()) == {0.0}
    with pytest.raises(ResetNeeded):
        env.step(TURN)
    assert fingerprint(env, 7) == whole
    env.close()


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda engine: engine.kill(), "crash"),
        (lambda engine: shutil.rmtree(engine.log.parent), "No such file"),  # as programs do that clean /tmp up
    ],
    ids=["killed", "without its files"],
)
def test_an_engine_that_cannot_begin_an_episode_is_replaced(damage, said):
    env = DoomEnv("defend_the_center/default")
    whole = fingerprint(env, 7)
    damage(env._engine)
    _, info = env.reset(options={"episode_seed": 7})
    assert info["engine_crash"] is True
    assert said in info["engine_error"]
    assert fingerprint(env, 7) == whole
    assert env.reset()[1]["engine_crash"] is False
    env.close()


def test_crash_upon_crash_is_an_error():
    env = DoomEnv("defend_the_center/default")

    def crash() -> dict:
        env.reset(seed=1)
        assert env._engine is not None
        env._engine.kill()
        return env.step(TURN)[4]

    assert all(crash()["engine_crash"] for _ in range(3))
    with pytest.raises(EngineError, match=r"default: 4 engine crashes without a whole episode between; the last:"):
        crash()
    env.close()


def test_a_whole_episode_makes_crashes_forgotten():
    env = DoomEnv("defend_the_center/default", frame_skip=35)
    for _ in range(4):
        env.reset(seed=1)
        assert env._engine is not None
        env._engine.kill()
        env.step(TURN)
        env.reset(seed=1)
        idle_to_the_end(env)
    env.close()


def test_another_map_than_the_tasks_is_an_error():
    env = DoomEnv("defend_the_center/default")
    env._engine_config = DoomEnv("defend_the_center/gore")._engine_config
    with pytest.raises(
        EngineError,
        match=r"default: .* runs a map with magic number \d+, want \d+, .*, which its script sets in `global int 60`",
    ):
        env.reset(seed=1)
    env.close()


@pytest.mark.parametrize(
    ("call", "owner", "method"),
    [("reset", Engine, "new_episode"), ("reset", DoomEnv, "_observe"), ("step", Engine, "advance")],
)
def test_an_interrupted_call_leaves_no_episode_to_play(
    call: str, owner: type, method: str, monkeypatch: pytest.MonkeyPatch
):
    """The caller has no observation of it. After a step that nobody knows of, a score could be above the bound."""
    env = DoomEnv("defend_the_center/default")
    env.reset(seed=1)
    whole = getattr(owner, method)

    def interrupted(*arguments: object) -> None:
        whole(*arguments)
        raise KeyboardInterrupt  # Python raises it when the library's call has come back

    with monkeypatch.context() as patched:
        patched.setattr(owner, method, interrupted)
        with pytest.raises(KeyboardInterrupt):
            env.reset(seed=2) if call == "reset" else env.step(TURN)
    with pytest.raises(ResetNeeded):
        env.step(TURN)
    assert env.reset(seed=1)[1]["episode_frames"] == 0
    env.close()


def test_a_working_directory_that_was_removed_is_an_error():
    """ViZDoom would abort the whole process."""
    code = (
        "import os, tempfile; from gvz.core.errors import EngineError; from gvz.env import DoomEnv\n"
        "place = tempfile.mkdtemp(); os.chdir(place); os.rmdir(place)\n"
        "try: DoomEnv('defend_the_center/default')\n"
        "except EngineError as error: print(error)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.stdout.startswith("the working directory was removed; change to another"), done.stderr


def of_two_tasks() -> MultiTaskEnv:
    """Every episode is of another task than the one before."""
    tasks = ("defend_the_center/default", "defend_the_center/gore")
    names = itertools.cycle(tasks)
    return MultiTaskEnv(tasks, sampler=lambda _: next(names))


@pytest.mark.parametrize("make", [partial(DoomEnv, "defend_the_center/default"), of_two_tasks])
def test_a_call_beside_that_of_another_thread_is_refused_and_breaks_nothing(make, monkeypatch):
    env = make()
    env.reset(seed=1)
    advance, entered, go_on = Engine.advance, threading.Event(), threading.Event()

    def waiting(engine: Engine, *arguments: Any) -> bool:
        entered.set()
        go_on.wait(30)
        return advance(engine, *arguments)

    monkeypatch.setattr(Engine, "advance", waiting)
    with ThreadPoolExecutor(1) as player:
        step = player.submit(env.step, TURN)
        assert entered.wait(30)
        for call in (env.close, env.reset, lambda: env.step(TURN)):
            with pytest.raises(AlreadyPendingCallError, match="another thread is in a call of this environment"):
                call()
        go_on.set()
        assert not step.result()[4]["engine_crash"]
    env.step(TURN)
    env.close()
    with pytest.raises(ResetNeeded):
        env.step(TURN)


FORK = """
import os, warnings
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
import gvz

warnings.simplefilter("ignore")  # Python 3.12 warns of any fork beside threads
task = "defend_the_center/default"
env, envs = gvz.make(task), gvz.make_vec(task)
first, _ = env.reset(seed=1)
envs.reset(seed=1)
env.step(1)
if child := os.fork():
    assert os.waitpid(child, 0)[1] == 0
    assert env.step(1)[4]["episode_frames"] == 8
    assert envs.step([1])[4]["episode_frames"] == [4]
    env.close()
    envs.close()
else:
    code = 1
    try:
        with pytest.raises(ResetNeeded, match="no episode is running in this process"):
            env.step(1)
        with pytest.raises(ClosedEnvironmentError, match="a fork"):
            envs.step([1])
        again, info = env.reset(seed=1)
        assert (again == first).all() and not info["engine_crash"]
        assert env.step(1)[4]["episode_frames"] == 4
        env.close()
        envs.close()
        code = 0
    finally:
        os._exit(code)
"""


def test_a_fork_does_not_play_its_parents_games():
    done = subprocess.run([sys.executable, "-c", FORK], capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, "")


def test_close_may_be_repeated_and_reset_starts_anew():
    env = DoomEnv("defend_the_center/default")
    env.close()
    first = fingerprint(env, 7)
    env.close()
    env.close()
    with pytest.raises(ResetNeeded):
        env.step(0)
    assert fingerprint(env, 7) == first
    env.close()
