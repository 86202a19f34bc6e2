"""LevDoom under gymnasium's AsyncVectorEnv: `python levdoom_async.py NUM_ENVS [RESOLUTION]`, 160X120 for example."""

import functools
import sys
import warnings

import gymnasium
from serve import serve_random_play


def make_env(resolution: str | None) -> gymnasium.Env:
    """One bare LevDoom game; the default resolution is LevDoom's own, 320x240."""
    from levdoom.envs.defend_the_center.scenario import DefendTheCenter

    return DefendTheCenter(env="default", render=False, resolution=resolution)


def main() -> None:
    """Starts the environments and serves."""
    warnings.simplefilter("ignore")
    num_envs, resolution = int(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else None
    envs = gymnasium.vector.AsyncVectorEnv([functools.partial(make_env, resolution)] * num_envs, shared_memory=True)
    serve_random_play(envs, "levdoom", "gymnasium", "vizdoom", num_envs=num_envs, frame_skip=4)


if __name__ == "__main__":
    main()
