"""Statistics of scores, as pure functions. Imports numpy only.

Source: thesis 3.2 and 5.1 (scores, performance indicators); Agarwal et al. 2021, "Deep RL at the edge of the
statistical precipice" (interquartile mean, stratified bootstrap).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

Statistic = Callable[[np.ndarray], float]


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


def mean(scores: np.ndarray) -> float:
    """Arithmetic mean of all scores."""
    return float(np.mean(scores))


def interquartile_mean(scores: np.ndarray) -> float:
    """Mean of the middle half of all scores; a quarter of them is cut at each end."""
    ordered = np.sort(np.ravel(scores))
    cut = len(ordered) // 4
    return float(np.mean(ordered[cut : len(ordered) - cut]))


def bootstrap(
    strata: Sequence[np.ndarray],
    statistic: Statistic = mean,
    *,
    confidence: float = 0.95,
    num_resamples: int = 2000,
    seed: int = 0,
) -> Estimate:
    """A statistic of all scores with a percentile interval from a stratified bootstrap.

    Args:
        strata: scores of each stratum (task, or task and seed); each is resampled within itself.
        statistic: of the scores of all strata together.
        confidence: of the interval, 0..1.
        num_resamples: bootstrap samples.
        seed: of the resampling.

    Raises:
        ValueError: no strata, an empty one, or a confidence outside 0..1.
    """
    if not strata or any(len(s) == 0 for s in strata):
        raise ValueError("bootstrap: got no scores in a stratum, want at least one in each")
    if not 0 < confidence < 1:
        raise ValueError(f"bootstrap: got confidence {confidence}, want between 0 and 1")
    rng = np.random.default_rng(seed)
    arrays = [np.asarray(s, np.float64) for s in strata]
    samples = [
        statistic(np.concatenate([a[rng.integers(len(a), size=len(a))] for a in arrays])) for _ in range(num_resamples)
    ]
    low, high = np.quantile(samples, [(1 - confidence) / 2, (1 + confidence) / 2])
    return Estimate(value=statistic(np.concatenate(arrays)), low=float(low), high=float(high))
