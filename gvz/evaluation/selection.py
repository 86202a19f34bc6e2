"""The flags that choose tasks."""

from dataclasses import dataclass

from gvz.core.errors import ConfigError
from gvz.scenarios.base import Task
from gvz.tasks import TaskSet, named_tasks, parse_task


@dataclass(frozen=True, kw_only=True)
class TaskSelection:
    """Which tasks: all named ones, or these."""

    tasks: tuple[str, ...] = ()
    """ids, for example defend_the_center/gore+mossy_bricks; not only named tasks"""
    scenario: str | None = None
    """the named tasks of this scenario"""
    split: TaskSet | None = None
    """the named tasks of this training or test set; gate: those of level 2 that are in none of them"""
    level: int | None = None
    """the named tasks of this level, 0..4"""

    def resolve(self) -> tuple[Task, ...]:
        """The tasks.

        Raises:
            TaskError: an unknown name. ConfigError: ids together with another choice, or no task fits the choice.
        """
        if not self.tasks:
            chosen = named_tasks(scenario=self.scenario, level=self.level, split=self.split)
            if not chosen:
                raise ConfigError(f"--level, --split: no task of {self.split} has level {self.level}")
            return chosen
        if (self.scenario, self.split, self.level) != (None, None, None):
            raise ConfigError("--tasks: got ids and also --scenario, --split or --level, want one or the other")
        return tuple(dict.fromkeys(parse_task(text) for text in self.tasks))


ALL_TASKS = TaskSelection()
