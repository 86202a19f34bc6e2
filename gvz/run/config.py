"""A run's configuration: the dataclass, finding config files, JSON, and what may change when a run is resumed."""

import dataclasses
import difflib
import importlib.util
import math
import os
import re
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from actors.config import MAX_LANES, ActorsConfig
from gvz.core.env_config import EnvConfig, typed
from gvz.core.errors import ConfigError
from gvz.scenarios.base import Scenario, Split
from gvz.tasks import Task, named_tasks, parse_task
from learner.config import AgentConfig, LearnerConfig, ReplayConfig

CONFIG_SCHEMA = 1
"""Raised by one whenever a saved config.json can no longer be read as before."""

_SPLITS: dict[int, Split] = {1: "train1", 4: "train4", 8: "train8"}


@dataclass(frozen=True, kw_only=True, slots=True)
class CheckpointConfig:
    """When the whole state of a run is written, and how many copies are kept."""

    period_updates: int = 10_000
    """gradient steps between checkpoints; one more is written at the end and on Ctrl-C"""
    keep: int = 2
    """checkpoints kept with their replay; the newest valid one is resumed from"""

    def __post_init__(self) -> None:
        for name in ("period_updates", "keep"):
            if getattr(self, name) < 1:
                raise ConfigError(f"checkpoint.{name}: got {getattr(self, name)}, want at least 1")


@dataclass(frozen=True, kw_only=True, slots=True)
class LogConfig:
    """What is recorded besides episodes, which all are."""

    period_updates: int = 100
    """gradient steps between rows of metrics.jsonl and TensorBoard"""
    tensorboard: bool = True
    """write TensorBoard events too"""
    wandb: bool = False
    """send the scalars to Weights & Biases too (extra `wandb`); WANDB_MODE=offline keeps them in the run directory"""

    def __post_init__(self) -> None:
        if self.period_updates < 1:
            raise ConfigError(f"log.period_updates: got {self.period_updates}, want at least 1")


@dataclass(frozen=True, kw_only=True, slots=True)
class RunConfig:
    """One training run. Config files in configs/ make one; every field can be overridden by a flag."""

    name: str
    """names the run directory"""
    scenario: str = "defend_the_center"
    """scenario whose training set is played (unless tasks are named)"""
    training_set: Literal[1, 4, 8] = 4
    """tasks in the training set: 1 is the default task, 4 and 8 add tasks of level 1"""
    tasks: tuple[str, ...] | None = None
    """ids of the tasks to train on, all of one scenario, instead of a training set"""
    seed: int = 1111
    """seed of everything: parameters, noise, replay sampling, episodes"""
    mode: Literal["async", "sync"] = "async"
    """async: actors are processes; sync: everything in this process, bit-for-bit reproducible"""
    run_dir: Path | None = None
    """where the run is kept; default runs/<name>/seed_<seed>"""
    env: EnvConfig = field(default_factory=EnvConfig)
    actors: ActorsConfig = field(default_factory=ActorsConfig)
    agent: AgentConfig = field(default_factory=AgentConfig)
    replay: ReplayConfig = field(default_factory=ReplayConfig)
    learner: LearnerConfig = field(default_factory=LearnerConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)
    log: LogConfig = field(default_factory=LogConfig)

    def __post_init__(self) -> None:
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._+-]*", self.name):
            raise ConfigError(f"name: got {self.name!r}, want letters, digits and . _ + - (it names a directory)")
        if not 0 <= self.seed < 2**31:
            raise ConfigError(f"seed: got {self.seed}, want 0..{2**31 - 1}")
        _check_finite("", self)
        if self.env.buffers:
            raise ConfigError(f"env.buffers: got {self.env.buffers}, want none: the trainer's agents see frames alone")
        weights = self.resolved_scenario().reward_weights(dict(self.env.reward_weights), self.env.profile)
        if not any(weights.values()):
            raise ConfigError(
                f"env.reward_weights: got 0 for each of {', '.join(weights)}, want a reward to learn from"
            )
        if self.learner.warmup_steps > self.replay.capacity:
            raise ConfigError(
                f"learner.warmup_steps: got {self.learner.warmup_steps}, more than replay.capacity "
                f"{self.replay.capacity} can hold; lower the one or raise the other"
            )
        if self.learner.batch_size > self.learner.warmup_steps:
            raise ConfigError(
                f"learner.batch_size: got {self.learner.batch_size}, more than the {self.learner.warmup_steps} "
                "decisions of learner.warmup_steps; no batch could be drawn"
            )
        if self.replay.num_newest >= self.learner.batch_size:
            raise ConfigError(
                f"replay.num_newest: got {self.replay.num_newest}, want less than learner.batch_size "
                f"{self.learner.batch_size}: a batch also holds drawn transitions; lower the one or raise the other"
            )
        if self.num_lanes > MAX_LANES:
            raise ConfigError(
                f"actors.num_actors, games_per_actor: got {self.num_actors} times {self.games_per_actor} games, want "
                f"at most {MAX_LANES}"
            )
        smallest = self.num_lanes * 4 * (self.agent.stack_size + self.agent.n_steps)
        if self.replay.capacity < smallest:
            raise ConfigError(
                f"replay.capacity: got {self.replay.capacity}, want at least {smallest} for {self.num_lanes} games "
                "(each keeps a stream of its own)"
            )
        # a game can hold n_steps records and no complete transition; the first update comes after one decision more
        fewest = self.num_lanes * self.agent.n_steps
        if self.learner.warmup_steps < fewest:
            raise ConfigError(
                f"learner.warmup_steps: got {self.learner.warmup_steps}, want at least {fewest}, which is "
                f"agent.n_steps ({self.agent.n_steps}) for each of {self.num_lanes} games; with fewer decisions there "
                "may be no complete transition to draw; raise it, or lower actors.num_actors or actors.games_per_actor"
            )

    def resolved_tasks(self) -> tuple[Task, ...]:
        """The tasks of this run, all of one scenario.

        Raises:
            TaskError: an unknown scenario or task. ConfigError: tasks of two scenarios, none, or one twice.
        """
        if self.tasks is None:
            return named_tasks(scenario=self.scenario, split=_SPLITS[self.training_set])
        tasks = tuple(parse_task(text) for text in self.tasks)
        if not tasks:
            raise ConfigError("tasks: got none, want at least one task id")
        if len({task.scenario.id for task in tasks}) > 1:
            raise ConfigError(f"tasks: got tasks of {sorted({t.scenario.id for t in tasks})}, want one scenario")
        if len({task.id for task in tasks}) < len(tasks):
            raise ConfigError(f"tasks: got one task twice in {[task.id for task in tasks]}")
        return tasks

    def resolved_scenario(self) -> Scenario:
        """The scenario of this run's tasks."""
        return self.resolved_tasks()[0].scenario

    def value_range(self) -> tuple[float, float]:
        """(v_min, v_max): what the atoms of a return distribution span, as configured or of the scenario's returns."""
        scenario_range = self.resolved_scenario().return_range(self.env, self.agent.discount)
        return self.agent.value_range(*scenario_range)

    def with_value_range(self, v_min: float, v_max: float) -> "RunConfig":
        """The same with this range, if its agent learns return distributions."""
        if not self.agent.distributional:
            return self
        return dataclasses.replace(self, agent=dataclasses.replace(self.agent, v_min=v_min, v_max=v_max))

    @property
    def num_actors(self) -> int:
        """Actor processes, one per core by default. In sync mode 1: all games are played in one place."""
        return 1 if self.mode == "sync" else self._configured_actors

    @property
    def _configured_actors(self) -> int:
        if self.actors.num_actors is not None:
            return self.actors.num_actors
        # a synchronous run must not depend on the machine it is on
        return 1 if self.mode == "sync" else len(os.sched_getaffinity(0))

    @property
    def games_per_actor(self) -> int:
        """Games of one actor process; in sync mode all games of the run."""
        num_tasks, actors, games = len(self.resolved_tasks()), self._configured_actors, self.actors.games_per_actor
        if games is None:
            games = num_tasks * math.ceil(4 / num_tasks)
        if games * actors < num_tasks:
            raise ConfigError(
                f"actors.games_per_actor: got {games} games for each of {actors} actors, but there are {num_tasks} "
                f"tasks; every task needs a game: want at least {math.ceil(num_tasks / actors)}"
            )
        return games * actors if self.mode == "sync" else games

    @property
    def num_lanes(self) -> int:
        """Games of the run; each is one lane of the replay."""
        return self.num_actors * self.games_per_actor

    @property
    def resolved_run_dir(self) -> Path:
        return self.run_dir if self.run_dir is not None else Path("runs") / self.name / f"seed_{self.seed}"


def _check_finite(prefix: str, config: Any) -> None:
    for f in dataclasses.fields(config):
        value = getattr(config, f.name)
        if dataclasses.is_dataclass(value):
            _check_finite(f"{prefix}{f.name}.", value)
        elif isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{prefix}{f.name}: got {value}, want a finite number")


# ---------------------------------------------------------------------------------------------- config files


def configs_directory() -> Path:
    """The installed configs package: beside gvz in a checkout and in a wheel."""
    spec = importlib.util.find_spec("configs")
    if spec is None or not spec.submodule_search_locations:
        raise ConfigError("configs: the package of config files is not installed beside gvz; reinstall gvizdoom")
    return Path(next(iter(spec.submodule_search_locations)))


def find_config_file(text: str) -> Path:
    """A bare name is found in configs/ (with or without .py); anything with a separator is a path.

    Raises:
        ConfigError: no such file; names the nearest.
    """
    path = Path(text)
    is_name = path.name == text
    if is_name:
        path = configs_directory() / (text if text.endswith(".py") else f"{text}.py")
    try:
        if path.is_file():
            return path
    except OSError as error:  # a name too long, a directory that may not be entered
        raise ConfigError(f"--config: {text!r} cannot be read: {error.strerror}") from error
    if not is_name:
        raise ConfigError(f"--config: no file {text!r} here ({Path.cwd()})")
    names = sorted(p.stem for p in configs_directory().glob("*.py") if p.stem != "__init__")
    near = difflib.get_close_matches(Path(text).stem, names, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise ConfigError(f"--config: no config {text!r}; {hint}there are {', '.join(names)} (or give a path: ./{text})")


def load_config(text: str) -> RunConfig:
    """Runs a config file and returns its `CONFIG`.

    Raises:
        ConfigError: no such file, it fails, or it does not define `CONFIG: RunConfig`.
    """
    path = find_config_file(text)
    namespace: dict[str, Any] = {"__name__": f"configs.{path.stem}", "__file__": str(path)}
    try:
        exec(compile(path.read_text(), str(path), "exec"), namespace)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error
    except Exception as error:  # a config file is the user's own program: anything may come out of it
        raise ConfigError(f"{path}: {type(error).__name__}: {error}") from error
    config = namespace.get("CONFIG")
    if not isinstance(config, RunConfig):
        raise ConfigError(f"{path}: got {type(config).__name__} for CONFIG, want `CONFIG = RunConfig(...)`")
    try:
        return _from_plain(
            RunConfig, config_to_dict(config)["config"], "CONFIG"
        )  # checks the types, which Python lets be
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


# ------------------------------------------------------------------------------------------------------ JSON


def config_to_dict(config: RunConfig) -> dict[str, Any]:
    """The configuration with its derived values, as plain JSON types."""

    def plain(value: Any) -> Any:
        if dataclasses.is_dataclass(value):
            return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        if isinstance(value, tuple):
            return [plain(v) for v in value]
        return str(value) if isinstance(value, Path) else value

    return {
        "schema": CONFIG_SCHEMA,
        "config": plain(config),
        "resolved": {
            "tasks": [task.id for task in config.resolved_tasks()],
            "num_actors": config.num_actors,
            "games_per_actor": config.games_per_actor,
            "value_range": config.value_range(),
        },
    }


def config_from_dict(saved: Any) -> RunConfig:
    """The configuration that `config_to_dict` wrote, with the derived numbers it ran with made explicit.

    Raises:
        ConfigError: another schema, an unknown or missing key, a wrong type or value.
    """
    if not isinstance(saved, dict) or saved.get("schema") != CONFIG_SCHEMA:
        raise ConfigError(f"saved configuration: want a map with schema {CONFIG_SCHEMA}")
    config = _from_plain(RunConfig, saved.get("config"), "config")
    resolved = _from_plain(_Resolved, saved.get("resolved"), "resolved")
    if resolved.tasks != (tasks := tuple(task.id for task in config.resolved_tasks())):
        raise ConfigError(f"resolved.tasks: got {list(resolved.tasks)}, but the configuration has {list(tasks)}")
    if resolved.value_range is not None:
        config = config.with_value_range(*resolved.value_range)
    if config.mode == "sync":
        return config
    numbers = {"num_actors": resolved.num_actors, "games_per_actor": resolved.games_per_actor}
    return dataclasses.replace(config, actors=dataclasses.replace(config.actors, **numbers))


@dataclass(frozen=True, kw_only=True, slots=True)
class _Resolved:
    """What a run derived from its configuration and its machine."""

    tasks: tuple[str, ...]
    num_actors: int
    games_per_actor: int
    value_range: tuple[float, float] | None = None
    """missing in runs of older versions"""


def _from_plain(kind: Any, value: Any, where: str) -> Any:
    """Builds a value of type `kind` from JSON types, strictly."""
    if not dataclasses.is_dataclass(kind) or not isinstance(kind, type):
        return typed(kind, value, where)
    if not isinstance(value, dict):
        raise ConfigError(f"{where}: got {type(value).__name__}, want a map")
    hints = typing.get_type_hints(kind)
    unknown = sorted(value.keys() - hints.keys())
    if unknown:
        near = difflib.get_close_matches(unknown[0], hints, n=1)
        raise ConfigError(f"{where}.{unknown[0]}: unknown key" + (f", did you mean {near[0]}?" if near else ""))
    needed = {f.name for f in dataclasses.fields(kind) if f.default is f.default_factory is dataclasses.MISSING}
    if missing := sorted(needed - value.keys()):
        raise ConfigError(f"{where}.{missing[0]}: missing")
    return kind(**{key: _from_plain(hints[key], item, f"{where}.{key}") for key, item in value.items()})


# ---------------------------------------------------------------------------------------------------- resume

_MAY_CHANGE = (
    "run_dir",
    "name",
    "learner.total_updates",
    "actors.ring_capacity",
    "actors.start_timeout_s",
    "actors.heartbeat_timeout_s",
    "actors.max_restarts",
    "actors.restart_window_s",
    "actors.recycle_episodes",
    "learner.num_updates_per_call",
    "agent.conv_form",
    "checkpoint.*",
    "log.*",
)
"""Fields that leave a run what it was. Everything else changes its meaning."""


def differences(old: RunConfig, new: RunConfig) -> list[str]:
    """`field: old -> new` for every difference that would change the meaning of a run that goes on.

    Args:
        old: as it was saved, with the range of its atoms (`config_from_dict`); None for a run that did not save it.
        new: as it was given: an open range is what it is derived to be now.
    """

    def flat(config: RunConfig) -> dict[str, Any]:
        values: dict[str, Any] = {}

        def walk(prefix: str, item: Any) -> None:
            for f in dataclasses.fields(item):
                value = getattr(item, f.name)
                if dataclasses.is_dataclass(value):
                    walk(f"{prefix}{f.name}.", value)
                else:
                    values[prefix + f.name] = value

        walk("", config)
        for derived in ("scenario", "training_set", "actors.num_actors", "actors.games_per_actor"):
            del values[derived]
        values["tasks"] = tuple(task.id for task in config.resolved_tasks())
        values["actors.num_actors"], values["actors.games_per_actor"] = (
            config.num_actors,
            config.games_per_actor,
        )
        return values

    def may_change(name: str) -> bool:
        return name in _MAY_CHANGE or f"{name.split('.')[0]}.*" in _MAY_CHANGE

    before, after = flat(old), flat(new.with_value_range(*new.value_range()))
    changed = [f"{k}: {before[k]} -> {after[k]}" for k in before if before[k] != after[k] and not may_change(k)]
    if new.learner.total_updates < old.learner.total_updates:
        changed.append(
            f"learner.total_updates: {old.learner.total_updates} -> {new.learner.total_updates} (it may only grow)"
        )
    return changed
