"""What an experiment is: a grid of training runs and what they are evaluated on.

Source: thesis 5.1.1 (seeds, checkpoints, episodes) and 5.2 (the four experiments).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from types import MappingProxyType
from typing import Literal, get_args

from gvz.core.env_config import SimplePlayer
from gvz.core.errors import ConfigError
from gvz.core.registry import discover
from gvz.run.config import load_config
from gvz.scenarios.base import Split, nearest
from gvz.tasks import Task, named_tasks, scenario_named

SCENARIOS = ("defend_the_center", "health_gathering", "seek_and_kill", "dodge_projectiles")
"""in the thesis's order"""

EACH_TASK = "each"
"""as a training: every named task of the scenario, alone"""

EvaluateOn = Literal["own", "test", "all"]
Columns = Literal["level", "training", "config"]

Published = Mapping[str, Mapping[str, tuple[float, ...]]]
"""who published -> scenario id -> percent of the upper bound, by column of the table"""


RECIPE_NOTE = (
    "The thesis also weights tasks by their KPI and puts the newest transitions into every batch. rainbow_4task has "
    "neither; rainbow_4task_thesis has both (docs/AGENTS.md)."
)
"""of an experiment of the thesis that trains rainbow_4task"""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingRun:
    """One cell of the grid. Equal ones are trained once, however many experiments have them."""

    config: str
    """file in configs/"""
    scenario: str
    training: str
    """train1, train4, train8, or the name of the one task trained on"""
    tasks: tuple[str, ...]
    """ids of the tasks trained on"""
    seed: int
    total_updates: int
    num_checkpoints: int
    """saved at equal distances, the last one at the end"""

    @property
    def id(self) -> str:
        """Where the run is kept: "rainbow_4task/defend_the_center/train4/seed_1111"."""
        return f"{self.config}/{self.scenario}/{self.training}/seed_{self.seed}"

    @property
    def checkpoint_period_updates(self) -> int:
        return self.total_updates // self.num_checkpoints

    @property
    def checkpoints(self) -> tuple[int, ...]:
        """Gradient steps at which the run is saved and evaluated."""
        earlier = (n * self.checkpoint_period_updates for n in range(1, self.num_checkpoints))
        return (*earlier, self.total_updates)


@dataclass(frozen=True, kw_only=True, slots=True)
class Experiment:
    """A question, the runs that answer it, and the table that shows the answer: a row for every scenario."""

    name: str
    """of its file"""
    title: str
    source: str
    """section and table"""
    question: str
    """one sentence"""
    configs: tuple[str, ...]
    """files in configs/"""
    scenarios: tuple[str, ...] = SCENARIOS
    trainings: tuple[str, ...]
    """train1, train4, train8: a training set; each: every named task alone"""
    seeds: tuple[int, ...] = (1111, 2222, 3333)
    total_updates: int = 200_000
    """gradient steps of a run"""
    num_checkpoints: int = 20
    """each of them is evaluated"""
    episodes: int = 100
    """evaluation episodes of a task"""
    evaluate_on: EvaluateOn
    """own: the task trained on; test: the scenario's test set; all: its named tasks"""
    tasks_per_level: int | None = None
    """this many tasks of a level are trained alone and evaluated on, in the thesis's order; None: all (see `scale`)"""
    table_checkpoints: int = 5
    """the table is over the last checkpoints, this many"""
    columns: Columns
    """of the table"""
    players: tuple[SimplePlayer, ...] = ("random",)
    """who else plays the evaluation episodes"""
    published: Published = field(default_factory=lambda: MappingProxyType({}))
    """to stand beside the table, never in it"""
    notes: tuple[str, ...] = ()
    """what a reader of the table must know"""

    def __post_init__(self) -> None:
        for name in ("configs", "scenarios", "trainings", "seeds"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                raise ConfigError(f"experiment {self.name}: {name}: got {values}, want at least one, each once")
        for name in ("total_updates", "num_checkpoints", "episodes", "table_checkpoints"):
            if getattr(self, name) < 1:
                raise ConfigError(f"experiment {self.name}: {name}: got {getattr(self, name)}, want at least 1")
        if not self.table_checkpoints <= self.num_checkpoints <= self.total_updates:
            raise ConfigError(
                f"experiment {self.name}: got table_checkpoints {self.table_checkpoints}, num_checkpoints "
                f"{self.num_checkpoints}, total_updates {self.total_updates}, want each at most the next"
            )
        for training in self.trainings:
            if training != EACH_TASK and (training not in get_args(Split) or training == "test"):
                raise ConfigError(
                    f"experiment {self.name}: trainings: got {training!r}, want train1, train4, train8 or {EACH_TASK}"
                )
        if self.evaluate_on == "own" and self.trainings != (EACH_TASK,):
            raise ConfigError(f"experiment {self.name}: evaluate_on 'own' wants trainings ('{EACH_TASK}',)")
        for scenario in self.scenarios:
            scenario_named(scenario)
        width = len(self.column_names)
        for who, rows in self.published.items():
            for scenario, values in rows.items():
                if len(values) != width:
                    raise ConfigError(
                        f"experiment {self.name}: published by {who}, {scenario}: got {len(values)} numbers, want "
                        f"{width}, one for each column ({', '.join(self.column_names)})"
                    )

    @property
    def column_names(self) -> tuple[str, ...]:
        """What the columns of the table stand for."""
        match self.columns:
            case "level":
                return ("0", "1", "2", "3", "4")
            case "training":
                return self.trainings
            case "config":
                return self.configs

    def runs(self) -> tuple[TrainingRun, ...]:
        """The grid: by scenario, training, config, seed."""
        return tuple(
            TrainingRun(
                config=config,
                scenario=scenario,
                training=training,
                tasks=tasks,
                seed=seed,
                total_updates=self.total_updates,
                num_checkpoints=self.num_checkpoints,
            )
            for scenario in self.scenarios
            for training, tasks in self._training_sets(scenario).items()
            for config in self.configs
            for seed in self.seeds
        )

    def evaluation_tasks(self, run: TrainingRun) -> tuple[str, ...]:
        """Ids of the tasks that a run of this experiment is evaluated on."""
        match self.evaluate_on:
            case "own":
                return run.tasks
            case "test":
                return self._thinned(named_tasks(run.scenario, split="test"))
            case "all":
                return self._thinned(named_tasks(run.scenario))

    def table_tasks(self, run: TrainingRun) -> tuple[str, ...]:
        """Ids of the tasks the table is over: those of its levels, or else the test tasks among the evaluated."""
        tasks = self.evaluation_tasks(run)
        if self.columns == "level":
            return tasks
        test = {task.id for task in named_tasks(run.scenario, split="test")}
        return tuple(task for task in tasks if task in test)

    def _training_sets(self, scenario: str) -> dict[str, tuple[str, ...]]:
        sets: dict[str, tuple[str, ...]] = {}
        for training in self.trainings:
            if training == EACH_TASK:
                sets |= {id.partition("/")[2]: (id,) for id in self._thinned(named_tasks(scenario))}
            else:
                split: Split = training  # pyright: ignore[reportAssignmentType]  # checked in __post_init__
                sets[training] = tuple(task.id for task in named_tasks(scenario, split=split))
        return sets

    def _thinned(self, tasks: tuple[Task, ...]) -> tuple[str, ...]:
        """Ids of the first `tasks_per_level` of each level."""
        taken: dict[int, int] = {}
        ids: list[str] = []
        for task in tasks:
            taken[task.level] = taken.get(task.level, 0) + 1
            if self.tasks_per_level is None or taken[task.level] <= self.tasks_per_level:
                ids.append(task.id)
        return tuple(ids)


@cache
def experiments() -> dict[str, Experiment]:
    """Every experiment there is, by name: the modules of gvz.experiments that have an EXPERIMENT.

    Raises:
        ConfigError: one names a config that is not there.
    """
    found = {n: m.EXPERIMENT for n, m in discover("gvz.experiments").items() if hasattr(m, "EXPERIMENT")}
    assert all(name == experiment.name for name, experiment in found.items()), "an experiment's name is its file's"
    for config in {config for experiment in found.values() for config in experiment.configs}:
        load_config(config)
    return found


def experiment_named(name: str) -> Experiment:
    """The experiment of this name.

    Raises:
        ConfigError: there is none; lists those there are, and the nearest.
    """
    known = experiments()
    if name not in known:
        raise ConfigError(f"unknown experiment {name!r}{nearest(name, list(known))}; want one of {', '.join(known)}")
    return known[name]
