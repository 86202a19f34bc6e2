"""LevDoom under gymnasium's AsyncVectorEnv: `python levdoom_async.py NUM_ENVS [RESOLUTION]`, 160X120 for example."""

import functools
import sys
import time
import warnings
from typing import Any

import gymnasium
from serve import serve


def make_env(resolution: str | None) -> gymnasium.Env:
    """One bare LevDoom game; the default resolution is LevDoom's own, 320x240."""
    from levdoom.envs.defend_the_center.scenario import DefendTheCenter

    return DefendTheCenter(env="default", render=False, resolution=resolution)


def main() -> None:
    """Starts the environments and serves."""
    warnings.simplefilter("ignore")
    num_envs, resolution = int(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else None
    envs = gymnasium.vector.AsyncVectorEnv([functools.partial(make_env, resolution)] * num_envs, shared_memory=True)
    envs.reset(seed=0)

    def play(seconds: float) -> dict[str, Any]:
        count, start = 0, time.perf_counter()
        while time.perf_counter() - start < seconds:
            envs.step(envs.action_space.sample())
            count += num_envs
        return {"count": count, "seconds": time.perf_counter() - start}

    try:
        serve(play, "levdoom", "gymnasium", "vizdoom", num_envs=num_envs, frame_skip=4)
    finally:
        envs.close()


if __name__ == "__main__":
    main()
