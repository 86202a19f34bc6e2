"""EnvPool's ViZDoom task, asynchronously: `python envpool_doom.py NUM_ENVS NUM_THREADS`."""

import sys

import envpool
import numpy as np
from serve import serve_rate


def main() -> None:
    """Starts the pool and serves."""
    num_envs, num_threads = int(sys.argv[1]), int(sys.argv[2])
    pool = envpool.make_gymnasium(
        "DefendTheCenter-v1",
        num_envs=num_envs,
        batch_size=num_threads,
        num_threads=num_threads,
        frame_skip=4,
        use_combined_action=True,  # a discrete set of actions; without it an action is three real numbers
    )
    rng = np.random.default_rng(0)
    pool.async_reset()

    def play() -> int:
        info = pool.recv()[-1]
        pool.send(rng.integers(pool.action_space.n, size=num_threads, dtype=np.int32), info["env_id"])
        return num_threads

    serve_rate(play, "envpool", num_envs=num_envs, frame_skip=4)


if __name__ == "__main__":
    main()
