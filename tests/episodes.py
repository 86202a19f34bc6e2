"""Episodes of an environment, played in ways that several tests want. Imports numpy and gvz.env."""

import hashlib
import json

import numpy as np

from gvz.env import DoomEnv

TURN = 1
"""an action of Defend the Center that wastes no ammunition"""


def play(env: DoomEnv, episode_seed: int, max_steps: int = 60) -> tuple[np.ndarray, list[float], list[dict]]:
    """Frames u8[T+1 H W C], rewards and infos of an episode, with actions drawn from its seed."""
    rng = np.random.default_rng(episode_seed)
    frame, info = env.reset(options={"episode_seed": episode_seed})
    frames, rewards, infos = [frame], [], [info]
    for _ in range(max_steps):
        frame, reward, terminated, truncated, info = env.step(rng.integers(env.action_space.n))
        frames.append(frame)
        rewards.append(reward)
        infos.append(info)
        if terminated or truncated:
            break
    return np.stack(frames), rewards, infos


def fingerprint(env: DoomEnv, episode_seed: int) -> str:
    frames, rewards, infos = play(env, episode_seed)
    return hashlib.sha256(frames.tobytes() + json.dumps([rewards, infos]).encode()).hexdigest()


def idle_to_the_end(env: DoomEnv, action: int = TURN) -> list[tuple]:
    """All steps of one episode."""
    steps = []
    while not steps or not (steps[-1][2] or steps[-1][3]):
        steps.append(env.step(action))
    return steps
