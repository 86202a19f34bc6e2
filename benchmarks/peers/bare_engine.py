"""The engine's limit: one process that only calls `make_action` and `get_state`, with random actions.

    python bare_engine.py TASK RENDER_WIDTH RENDER_HEIGHT

The engine has the settings of our own environment: the same map, buttons, variables and screen.
"""

import itertools
import sys

import numpy as np
from serve import serve_rate

from gvz.engine.engine import Engine
from gvz.env import DoomEnv

_NUM_ACTIONS = 4096


def main() -> None:
    """Starts the engine and serves."""
    task, width, height = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    env = DoomEnv(task, render_width=width, render_height=height)
    engine = Engine(env._engine_config)
    game, rng = engine._game, np.random.default_rng()
    choices = rng.integers(env.action_space.n, size=_NUM_ACTIONS)
    actions = itertools.cycle([env._actions[index] for index in choices])
    engine.new_episode(int(rng.integers(2**31)))

    def decide() -> int:
        game.make_action(next(actions), env.config.frame_skip)
        if game.get_state() is None:
            engine.new_episode(int(rng.integers(2**31)))
        return 1

    try:
        serve_rate(decide, "vizdoom")
    finally:
        engine.close()


if __name__ == "__main__":
    main()
