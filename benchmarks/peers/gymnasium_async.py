"""Our environment under gymnasium's AsyncVectorEnv: `python gymnasium_async.py TASK NUM_ENVS`."""

import functools
import sys

import gymnasium
from serve import serve_random_play

from gvz.env import DoomEnv


def main() -> None:
    """Starts the environments and serves."""
    task, num_envs = sys.argv[1], int(sys.argv[2])
    envs = gymnasium.vector.AsyncVectorEnv([functools.partial(DoomEnv, task)] * num_envs, shared_memory=True)
    serve_random_play(envs, "gymnasium", "vizdoom")


if __name__ == "__main__":
    main()
