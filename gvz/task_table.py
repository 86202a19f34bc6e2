"""The table of a run's tasks: what the rest of a run must know of each, by the task's index."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

from gvz.actions import action_mask
from gvz.core.env_config import EnvConfig
from gvz.core.errors import ConfigError
from gvz.scenarios.base import Scenario
from gvz.tasks import Task, parse_task


@dataclass(frozen=True, kw_only=True, slots=True)
class TaskRow:
    """One task as it is played in a run."""

    task: Task
    upper_bound: float
    """best possible score"""
    timeout_frames: int
    """game tics after which an episode is truncated"""
    reward_weights: Mapping[str, float]
    """weight of each reward component"""
    reward_scale: float
    """what the learner multiplies its rewards by"""
    return_range: tuple[float, float]
    """(v_min, v_max) of its discounted returns, of scaled rewards"""
    action_mask: tuple[bool, ...]
    """the actions that its scenario allows"""


@dataclass(frozen=True, slots=True)
class TaskTable:
    """The tasks of a run; row i is of the task with index i. All have the same number of actions."""

    rows: tuple[TaskRow, ...]

    def percent(self, task: int, score: float) -> float:
        """A score of the task with this index, in percent of its upper bound."""
        return 100 * score / self.rows[task].upper_bound

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def tasks(self) -> tuple[Task, ...]:
        return tuple(row.task for row in self.rows)

    @property
    def ids(self) -> tuple[str, ...]:
        """Canonical ids of the tasks."""
        return tuple(row.task.id for row in self.rows)

    @property
    def scenarios(self) -> tuple[Scenario, ...]:
        """The scenarios of the tasks, each once, in the tasks' order."""
        return tuple(dict.fromkeys(row.task.scenario for row in self.rows))

    @property
    def num_actions(self) -> int:
        return len(self.rows[0].action_mask)

    @property
    def action_masks(self) -> tuple[tuple[bool, ...], ...] | None:
        """[task][action]: the actions that each task allows; None where every task allows all of them."""
        masks = tuple(row.action_mask for row in self.rows)
        return None if all(map(all, masks)) else masks

    @property
    def reward_scales(self) -> tuple[float, ...] | None:
        """[task]: what the learner multiplies rewards by; None where nothing is scaled."""
        scales = tuple(row.reward_scale for row in self.rows)
        return None if set(scales) == {1.0} else scales

    @property
    def return_range(self) -> tuple[float, float]:
        """(v_min, v_max) of the discounted returns of all tasks, of scaled rewards."""
        lows, highs = zip(*(row.return_range for row in self.rows), strict=True)
        return min(lows), max(highs)

    @property
    def variables(self) -> tuple[str, ...]:
        """The game variables that an agent may see in any of the tasks, each once."""
        return tuple(dict.fromkeys(name for one in self.scenarios for name in one.game_variables))


@cache
def task_table(ids: tuple[str, ...], env: EnvConfig, discount: float, *, scale_rewards: bool = False) -> TaskTable:
    """The table of these tasks.

    Args:
        ids: of the tasks, in the order of their indices.
        env: how they are played.
        discount: gamma of one decision.
        scale_rewards: scale each task's rewards so that the largest absolute value of its discounted returns is 1.

    Raises:
        TaskError: an unknown task. ConfigError: no task, one twice, tasks whose scenarios have other actions, or
            reward weights that leave nothing to learn from.
    """
    tasks = tuple(parse_task(text) for text in ids)
    if not tasks:
        raise ConfigError("tasks: got none, want at least one task id")
    if len({task.id for task in tasks}) < len(tasks):
        raise ConfigError(f"tasks: got one task twice in {[task.id for task in tasks]}")
    names = sorted({task.scenario.id for task in tasks})
    if len(names) > 1 and env.action_set != "unified_v1":
        raise ConfigError(
            f"tasks: got tasks of {names}, whose actions are others; want one scenario, or env.action_set unified_v1"
        )
    return TaskTable(tuple(_row(task, env, discount, scale_rewards) for task in tasks))


def _row(task: Task, env: EnvConfig, discount: float, scale_rewards: bool) -> TaskRow:
    scenario = task.scenario
    weights = scenario.reward_weights(dict(env.reward_weights), env.profile)
    if not any(weights.values()):
        raise ConfigError(f"env.reward_weights: got 0 for each of {', '.join(weights)}, want a reward to learn from")
    low, high = scenario.return_range(env, discount)
    scale = 1.0 / max(-low, high) if scale_rewards else 1.0
    return TaskRow(
        task=task,
        upper_bound=scenario.upper_bound(env.profile),
        timeout_frames=scenario.timeout_frames(env.profile),
        reward_weights=weights,
        reward_scale=scale,
        return_range=(scale * low, scale * high),
        action_mask=action_mask(scenario, env.action_set),
    )
