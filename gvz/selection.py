"""Which tasks a command is about, as flags. Imports gvz.tasks."""

from dataclasses import dataclass

from gvz.errors import ConfigError
from gvz.scenarios.base import Split, Task
from gvz.tasks import named_tasks, parse_task


@dataclass(frozen=True, kw_only=True)
class TaskSelection:
    """Which tasks: all 76 named ones, or these."""

    tasks: tuple[str, ...] = ()
    """ids, for example defend_the_center/gore+mossy_bricks; not only named tasks"""
    scenario: str | None = None
    """the named tasks of this scenario"""
    split: Split | None = None
    """the named tasks of this training or test set"""

    def resolve(self) -> tuple[Task, ...]:
        """The tasks.

        Raises:
            TaskError: an unknown name. ConfigError: ids beside a scenario or split.
        """
        if not self.tasks:
            return named_tasks(scenario=self.scenario, split=self.split)
        if self.scenario is not None or self.split is not None:
            raise ConfigError("--tasks: got ids and also --scenario or --split, want one or the other")
        return tuple(dict.fromkeys(parse_task(text) for text in self.tasks))


ALL_TASKS = TaskSelection()
