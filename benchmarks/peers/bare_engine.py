"""The engine's limit: one process that only calls `make_action` and `get_state`, with random actions.

    python bare_engine.py TASK RENDER_WIDTH RENDER_HEIGHT

The engine has the settings of our own environment: the same map, buttons, variables and screen.
"""

import sys
import time
from typing import Any

import numpy as np
from serve import serve

from gvz.engine.engine import Engine
from gvz.env import DoomEnv

_NUM_ACTIONS = 4096


def main() -> None:
    """Starts the engine and serves."""
    task, width, height = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    env = DoomEnv(task, render_width=width, render_height=height)
    engine = Engine(env._engine_config)
    game, rng = engine._game, np.random.default_rng()
    actions = [env._actions[index] for index in rng.integers(env.action_space.n, size=_NUM_ACTIONS)]
    engine.new_episode(int(rng.integers(2**31)))

    def play(seconds: float) -> dict[str, Any]:
        count, start = 0, time.perf_counter()
        while time.perf_counter() - start < seconds:
            game.make_action(actions[count % _NUM_ACTIONS], env.config.frame_skip)
            if game.get_state() is None:
                engine.new_episode(int(rng.integers(2**31)))
            count += 1
        return {"count": count, "seconds": time.perf_counter() - start}

    try:
        serve(play, "vizdoom")
    finally:
        engine.close()


if __name__ == "__main__":
    main()
