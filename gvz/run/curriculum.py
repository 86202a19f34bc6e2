"""Which task a game plays next. A lane's task changes at the end of an episode, never within one."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from gvz.run.curriculum_config import CurriculumConfig, steps_of
from gvz.task_table import TaskTable
from gvz.transport.messages import EpisodeStats


class Curriculum:
    """The tasks' scores, and the probability of each task.

    Source: levels, Bengio et al. 2009. Learning progress is the absolute difference of a quick and a slow moving
    average of the score: Kanitscheider et al. 2021, section 3, and Matiisen et al. 2017. Probabilities by rank, mixed
    with staleness: Prioritized Level Replay, Jiang et al. 2021, eq. 2 to 4. Differs: there a level's score is the size
    of its TD errors; learning progress needs no look into the learner.
    """

    def __init__(self, config: CurriculumConfig, table: TaskTable, seed: int, state: Mapping[str, Any] | None = None):
        """`state` is what `state()` gave to a run that goes on; None: a new run."""
        self._config, self._seed = config, seed
        self._levels = np.array(steps_of(table))
        num_tasks = len(table)
        fresh: dict[str, Any] = {
            "num_draws": 0,
            "recent": [[]] * num_tasks,
            "quick": [0.0] * num_tasks,
            "slow": [0.0] * num_tasks,
            "last_draw": [0] * num_tasks,
            "open_level": self._levels.min(),
        }
        state = fresh if state is None else state
        self._num_draws, self._open_level = int(state["num_draws"]), int(state["open_level"])
        self._recent = [list(scores) for scores in state["recent"]]
        self._quick, self._slow = np.array(state["quick"]), np.array(state["slow"])
        self._last_draw = np.array(state["last_draw"], np.int64)
        """number of the draw that chose each task last"""

    def next_task(self, episode: EpisodeStats, percent: float) -> int | None:
        """Counts an episode that has ended, and draws the task that its lane plays after the present one.

        The lane has begun its next episode already when an episode's end is heard of, so the task takes effect one
        episode later.

        Args:
            episode: one that was not cut.
            percent: its score in percent of the upper bound.

        Returns: index of the task; None: the lane keeps what it has.
        """
        if self._config.kind == "fixed":
            return None
        self._count(episode.task, percent)
        self._num_draws += 1
        rng = np.random.default_rng([self._seed, self._num_draws])
        task = int(rng.choice(len(self._levels), p=self.probabilities()))
        self._last_draw[task] = self._num_draws
        return task

    def probabilities(self) -> np.ndarray:
        """float64[num_tasks]: of each task at the next draw."""
        if self._config.kind == "level":
            reached = self._levels <= self._open_level
            return reached / reached.sum()
        if self._config.kind == "progress":
            return self._by_progress()
        return np.full(len(self._levels), 1 / len(self._levels))

    def _by_progress(self) -> np.ndarray:
        config = self._config
        unplayed = np.array([not scores for scores in self._recent])
        if unplayed.any():  # a task without a score comes first
            return unplayed / unplayed.sum()
        progress = np.abs(self._quick - self._slow)
        rank = np.empty(len(progress))
        rank[np.argsort(-progress, kind="stable")] = np.arange(1, len(progress) + 1)
        by_rank = (1 / rank) ** (1 / config.temperature)
        stale = self._num_draws - self._last_draw
        return (1 - config.staleness_share) * by_rank / by_rank.sum() + config.staleness_share * stale / stale.sum()

    def _count(self, task: int, percent: float) -> None:
        window, recent = self._config.window_episodes, self._recent[task]
        if not recent:
            self._quick[task] = self._slow[task] = percent
        self._quick[task] += (percent - self._quick[task]) / window
        self._slow[task] += (percent - self._slow[task]) / (5 * window)
        recent.append(percent)
        del recent[:-window]
        while self._is_learned(self._open_level) and (above := self._levels[self._levels > self._open_level]).size:
            self._open_level = int(above.min())

    def _is_learned(self, level: int) -> bool:
        """Every task of the level has a whole window of episodes with a sufficient mean."""
        windows = [recent for recent, one in zip(self._recent, self._levels, strict=True) if one == level]
        return all(
            len(recent) == self._config.window_episodes and np.mean(recent) >= self._config.learned_percent
            for recent in windows
        )

    def state(self) -> dict[str, Any]:
        """What a resumed run goes on from, as msgpack types."""
        return {
            "num_draws": self._num_draws,
            "recent": [list(scores) for scores in self._recent],
            "quick": self._quick.tolist(),
            "slow": self._slow.tolist(),
            "last_draw": self._last_draw.tolist(),
            "open_level": self._open_level,
        }
