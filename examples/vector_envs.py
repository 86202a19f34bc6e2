"""Several games at once with Gymnasium's own vector environments and wrappers.

python examples/vector_envs.py --mode async --num-envs 4 --steps 500 --video videos   (videos need moviepy)
"""

from functools import partial
from pathlib import Path
from typing import Literal

import gymnasium
import tyro
from gymnasium.wrappers import FrameStackObservation, RecordEpisodeStatistics, RecordVideo

import gvz  # registers the tasks in Gymnasium


def main(
    task: str = "GViZDoom/HealthGathering-Lava-v0",
    mode: Literal["sync", "async"] = "async",
    num_envs: int = 2,
    steps: int = 100,
    video: Path | None = None,
):
    """Plays at random; prints every finished episode. With `video`, one more game is recorded to its end."""
    envs = gymnasium.make_vec(
        task,
        num_envs=num_envs,
        vectorization_mode=mode,
        # new processes: a fork of this one would share its threads and locks
        vector_kwargs={"context": "spawn"} if mode == "async" else {},
        wrappers=[partial(FrameStackObservation, stack_size=4), RecordEpisodeStatistics],
    )
    observations, _ = envs.reset(seed=1)  # game i gets seed 1 + i
    envs.action_space.seed(1)
    print(f"gvizdoom {gvz.__version__}, {mode}: observations {observations.shape} {observations.dtype}")
    for _ in range(steps):
        observations, _, terminated, truncated, infos = envs.step(envs.action_space.sample())
        for i in (terminated | truncated).nonzero()[0]:  # game i resets at the next step
            score, length = infos["score"][i], infos["episode"]["l"][i]
            print(f"game {i}: score {score:.0f} after {length} decisions")
    envs.close()

    if video is not None:
        env = RecordVideo(gymnasium.make(task, render_mode="rgb_array"), str(video), episode_trigger=lambda _: True)
        env.reset(seed=1)
        over = False
        while not over:
            _, _, terminated, truncated, _ = env.step(env.action_space.sample())
            over = terminated or truncated
        env.close()
        print(*sorted(video.glob("*.mp4")))


if __name__ == "__main__":
    tyro.cli(main)
