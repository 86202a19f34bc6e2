"""Trains PPO of Stable-Baselines3 on some tasks of a scenario and evaluates it on others by the benchmark's protocol.

python examples/stable_baselines3_ppo.py --steps 200000 --episodes 20
(how to install: docs/how-to/use-your-own-agent.md)
"""

import hashlib
from functools import partial
from pathlib import Path

import numpy as np
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecFrameStack, VecMonitor

import gvz
from gvz.evaluation.episode_log import evaluate_player
from gvz.evaluation.players import FramePlayer
from gvz.tasks import named_tasks
from gvz.vector.adapters.stable_baselines3 import Sb3VecEnv


def main(
    scenario: str = "defend_the_center",
    steps: int = 20_000,
    n_steps: int = 128,
    episodes: int = 5,
    max_tasks: int = 7,
    out: Path = Path("sb3_ppo.jsonl"),
):
    """Trains on the training set of 4 tasks, then plays `episodes` of the first `max_tasks` test tasks into `out`."""
    games = gvz.make_vec(named_tasks(scenario, split="train4"), autoreset_mode="SameStep")
    envs = VecFrameStack(VecMonitor(Sb3VecEnv(games)), n_stack=4)  # u8[4, 84, 84, 12], newest frame last
    model = PPO("CnnPolicy", envs, n_steps=n_steps, batch_size=n_steps, ent_coef=0.01, verbose=1, seed=1)
    model.learn(total_timesteps=steps)
    envs.close()

    def choose(stack: np.ndarray) -> int:
        return int(model.predict(stack, deterministic=True)[0])

    weights = b"".join(tensor.cpu().numpy().tobytes() for tensor in model.policy.state_dict().values())
    digest = hashlib.blake2b(weights, digest_size=4).hexdigest()
    name = f"sb3_ppo@{steps} {digest}"  # of this model alone: episodes of a name are played once
    tasks = named_tasks(scenario, split="test")[:max_tasks]
    rows = evaluate_player(partial(FramePlayer, choose), tasks, out, name=name, episodes=episodes)
    for task in tasks:
        score = np.mean([row["score"] for row in rows if row["task"] == task.id])
        print(f"{task.id}: mean score {score:.1f} of {episodes} episodes")


if __name__ == "__main__":
    tyro.cli(main)
