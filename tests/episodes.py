"""Episodes of an environment, played in ways that several tests want. Imports numpy, gvz.env and gvz.evaluation."""

import hashlib
import json
from collections.abc import Callable
from contextlib import closing
from typing import Any

import numpy as np

from gvz.core.env_config import EnvConfig
from gvz.env import DoomEnv
from gvz.evaluation.play import play_episode
from gvz.evaluation.players import CLASSES
from gvz.evaluation.simple import player_env

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


def evaluated(
    task: str, name: str, num_episodes: int = 3, player: Callable[[], Any] | None = None
) -> list[dict[str, Any]]:
    """Rows of the first evaluation episodes of base seed 1, of a simple player or of another that sees what it sees."""
    with closing(DoomEnv(task, player_env(name, EnvConfig()))) as env:
        return [play_episode(env, (player or CLASSES[name])(), episode, 1) for episode in range(num_episodes)]
