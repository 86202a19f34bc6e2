"""How the tasks of a run are given to its games. Loads no numpy, because `--help` shows these options."""

from dataclasses import dataclass
from typing import Annotated, Literal

from gvz.core.errors import ConfigError
from gvz.core.ranges import Range, Share, check_ranges
from gvz.scenarios.map_set import PARTS
from gvz.task_table import TaskTable
from learner.config import refuse_unused


@dataclass(frozen=True, kw_only=True, slots=True)
class CurriculumConfig:
    """How the tasks of a run are given to its games."""

    kind: Literal["fixed", "uniform", "level", "progress"] = "fixed"
    """fixed: every game keeps its task; uniform: drawn for every episode; level: drawn among the levels (or strengths
    of drawn maps) reached, the next opens when the last is learned; progress: drawn by how fast the score changes"""
    learned_percent: Annotated[float, Range(0.0, 100.0)] = 50.0
    """level: the score at which a task counts as learned, percent of the upper bound"""
    window_episodes: Annotated[int, Range(1, 10**6)] = 20
    """level: the score is the mean of this many last episodes; progress: time scale of the quick average, the slow one
    is five times as slow"""
    temperature: Annotated[float, Range(0.01, 100.0)] = 1.0
    """progress: the probability of the task of rank r is proportional to (1 / r)^(1 / temperature)"""
    staleness_share: Share = 0.3
    """progress: share of draws by how long a task has not been played"""

    def __post_init__(self) -> None:
        check_ranges("curriculum", self)
        of_level, of_progress = ("learned_percent",), ("temperature", "staleness_share")
        unused = {"level": of_progress, "progress": of_level}.get(
            self.kind, ("window_episodes", *of_level, *of_progress)
        )
        refuse_unused("curriculum", self, "kind", *unused)


def steps_of(table: TaskTable) -> list[int]:
    """Each task's step in the order of difficulty, from 0: by level, then by the mean strength of its drawn maps."""
    difficulty = [
        (task.level, 0.0 if task.maps is None else sum(map(task.maps.strength, PARTS)) / len(PARTS))
        for task in table.tasks
    ]
    return [sorted(set(difficulty)).index(one) for one in difficulty]


def first_tasks(config: CurriculumConfig, table: TaskTable) -> tuple[int, ...]:
    """Indices of the tasks that the games begin with, in turn."""
    all_tasks = enumerate(steps_of(table))
    return tuple(task for task, step in all_tasks if step == 0 or config.kind != "level")


def check_curriculum(config: CurriculumConfig, table: TaskTable) -> None:
    """Raises ConfigError for a curriculum that has nothing to choose."""
    if config.kind == "level" and max(steps_of(table)) == 0:
        raise ConfigError(
            f"curriculum.kind: got level, but all tasks have level {table.tasks[0].level} and the same strengths; want "
            "tasks of several levels (training_set 4, or tasks), or another kind"
        )
    if config.kind != "fixed" and len(table) < 2:
        raise ConfigError(f"curriculum.kind: got {config.kind} for one task, want several tasks or fixed")
