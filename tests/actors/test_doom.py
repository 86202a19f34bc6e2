"""The pool with the real game: bit-for-bit resumption, and engines and actors that are killed."""

import dataclasses
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path

import msgpack
import numpy as np
import psutil
import pytest
from watched_pool import gather, segments

from actors.config import ActorsConfig
from actors.inline import InlinePool
from actors.pool import PoolConfig
from actors.process_pool import ProcessPool
from gvz.core import janitor
from gvz.core.env_config import SIGHT_CLASSES, SIGHT_COLUMNS, EnvConfig
from gvz.transport.messages import EpisodeStats, Fault, Message

pytestmark = pytest.mark.engine

ENV = EnvConfig(
    frame_height=32, frame_width=40, render_width=160, render_height=120, reward_weights=(("death", -3.0),), sight=True
)


def config(work_dir: Path, *, num_actors: int, second_task: str = "fuzzy_enemies") -> PoolConfig:
    return PoolConfig(
        tasks=("defend_the_center/default", f"defend_the_center/{second_task}"),
        num_actors=num_actors,
        games_per_actor=2,
        seed=1,
        env_entry_point="gvz.env:make_env",
        env_config=dataclasses.asdict(ENV),
        frame_shape=ENV.frame_shape,
        stack_size=4,
        num_sights=len(SIGHT_CLASSES) * SIGHT_COLUMNS,
        num_actions=3,
        policy=b"",
        num_params=0,
        layout_hash=0,
        actors=ActorsConfig(),
        work_dir=work_dir,
    )


def test_a_resumed_game_goes_on_bit_for_bit(tmp_path: Path):
    """The cut lies in the middle of episodes that are not the first, and the resumed pool has engines of its own.

    An engine's fuzz goes on from episode to episode: fuzzy enemies come back only if each episode has a fresh engine.
    """
    pool_config = config(tmp_path, num_actors=1)
    with InlinePool(pool_config) as pool:
        pool.drain(301)
        before = pool.poll()
        state = msgpack.unpackb(msgpack.packb(pool.state()))
        wanted_steps, wanted_frames = gather(pool.drain(300))
        wanted_messages = pool.poll()
    assert {m.lane for m in before if isinstance(m, EpisodeStats)} == {0, 1}
    assert {m.reward_components["death"] for m in before if isinstance(m, EpisodeStats)} == {-3.0}
    assert all(game["actions"] for game in state["loop"]["games"])
    with InlinePool(pool_config, state) as pool:
        steps, frames = gather(pool.drain(300))
        messages = pool.poll()
    np.testing.assert_array_equal(steps, wanted_steps)
    np.testing.assert_array_equal(frames, wanted_frames)
    assert messages == wanted_messages
    seen = steps["sight"].reshape(-1, len(SIGHT_CLASSES), SIGHT_COLUMNS).any(axis=(0, 2))
    assert dict(zip(SIGHT_CLASSES, seen, strict=True)) == {name: name == "enemy" for name in SIGHT_CLASSES}
    assert len(messages) >= 2


def test_killed_engines_and_actors_are_replaced_and_leave_nothing(tmp_path: Path):
    messages: list[Message] = []
    last: dict[int, np.void] = {}
    num_cuts = 0
    others = set(psutil.Process().children(recursive=True))
    """of earlier tests in this process, such as multiprocessing's resource tracker"""

    def until(done: Callable[[], bool]) -> None:
        nonlocal num_cuts
        deadline = time.monotonic() + 120
        while not done():
            assert time.monotonic() < deadline, messages
            for block in pool.drain(100, wait_s=0.02):
                for step in block.steps:
                    lane = int(step["lane"])
                    if lane in last:
                        over = last[lane]["terminated"] or last[lane]["truncated"]
                        assert step["first"] or not over
                        assert bool(step["first"]) == (step["episode"] > last[lane]["episode"])
                        num_cuts += bool(step["first"] and not over)
                    last[lane] = step.copy()
            messages.extend(pool.poll())

    def faults(kind: str) -> list[Fault]:
        return [m for m in messages if isinstance(m, Fault) and m.kind == kind]

    def engines(actor: int) -> list[psutil.Process]:
        pid = pool.writer_statuses()[actor].pid
        return [child for child in psutil.Process(pid).children(recursive=True) if "vizdoom" in child.name()]

    # no fuzzy lane: its engine is replaced after every episode, and one that is starting does not crash in an episode
    with ProcessPool(config(tmp_path, num_actors=2, second_task="gore")) as pool:
        until(lambda: pool.statistics().actors_ready == 2 and len(last) == 4)

        engines(0)[0].kill()
        until(lambda: bool(faults("engine_crash")))
        crash = faults("engine_crash")[0]
        until(lambda: any(isinstance(m, EpisodeStats) and m.lane == crash.lane and not m.cut for m in messages))
        assert crash.lane in (0, 1)
        assert pool.statistics().restarts == 0, "the actor lives; it starts a new engine by itself"
        assert num_cuts == 0, "the crashed episode's last record is marked truncated"

        victims = engines(1)
        assert len(victims) == 2
        os.kill(pool.writer_statuses()[1].pid, signal.SIGKILL)
        until(lambda: pool.statistics().restarts == 1 and pool.statistics().actors_ready == 2)
        assert not any(janitor.process_start(victim.pid) for victim in victims), "engines died with their actor"
        assert num_cuts <= 2
    assert len(faults("died")) == 1
    assert {m.reward_components["death"] for m in messages if isinstance(m, EpisodeStats) and m.terminated} == {-3.0}
    assert not set(psutil.Process().children(recursive=True)) - others
    assert not segments()
