"""Trains PPO of Stable-Baselines3 on some tasks of a scenario and evaluates it on others by the benchmark's protocol.

pip install -r examples/requirements.txt; python examples/stable_baselines3_ppo.py --steps 200000 --episodes 20
"""

from functools import partial
from pathlib import Path

import numpy as np
import tyro
from gymnasium.vector import VectorEnv
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnv, VecFrameStack, VecMonitor

import gvz
from gvz.evaluation.episode_log import evaluate_player
from gvz.evaluation.players import FramePlayer
from gvz.tasks import named_tasks


class Games(VecEnv):
    """A gvz.make_vec as Stable-Baselines3 knows it: an episode begins in the same step in which the last one ends."""

    def __init__(self, envs: VectorEnv):
        self.envs, self.render_mode = envs, envs.render_mode
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> np.ndarray:
        observations, _ = self.envs.reset(seed=self._seeds)
        self._reset_seeds()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        self.envs.send(actions)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
        observations, rewards, terminated, truncated, infos = self.envs.recv()
        over = terminated | truncated
        of_game = [{"score": score} for score in infos["score"].tolist()]
        for i in over.nonzero()[0]:
            of_game[i] |= {"terminal_observation": infos["final_obs"][i], "TimeLimit.truncated": bool(truncated[i])}
        return observations, rewards.astype(np.float32), over, of_game

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices=None) -> list:
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: object, indices=None) -> None:
        raise NotImplementedError("the games are played in other processes")

    def env_method(self, method_name: str, *method_args, indices=None, **method_kwargs) -> list:
        raise NotImplementedError("the games are played in other processes")

    def env_is_wrapped(self, wrapper_class: type, indices=None) -> list[bool]:
        return [False for _ in self._get_indices(indices)]


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
    envs = VecFrameStack(VecMonitor(Games(games)), n_stack=4)  # u8[4, 84, 84, 12], newest frame last
    model = PPO("CnnPolicy", envs, n_steps=n_steps, batch_size=n_steps, ent_coef=0.01, verbose=1, seed=1)
    model.learn(total_timesteps=steps)
    envs.close()

    def choose(stack: np.ndarray) -> int:
        return int(model.predict(stack, deterministic=True)[0])

    tasks = named_tasks(scenario, split="test")[:max_tasks]
    rows = evaluate_player(partial(FramePlayer, choose), tasks, out, name=f"sb3_ppo@{steps}", episodes=episodes)
    for task in tasks:
        score = np.mean([row["score"] for row in rows if row["task"] == task.id])
        print(f"{task.id}: mean score {score:.1f} of {episodes} episodes")


if __name__ == "__main__":
    tyro.cli(main)
