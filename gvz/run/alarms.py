"""What in a row of metrics should make a researcher look up: pure functions.

Nothing here changes a run. Its sizes are bounded by design (a game owns its share of the replay, the weight of a task
is capped, parameters that are not finite are never kept); these are the conditions under which it may be wasted.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from gvz.run.progress import TaskStatus

ZERO_EPISODES = 30
"""a task whose last episodes, this many, scored nothing is not learned (its KPI looks back as far)"""
ENDLESS_EPISODES = 2
"""a game that has played for this many time-outs without an end of an episode does not end them"""
EDGE_SHARE = 0.02
"""part of the values' range, at either end, that counts as its edge"""
STALE = 10
"""warn when staleness exceeds the expected maximum by this factor"""
_EVENLY_FILLED = 0.5
"""share of the replay from which on its records are weighed: before, a quick game is simply ahead"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Expected:
    """What the metrics of a run are held against."""

    games: Mapping[str, int]
    """of each task; empty where a game's tasks change"""
    timeout_steps: int
    """decisions after which an episode is truncated"""
    num_slots: int
    """records the replay holds"""
    v_min: float
    v_max: float
    """range of discounted returns"""
    distributional: bool
    """values are means over a support from v_min to v_max and cannot leave it"""
    staleness_versions: float
    """publications while a record waits in a full ring for a learner that is as far ahead as it may be"""


def alarms(row: Mapping[str, float], tasks: Sequence[TaskStatus], expected: Expected) -> dict[str, str]:
    """The conditions that hold, each with what to say about it. `row` is a log period's row of metrics.jsonl."""
    return {
        **_crowded(row, expected),
        **_extreme_values(row, expected),
        **_idle_tasks(row, tasks, expected),
        **_stale_parameters(row, expected),
    }


def _crowded(row: Mapping[str, float], expected: Expected) -> dict[str, str]:
    """A task that has taken half of what is due to all the others."""
    found = {}
    for task, games in expected.games.items():
        due = games / sum(expected.games.values())
        for name, what in (("replay/share", "records in the replay"), ("learner/sample_share", "samples drawn")):
            share = row.get(f"{name}/{task}", 0.0)
            if due < 1 and share > (1 + due) / 2 and row["replay/fill_share"] >= _EVENLY_FILLED:
                found[f"{name}/{task}"] = f"{task} makes {share:.0%} of the {what}; by its games {due:.0%} are due"
    return found


def _extreme_values(row: Mapping[str, float], expected: Expected) -> dict[str, str]:
    """Values beyond all returns, or at the ends of the support, where a distribution cannot follow them."""
    low, high = row.get("learner/q_mean"), row.get("learner/q_max")
    if low is None or high is None:
        return {}
    width = expected.v_max - expected.v_min
    if expected.distributional:
        margin, why = -EDGE_SHARE * width, "the end of the support cuts them off: widen agent.v_min, agent.v_max"
    else:
        margin, why = width, "values diverge: lower learner.learning_rate, or set learner.max_grad_norm"
    if expected.v_min - margin <= low and high <= expected.v_max + margin:
        return {}
    text = f"values reach from {low:.3g} (mean) to {high:.3g} (largest), returns from {expected.v_min:.3g} to "
    return {"values": f"{text}{expected.v_max:.3g}; {why}"}


def _idle_tasks(row: Mapping[str, float], tasks: Sequence[TaskStatus], expected: Expected) -> dict[str, str]:
    """Tasks from which nothing comes: no score, or no end of an episode."""
    found = {}
    for task in tasks:
        share, games = row.get(f"replay/share/{task.task}", 0.0), expected.games.get(task.task, math.inf)
        steps = share * row["replay/fill_share"] * expected.num_slots / games
        if task.episodes >= ZERO_EPISODES and task.score == 0.0:
            found[f"zero/{task.task}"] = f"{task.task} scored 0 in each of its last {ZERO_EPISODES} episodes"
        if task.episodes == 0 and steps > ENDLESS_EPISODES * expected.timeout_steps:
            found[f"endless/{task.task}"] = (
                f"{task.task} has ended no episode in {steps:.0f} decisions a game; its time-out is at "
                f"{expected.timeout_steps}"
            )
    return found


def _stale_parameters(row: Mapping[str, float], expected: Expected) -> dict[str, str]:
    """Actors that act by parameters which the learner has long replaced."""
    versions = row["actors/staleness_p95_versions"]
    if versions <= STALE * expected.staleness_versions:
        return {}
    return {
        "stale": f"one decision in twenty was made by parameters {versions:.0f} or more publications old, where "
        f"{expected.staleness_versions:.0f} can be explained by records that wait; actors may be starved of "
        "processor time: lower actors.num_actors"
    }
