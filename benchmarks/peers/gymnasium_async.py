"""Our environment under gymnasium's AsyncVectorEnv: `python gymnasium_async.py TASK NUM_ENVS`."""

import functools
import sys
import time
from typing import Any

import gymnasium
from serve import serve

from gvz.env import DoomEnv


def main() -> None:
    """Starts the environments and serves."""
    task, num_envs = sys.argv[1], int(sys.argv[2])
    envs = gymnasium.vector.AsyncVectorEnv([functools.partial(DoomEnv, task)] * num_envs, shared_memory=True)
    envs.reset(seed=0)

    def play(seconds: float) -> dict[str, Any]:
        count, start = 0, time.perf_counter()
        while time.perf_counter() - start < seconds:
            envs.step(envs.action_space.sample())
            count += num_envs
        return {"count": count, "seconds": time.perf_counter() - start}

    try:
        serve(play, "gymnasium", "vizdoom")
    finally:
        envs.close()


if __name__ == "__main__":
    main()
