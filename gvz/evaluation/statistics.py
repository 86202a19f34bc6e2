"""Statistics of scores, as pure functions on arrays.

The unit of comparison between agents is the *run*: one training seed. Scores of several runs on several tasks are a
matrix [S, T] (seeds, tasks) of means over evaluation episodes; the statistics are of such matrices, with any axes
before, and of plain vectors, which are matrices of one run. An interval is a percentile bootstrap interval, and it
says what was resampled: episodes (how precise are the scores of these agents?) or runs (what would other seeds give?).

Source: thesis 3.1 (performance indicators, eq. 3.1 and 3.2) and 3.1.4 (solved); Agarwal et al. 2021, "Deep RL at the
edge of the statistical precipice" (interquartile mean, probability of improvement, stratified bootstrap).
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, assert_never

import numpy as np

Statistic = Callable[..., np.ndarray]
"""f(scores [..., S, T], one such array for each group) -> [...]"""

Cells = Sequence[Sequence[np.ndarray]]
"""scores of single episodes: `cells[s][t]` is float64[E] of run s on task t; E may differ from cell to cell"""

Redraw = Literal["episodes", "runs", "runs_by_task"]
"""what a bootstrap resamples, with replacement

episodes: episodes within each task and run. runs: whole runs, each with its scores on all tasks: right where one agent
was evaluated on all of them. runs_by_task: runs within each task, independently of the other tasks: right where every
task has agents of its own (Agarwal et al.'s stratified bootstrap)."""

SOLVED_EPISODES = 10
"""consecutive time-outs after which a survival task counts as solved"""

CONFIDENCE = 0.95
"""of all intervals"""

_BLOCK_NUMBERS = 4_000_000
"""numbers that a bootstrap holds at once"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Estimate:
    """A statistic with its bootstrap interval."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.1f} [{self.low:.1f}, {self.high:.1f}]"

    def overlaps(self, other: "Estimate") -> bool:
        """The two intervals have a point in common."""
        return self.low <= other.high and other.low <= self.high


# ------------------------------------------------------------------------------------------------ statistics


def normalize(score: Any, upper_bound: Any) -> Any:
    """Scores in percent of the best possible one: numbers, arrays, or columns of a frame."""
    return 100 * score / upper_bound


def mean(scores: np.ndarray) -> np.ndarray:
    """Mean over runs and tasks, [..., S, T] -> [...]: P_i of a scenario, if the tasks are its test tasks.

    Source: thesis eq. 3.1.
    """
    return np.mean(np.atleast_2d(scores), axis=(-2, -1))


def median(scores: np.ndarray) -> np.ndarray:
    """Median over tasks of the mean over runs, [..., S, T] -> [...]."""
    return np.median(np.mean(np.atleast_2d(scores), axis=-2), axis=-1)


def interquartile_mean(scores: np.ndarray) -> np.ndarray:
    """Mean of the middle half of all scores, [..., S, T] -> [...]; a quarter of them is cut at each end."""
    scores = np.atleast_2d(scores)
    ordered = np.sort(scores.reshape(*scores.shape[:-2], -1), axis=-1)
    cut = ordered.shape[-1] // 4
    return np.mean(ordered[..., cut : ordered.shape[-1] - cut], axis=-1)


def mean_over_scenarios(*scores: np.ndarray) -> np.ndarray:
    """P_norm: the mean over scenarios of each one's mean, however many tasks it has.

    Args:
        scores: one matrix [..., S, T] a scenario, in percent of its upper bound.

    Source: thesis eq. 3.2.
    """
    return np.mean(np.stack([mean(one) for one in scores]), axis=0)


def attribute_loss(scores: np.ndarray) -> np.ndarray:
    """What an attribute costs, [..., S, 2] -> [...]: scores on the default task and on the one with the attribute."""
    default, alone = np.moveaxis(np.mean(scores, axis=-2), -1, 0)
    return default - alone


def attribute_interaction(scores: np.ndarray) -> np.ndarray:
    """What two attributes cost together beyond the sum of what each costs alone, [..., S, 4] -> [...].

    Args:
        scores: on the default task, with the first, with the second, and with both.
    """
    default, first, second, both = np.moveaxis(np.mean(scores, axis=-2), -1, 0)
    return first + second - default - both


def difference(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """Difference of two agents' means, [..., S, T] and [..., S', T'] -> [...]."""
    return mean(ours) - mean(theirs)


def generalization_gap(scores: np.ndarray, num_train: int) -> np.ndarray:
    """How much lower the score is on other tasks: mean over training tasks minus mean over test tasks.

    Args:
        scores: [..., S, T] of the same runs on both, the training tasks first.
        num_train: training tasks, 1..T-1.
    """
    return mean(scores[..., :num_train]) - mean(scores[..., num_train:])


def probability_of_improvement(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """The probability that a run of ours beats one of theirs on a task; ties count half; mean over tasks.

    Args:
        ours: [..., S, T].
        theirs: [..., S', T], the same tasks.

    Returns: [...], 0..1.

    Source: Agarwal et al. 2021, section 4.3 (the Mann-Whitney statistic of each task).
    """
    x, y = np.atleast_2d(ours)[..., :, None, :], np.atleast_2d(theirs)[..., None, :, :]  # [..., S, S', T]
    return np.mean((x > y) + 0.5 * (x == y), axis=(-3, -2, -1))


def solved(timed_out: np.ndarray) -> bool:
    """SOLVED_EPISODES consecutive episodes, in the order they were played, reached the time-out.

    Args:
        timed_out: bool[E] of one agent on one task of a survival scenario.

    Source: thesis 3.1.4.
    """
    return any(one and len(list(streak)) >= SOLVED_EPISODES for one, streak in itertools.groupby(timed_out))


# ------------------------------------------------------------------------------------------------- intervals


def bootstrap(strata: Sequence[np.ndarray], *, num_resamples: int = 2000, seed: int = 0) -> Estimate:
    """Mean over strata (tasks) with its 95% interval; the episodes of each, float[E], are resampled within it.

    Raises:
        ValueError: no strata, or an empty one.
    """
    return bootstrap_runs([[strata]], redraw=["episodes"], num_resamples=num_resamples, seed=seed)


def bootstrap_runs(
    groups: Sequence[Cells],
    statistic: Statistic = mean,
    *,
    redraw: Sequence[Redraw],
    together: bool = False,
    num_resamples: int = 2000,
    seed: int = 0,
) -> Estimate:
    """A statistic of the runs' mean scores, with a percentile interval.

    Args:
        groups: what the statistic takes: one scenario's runs each, or ours and theirs.
        statistic: f(scores [..., S, T] of each group) -> [...].
        redraw: what is resampled in each group. Of a single run only episodes can be.
        together: the groups are of the same runs in the same order, as of agents that play all scenarios; a resample
            then has the same runs in each group. Otherwise each is resampled by itself.
        num_resamples: bootstrap samples.
        seed: of the resampling.

    Raises:
        ValueError: no groups, a cell without episodes, runs with different numbers of tasks, or not as many `redraw` as
            groups.
    """
    for cells in groups:
        if not cells or not cells[0] or any(len(run) != len(cells[0]) or not all(map(len, run)) for run in cells):
            raise ValueError("bootstrap_runs: want runs with the same tasks, at least one episode in each")
    if not groups or len(groups) != len(redraw):
        raise ValueError(f"bootstrap_runs: got {len(groups)} groups of runs and {len(redraw)} ways, want one for each")
    rngs = [np.random.default_rng(seed)] * len(groups)
    if together:
        if len({len(cells) for cells in groups}) > 1 or set(redraw) != {"runs"}:
            raise ValueError("bootstrap_runs: together: want the same runs in each group, and to redraw runs")
        rngs = [np.random.default_rng(seed) for _ in groups]  # each draws the same runs
    means = [_means(cells) for cells in groups]
    drawn = [_redrawn(cells, how, num_resamples, rng) for cells, how, rng in zip(groups, redraw, rngs, strict=True)]
    low, high = np.quantile(statistic(*drawn), [(1 - CONFIDENCE) / 2, (1 + CONFIDENCE) / 2])
    return Estimate(value=float(statistic(*means)), low=float(low), high=float(high))


def _means(cells: Cells) -> np.ndarray:
    """float64[S, T]"""
    return np.array([[np.mean(cell) for cell in run] for run in cells])


def _redrawn(cells: Cells, redraw: Redraw, num_resamples: int, rng: np.random.Generator) -> np.ndarray:
    """Means of what was resampled, float64[R, S, T]."""
    num_runs, num_tasks = len(cells), len(cells[0])
    match redraw:
        case "episodes":
            means = [[_means_of_redrawn(cell, num_resamples, rng) for cell in run] for run in cells]
            return np.moveaxis(np.array(means), -1, 0)
        case "runs":
            chosen = rng.integers(num_runs, size=(num_resamples, num_runs, 1))
        case "runs_by_task":
            chosen = rng.integers(num_runs, size=(num_resamples, num_runs, num_tasks))
        case _:
            assert_never(redraw)
    return _means(cells)[chosen, np.arange(num_tasks)]


def _means_of_redrawn(scores: np.ndarray, num_resamples: int, rng: np.random.Generator) -> np.ndarray:
    scores = np.asarray(scores, np.float64)
    most = max(1, _BLOCK_NUMBERS // len(scores))
    blocks = [min(most, num_resamples - done) for done in range(0, num_resamples, most)]
    return np.concatenate([scores[rng.integers(len(scores), size=(num, len(scores)))].mean(axis=1) for num in blocks])
