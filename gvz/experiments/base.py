"""What an experiment is: a grid of training runs and what they are evaluated on.

Source: thesis 5.1.1 (seeds, checkpoints, episodes) and 5.2 (the four experiments).
"""

import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from types import MappingProxyType
from typing import Any, Literal, get_args

from gvz.core.env_config import check_types
from gvz.core.errors import ConfigError, nearest
from gvz.core.registry import named
from gvz.evaluation.simple import SIMPLE_PLAYERS
from gvz.run.config import RunConfig
from gvz.run.config_files import load_config, with_settings
from gvz.scenarios.map_set import PROCEDURAL, VARIED, names_map_set
from gvz.tasks import LEVELS, Task, TrainingSet, attribute_tasks, named_tasks, parse_task, scenario_named, scenarios

EACH_TASK = "each"
"""as a training: every named task of the scenario, alone"""

EvaluateOn = Literal["own", "test", "all", "gate", "procedural", "attributes"]
Columns = Literal["level", "training", "config"]

SET_BY_EXPERIMENT = (
    *("name", "scenario", "training_set", "tasks", "seed", "run_dir", "max_processor_s"),
    *("learner.total_updates", "checkpoint.period_updates"),
)
"""fields of RunConfig that a variant does not set: they follow from the experiment"""

Published = Mapping[str, Mapping[str, tuple[float, ...]]]
"""who published -> scenario id -> percent of the upper bound, by column of the table"""


RECIPE_NOTE = (
    "The thesis also weights tasks by their KPI and puts the newest transitions into every batch. rainbow_4task has "
    "neither; rainbow_4task_thesis has both (docs/AGENTS.md)."
)
"""of an experiment of the thesis that trains rainbow_4task"""


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingRun:
    """One cell of the grid. A run that several experiments have is trained once."""

    config: str
    """file in configs/"""
    scenario: str
    training: str
    """a training set (gvz.tasks), or the name of the one task trained on"""
    tasks: tuple[str, ...]
    """ids of the tasks trained on"""
    seed: int
    total_updates: int
    num_checkpoints: int
    """saved at equal distances, the last one at the end"""
    variant: str | None = None
    """of the config"""
    settings: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """of the variant: dotted field of RunConfig -> value"""
    max_processor_s: float | None = None
    """processor time at which the run ends, seconds; then only its last checkpoint is evaluated"""

    @property
    def agent(self) -> str:
        """The config and its variant: "rainbow_4task", "rainbow_4task+large_batch"."""
        return _agent(self.config, self.variant)

    @property
    def id(self) -> str:
        """Where the run is kept: "rainbow_4task/defend_the_center/train4/seed_1111"."""
        return f"{self.agent}/{self.scenario}/{self.training}/seed_{self.seed}"

    @property
    def run_config(self) -> RunConfig:
        """Its config file with the settings of its variant, at full size."""
        config = load_config(self.config, self.scenario)
        return with_settings(config, {"scenario": self.scenario, **self.settings})

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
    variants: Mapping[str, Mapping[str, Any]] = field(default_factory=lambda: MappingProxyType({}))
    """name -> settings (dotted field of RunConfig -> value): every config is trained with each of them. Without
    variants every config is trained as it is; a variant without settings is the config as it is, too."""
    scenarios: tuple[str, ...] = ()
    """default: those that numbers were published of, or else all"""
    trainings: tuple[str, ...]
    """a training set (gvz.tasks.TrainingSet), such as train4; varied-100, procedural-train-100: such a task; each:
    every named task alone"""
    seeds: tuple[int, ...] = (1111, 2222, 3333)
    total_updates: int = 200_000
    """gradient steps of a run"""
    max_processor_s: float | None = None
    """a run ends after this processor time (learner, actors and games together), seconds, or after `total_updates` if
    these are done before; num_checkpoints is then 1"""
    num_checkpoints: int = 20
    """each of them is evaluated"""
    episodes: int = 100
    """evaluation episodes of a task"""
    evaluate_on: EvaluateOn
    """own: the task trained on; test: the scenario's test set; all: its named tasks; gate: its gate set and the tasks
    trained on, with a table over each; procedural: `procedural-test` and the tasks trained on, likewise; attributes:
    the default task, every attribute alone, every two of them"""
    tasks_per_level: int | None = None
    """only this many tasks of a level are used, in the thesis's order; None: all (see `scale`)"""
    table_checkpoints: int = 5
    """the table uses this many of the last checkpoints"""
    columns: Columns
    """of the table"""
    players: tuple[str, ...] = ("random",)
    """simple players that play the evaluation episodes, too"""
    published: Published = field(default_factory=lambda: MappingProxyType({}))
    """shown in rows of their own; no mean of ours includes them"""
    notes: tuple[str, ...] = ()
    """shown with the table"""

    def __post_init__(self) -> None:
        check_types(self, f"experiment {self.name}", convert=False)
        if not self.scenarios:
            object.__setattr__(self, "scenarios", tuple(next(iter(self.published.values()), scenarios())))
        if (problem := next(self._problems(), None)) is not None:
            raise ConfigError(f"experiment {self.name}: {problem}")

    def _problems(self) -> Iterator[str]:
        """Why the experiment cannot be; each reason may depend on the absence of those before it."""
        for name in ("configs", "scenarios", "trainings", "seeds"):
            values = getattr(self, name)
            if not values or len(set(values)) < len(values):
                yield f"{name}: got {values}, want at least one, each once"
        for name in ("total_updates", "num_checkpoints", "episodes", "table_checkpoints", "tasks_per_level"):
            if (number := getattr(self, name)) is not None and number < 1:
                yield f"{name}: got {number}, want at least 1"
        if not self.table_checkpoints <= self.num_checkpoints <= self.total_updates:
            yield (
                f"got table_checkpoints {self.table_checkpoints}, num_checkpoints {self.num_checkpoints}, "
                f"total_updates {self.total_updates}, want each at most the next"
            )
        for training in self.trainings:
            known = training == EACH_TASK or names_map_set(training)
            if not known and training not in get_args(TrainingSet):
                yield (
                    f"trainings: got {training!r}, want {', '.join(get_args(TrainingSet))}, {VARIED}, "
                    f"{VARIED}-<number of maps>, {PROCEDURAL}-<split>-<number of maps> or {EACH_TASK}"
                )
        for name, settings in self.variants.items():
            if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):
                yield f"variants: got {name!r}, want letters, digits and . _ - (it names a directory)"
            if taken := [field for field in settings if field in SET_BY_EXPERIMENT]:
                yield f"variant {name} sets {', '.join(taken)}, which the experiment sets itself"
        if self.max_processor_s is not None and (self.max_processor_s <= 0 or self.num_checkpoints != 1):
            yield (
                f"got max_processor_s {self.max_processor_s:g} and num_checkpoints {self.num_checkpoints}, want more "
                "than 0 and exactly 1: a run that ends by its processor time is evaluated at its end"
            )
        if self.compares_training and self.columns == "level":
            yield f"evaluate_on {self.evaluate_on!r} wants columns 'config' or 'training'"
        if self.evaluate_on != "own":
            mixed = {
                "trainings": self.trainings if self.columns != "training" else (),
                "agents": self.agents if self.columns != "config" else (),
            }
            for name, several in mixed.items():
                if len(several) > 1 or EACH_TASK in several:
                    yield f"{name}: got {', '.join(several)}, want one: columns {self.columns!r} would mix them"
        if self.evaluate_on == "own" and self.trainings != (EACH_TASK,):
            yield f"evaluate_on 'own' wants trainings ('{EACH_TASK}',)"
        for scenario in self.scenarios:
            scenario_named(scenario)
        if unknown := set(self.players) - set(SIMPLE_PLAYERS):
            yield f"players: got {', '.join(sorted(unknown))}, want some of {', '.join(SIMPLE_PLAYERS)}"
        width = len(self.column_names)
        for who, rows in self.published.items():
            for scenario, values in rows.items():
                scenario_named(scenario)
                if len(values) != width:
                    yield (
                        f"published by {who}, {scenario}: got {len(values)} numbers, want {width}, one for each "
                        f"column ({', '.join(self.column_names)})"
                    )

    @property
    def compares_training(self) -> bool:
        """Whether there is a second table over the tasks trained on."""
        return self.evaluate_on in ("gate", "procedural")

    @property
    def budget(self) -> str:
        """Of a run, in words."""
        return budget_text(self.total_updates, self.max_processor_s)

    @property
    def agents(self) -> tuple[str, ...]:
        """The configs, each with each of the variants."""
        return tuple(_agent(config, variant) for config in self.configs for variant in self.variants or (None,))

    @property
    def column_names(self) -> tuple[str, ...]:
        """What the columns of the table stand for."""
        match self.columns:
            case "level":
                return tuple(map(str, LEVELS))
            case "training":
                return self.trainings
            case "config":
                return self.agents

    def runs(self) -> tuple[TrainingRun, ...]:
        """The grid: by scenario, training, config, variant, seed."""
        return tuple(
            TrainingRun(
                config=config,
                scenario=scenario,
                training=training,
                tasks=tasks,
                seed=seed,
                total_updates=self.total_updates,
                num_checkpoints=self.num_checkpoints,
                variant=variant,
                settings={} if variant is None else self.variants[variant],
                max_processor_s=self.max_processor_s,
            )
            for scenario in self.scenarios
            for training, tasks in self._training_sets(scenario).items()
            for config in self.configs
            for variant in self.variants or (None,)
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
            case "attributes":
                return self._thinned(attribute_tasks(run.scenario))
            case "gate":
                return tuple(dict.fromkeys((*self._thinned(named_tasks(run.scenario, split="gate")), *run.tasks)))
            case "procedural":
                return tuple(dict.fromkeys((_procedural_test(run.scenario), *run.tasks)))

    def table_tasks(self, run: TrainingRun) -> tuple[str, ...]:
        """Ids of the tasks the table is over: those of its levels, the gate tasks of a gate, `procedural-test`, or the
        test tasks.
        """
        tasks = self.evaluation_tasks(run)
        if self.columns == "level":
            return tasks
        if self.evaluate_on == "procedural":
            return (_procedural_test(run.scenario),)
        split = "gate" if self.evaluate_on == "gate" else "test"
        counted = {task.id for task in named_tasks(run.scenario, split=split)}
        return tuple(task for task in tasks if task in counted)

    def _training_sets(self, scenario: str) -> dict[str, tuple[str, ...]]:
        sets: dict[str, tuple[str, ...]] = {}
        for training in self.trainings:
            if training == EACH_TASK:
                sets |= {id.partition("/")[2]: (id,) for id in self._thinned(named_tasks(scenario))}
            elif names_map_set(training):
                sets[training] = (parse_task(f"{scenario}/{training}").id,)
            else:
                split: TrainingSet = training  # pyright: ignore[reportAssignmentType]  # checked in __post_init__
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


def budget_text(total_updates: int, max_processor_s: float | None) -> str:
    """What a run may take, in words."""
    limit = "" if max_processor_s is None else f"{max_processor_s:,.10g} seconds of processor time, at most "
    return f"{limit}{total_updates:,} gradient steps"


def _procedural_test(scenario: str) -> str:
    return parse_task(f"{scenario}/{PROCEDURAL}-test").id


def _agent(config: str, variant: str | None) -> str:
    return config if variant is None else f"{config}+{variant}"


@cache
def experiments() -> dict[str, Experiment]:
    """Every experiment there is, by name: the modules of gvz.experiments that have an EXPERIMENT.

    Raises:
        ConfigError: one names a config that is not there, has a variant that its config refuses, or has not the name
            of its file.
    """
    found: dict[str, Experiment] = named("gvz.experiments", "EXPERIMENT", "name")
    for experiment in found.values():
        for config, scenario in itertools.product(experiment.configs, experiment.scenarios):
            defaults = load_config(config, scenario)
            for variant, settings in experiment.variants.items():
                try:
                    with_settings(defaults, {"scenario": scenario, **settings})
                except ConfigError as error:
                    where = f"experiment {experiment.name}: variant {variant} of {config}"
                    raise ConfigError(f"{where}: {error}") from error
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
