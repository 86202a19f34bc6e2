"""A game that counts, for faults of the pool itself: everything in its frames can be predicted.

Bytes 0..3 of a frame are the seed, bytes
4..7 the number of steps since reset, the rest (seed + steps) mod 251. The reward of step t is t.
"""

import os
import signal
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

FRAME_SHAPE = (12, 10, 3)


def frame(seed: int, num_steps: int) -> np.ndarray:
    flat = np.full(int(np.prod(FRAME_SHAPE)), (seed + num_steps) % 251, np.uint8)
    flat[:4] = np.frombuffer(np.uint32(seed).tobytes(), np.uint8)
    flat[4:8] = np.frombuffer(np.uint32(num_steps).tobytes(), np.uint8)
    return flat.reshape(FRAME_SHAPE)


class CountingEnv(gymnasium.Env[np.ndarray, int]):
    """Options: length (decisions an episode), end ("terminated" or "truncated"), step_s (sleep), fault and fault_at.

    A fault strikes at the `fault_at`-th step of the process's life, once in the life of the file `fault_file` (each
    time if it is not given): raise, segfault, hang (in Python), crash (the engine's own way), no_reset.
    """

    def __init__(self, task: str, options: dict[str, Any]):
        self.observation_space = gymnasium.spaces.Box(0, 255, FRAME_SHAPE, np.uint8)
        self.action_space = gymnasium.spaces.Discrete(5)
        self.task = task
        self.options = options
        self.seed_, self.num_steps, self.life_steps, self.action_sum = 0, 0, 0, 0
        if options.get("fault") == "no_start":
            raise RuntimeError("no engine today")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        assert options is not None
        self.seed_, self.num_steps, self.action_sum = options["episode_seed"], 0, 0
        return frame(self.seed_, 0), self.info({})

    def step(self, action: int):
        assert self.action_space.contains(int(action)), action
        time.sleep(self.options.get("step_s", 0.0))
        self.num_steps += 1
        self.life_steps += 1
        self.action_sum += action
        crashed = self.life_steps == self.options.get("fault_at") and self.strike()
        over = self.num_steps >= self.options["length"]
        terminated = over and self.options.get("end", "terminated") == "terminated"
        info = self.info({"count": float(self.num_steps), "action": 0.0})
        if crashed:
            info["engine_crash"] = True
        reward = float(self.num_steps)
        return frame(self.seed_, self.num_steps), reward, terminated, (over and not terminated) or crashed, info

    def info(self, components: dict[str, float]) -> dict[str, Any]:
        return {
            "score": float(self.action_sum),
            "normalized_score": 0.0,
            "reward_components": components,
            "episode_frames": 4 * self.num_steps,
            "episode_seed": self.seed_,
        }

    def strike(self) -> bool:
        """Does the fault, unless it has struck before; True if the engine is to look crashed."""
        file = self.options.get("fault_file")
        if file is not None:
            try:
                os.close(os.open(file, os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                return False
        match self.options["fault"]:
            case "raise":
                raise RuntimeError("this step was meant to fail")
            case "segfault":
                os.kill(os.getpid(), signal.SIGSEGV)
            case "hang":
                Path(self.options["work_dir"], "hanging").touch()
                time.sleep(3600)
        return self.options["fault"] == "crash"


def make(task: str, options: dict[str, Any]) -> CountingEnv:
    return CountingEnv(task, options)
