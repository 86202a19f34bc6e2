"""Catch as a Gymnasium environment: a ball falls a row a step; the paddle in the last row catches it (+1) or not (-1).

The same game as `tests.learner.games.catch`, written without JAX.
"""

from typing import Any

import gymnasium
import numpy as np

ROWS, COLUMNS = 8, 5


class Catch(gymnasium.Env[np.ndarray, int]):
    """Actions left, stay, right; uint8[8, 5, 1] frames, white on black."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        assert options is not None
        self.row, self.ball, self.paddle, self.score = 0, options["episode_seed"] % COLUMNS, COLUMNS // 2, 0.0
        return self.frame(), self.info()

    def step(self, action: int):
        self.row += 1
        self.paddle = min(max(self.paddle + action - 1, 0), COLUMNS - 1)
        done = self.row == ROWS - 1
        self.score = (1.0 if self.ball == self.paddle else -1.0) if done else 0.0
        return self.frame(), self.score, done, False, self.info()

    def frame(self) -> np.ndarray:
        frame = np.zeros((ROWS, COLUMNS, 1), np.uint8)
        frame[self.row, self.ball] = frame[ROWS - 1, self.paddle] = 255
        return frame

    def info(self) -> dict[str, Any]:
        return {"score": self.score, "reward_components": {}, "episode_frames": self.row}


def make(task: str, options: dict[str, Any]) -> Catch:
    del task, options
    return Catch()
