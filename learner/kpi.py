"""Key performance indicators of the tasks and the loss weights made of them."""

from typing import Any

import numpy as np

from learner.config import LearnerConfig


class TaskKpis:
    """Running mean of each task's score, and the weight of its samples.

    KPI_j is the mean of task j's last `kpi_window_episodes` scores (fewer at the start), and
    w_j = max_i KPI_i / KPI_j. Source: thesis eq. 4.19, 4.20. Differs: a weight is at most `kpi_max_weight` (the
    thesis divides by zero for KPI 0). A task that has not finished an episode has weight 1, and no part in the maximum.
    """

    def __init__(self, num_tasks: int, config: LearnerConfig):
        self._config = config
        self._scores = np.zeros((num_tasks, config.kpi_window_episodes), np.float64)  # written in a circle
        self._num_episodes = np.zeros(num_tasks, np.int64)

    def add(self, task: int, score: float) -> None:
        """Counts one finished episode.

        Args:
            task: index of its task.
            score: in percent of the task's upper bound, >= 0: tasks of all scenarios compare.

        Raises:
            ValueError: no such task, or a score that is negative or not finite.
        """
        num_tasks, window = self._scores.shape
        if not 0 <= task < num_tasks:
            raise ValueError(f"TaskKpis.add: got task {task}, want 0..{num_tasks - 1}")
        if not (np.isfinite(score) and score >= 0):
            raise ValueError(f"TaskKpis.add: got score {score} for task {task}, want a finite number >= 0")
        self._scores[task, self._num_episodes[task] % window] = score
        self._num_episodes[task] += 1

    def kpis(self) -> np.ndarray:
        """float64[num_tasks]: mean score over the window; NaN for a task without an episode."""
        counts = np.minimum(self._num_episodes, self._scores.shape[1])
        return np.where(counts > 0, self._scores.sum(axis=1) / np.maximum(counts, 1), np.nan)

    def weights(self) -> np.ndarray:
        """float32[num_tasks]: what a sample's loss is multiplied by; all 1 if `kpi_weighting` is off."""
        kpis = self.kpis()
        best, bound = np.nanmax(kpis, initial=0.0), self._config.kpi_max_weight
        if not self._config.kpi_weighting or best == 0:
            return np.ones(len(kpis), np.float32)
        kpis = np.nan_to_num(kpis, nan=best)
        # max / KPI >= bound is KPI <= max / bound: no division by a KPI of 0.
        return np.where(kpis * bound <= best, bound, best / np.maximum(kpis, 1e-300)).astype(np.float32)

    def state(self) -> dict[str, Any]:
        """All that is remembered, for a checkpoint: msgpack types."""
        return {"scores": self._scores.tolist(), "num_episodes": self._num_episodes.tolist()}

    def restore(self, state: dict[str, Any]) -> None:
        """Takes back what `state` gave.

        Raises:
            ValueError: it was made for other tasks or another window.
        """
        for name, mine in (("scores", self._scores), ("num_episodes", self._num_episodes)):
            if (shape := np.shape(state[name])) != mine.shape:
                raise ValueError(
                    f"TaskKpis.restore: {name} has shape {shape}, want {mine.shape} (number of tasks, "
                    "kpi_window_episodes)"
                )
            mine[:] = state[name]
