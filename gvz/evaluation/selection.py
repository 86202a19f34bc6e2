"""The flags that choose tasks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import tyro

from gvz.core.errors import ConfigError
from gvz.scenarios.base import Suite, Task
from gvz.tasks import TaskSet, named_tasks, parse_task, scenario_named


@dataclass(frozen=True, kw_only=True)
class TaskSelection:
    """Which tasks: all named ones of the core suite, or these."""

    tasks: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="ID [ID ...]")] = None
    """ids, for example defend_the_center/gore+mossy_bricks; not only named tasks"""
    scenario: str | None = None
    """the named tasks of this scenario"""
    split: TaskSet | None = None
    """the tasks of this set; gate: the named tasks of level 2 in no other set; pairs: the eight training tasks, and
    each two of their attributes that go together and are no named task; compositions: any number of them;
    train8_varied: the eight, and on varied maps those of them that change no texture"""
    suite: Suite = "core"
    """whose named tasks, if no scenario is given; core: the thesis's four scenarios; extended: later ones"""
    level: int | None = None
    """the named tasks of this level, 0..4"""

    def resolve(self) -> tuple[Task, ...]:
        """The tasks.

        Raises:
            TaskError: an unknown name. ConfigError: no ids, or ids together with another choice, or no task fits it.
        """
        if self.scenario is not None and self.suite != "core" and scenario_named(self.scenario).suite != self.suite:
            raise ConfigError(
                f"--suite: got {self.suite} and also --scenario {self.scenario}, which is of another suite"
            )
        if self.tasks is None:
            return self._named((self.scenario,))
        if not self.tasks:  # such as those of a shell's variable that is not set
            raise ConfigError("--tasks: got none, want at least one id")
        if replace(self, tasks=None) != ALL_TASKS:
            raise ConfigError(
                "--tasks: got ids and also --scenario, --split, --suite or --level, want one or the other"
            )
        return tuple(dict.fromkeys(parse_task(text) for text in self.tasks))

    def of_run(self, scenarios: Sequence[str]) -> tuple[Task, ...]:
        """The tasks that a run is evaluated on: of its own scenarios by default, and then the test sets.

        Raises:
            TaskError, ConfigError: as `resolve`.
        """
        if self.tasks is not None or self.scenario:
            return self.resolve()
        for scenario in map(scenario_named, scenarios):
            if self.suite not in ("core", scenario.suite):  # core: nothing was chosen
                raise ConfigError(
                    f"--suite: got {self.suite}, but the run was trained on {scenario.id}, which is of the suite "
                    f"{scenario.suite}; choose tasks of other scenarios by --scenario or --tasks"
                )
        split = "test" if replace(self, suite="core") == ALL_TASKS else self.split
        return replace(self, split=split)._named(scenarios)

    def _named(self, scenarios: Sequence[str | None]) -> tuple[Task, ...]:
        """The named tasks of these scenarios; None stands for all.

        Raises:
            ConfigError: there is none.
        """
        chosen = [task for one in scenarios for task in named_tasks(one, self.level, self.split, self.suite)]
        if not chosen:
            raise ConfigError(f"--level, --split: no task of {self.split or self.suite} has level {self.level}")
        return tuple(chosen)


ALL_TASKS = TaskSelection()
