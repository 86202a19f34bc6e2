"""One engine that plays random decisions, and their time:

    python engine_speed.py {bare,environment} TASK CORE

`bare` calls `make_action` and `get_state` only, `environment` the whole of `gvz.make`. Engine and Python share one
core, so that no time is spent on waking up another one. Which package of vizdoom plays is up to PYTHONPATH.
"""

import os
import sys
import time
from pathlib import Path

import numpy as np
from serve import serve

from gvz.engine.engine import Engine
from gvz.env import DoomEnv

_NUM_ACTIONS = 4096
_EPISODE_TICS = 2100


def main() -> None:
    """Starts the engine and serves."""
    body, task, core = sys.argv[1], sys.argv[2], int(sys.argv[3])
    os.sched_setaffinity(0, {core})
    env, rng = DoomEnv(task), np.random.default_rng(1)
    choices = rng.integers(env.action_space.n, size=_NUM_ACTIONS)
    env.reset(seed=1)
    engine = env._engine
    assert engine is not None
    if body == "bare":
        engine = Engine(env._engine_config)
        engine.new_episode(1)
    game, count = engine._game, 0

    def decide() -> None:
        nonlocal count
        count += 1
        choice = choices[count % _NUM_ACTIONS]
        if body == "environment":
            _, _, terminated, truncated, _ = env.step(choice)
            if terminated or truncated:
                env.reset()
            return
        game.make_action(env._actions[choice], env.config.frame_skip)
        if game.get_state() is None or game.get_episode_time() > _EPISODE_TICS:
            engine.new_episode(count)

    def play(decisions: int) -> dict[str, float]:
        start = time.perf_counter(), _processor_s(engine.pid), _processor_s(os.getpid())
        for _ in range(decisions):
            decide()
        end = time.perf_counter(), _processor_s(engine.pid), _processor_s(os.getpid())
        seconds, engine_s, python_s = (b - a for a, b in zip(start, end, strict=True))
        return {
            "decisions_per_s": decisions / seconds,
            "engine_us": engine_s / decisions * 1e6,
            "python_us": python_s / decisions * 1e6,
            "decisions_per_core_s": decisions / (engine_s + python_s),
        }

    try:
        serve(play, "vizdoom")
    finally:
        engine.close()
        env.close()


def _processor_s(pid: int) -> float:
    """Processor time of all threads of a process, which runs on the one core, to the nanosecond."""
    times = (file.read_text().split()[0] for file in Path(f"/proc/{pid}/task").glob("*/schedstat"))
    return sum(map(int, times)) / 1e9


if __name__ == "__main__":
    main()
