"""A run's configuration: its dataclasses, what follows from them, and what does not fit together."""

import dataclasses
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from actors.config import MAX_LANES, ActorsConfig
from gvz.cluster.config import ClusterConfig
from gvz.core.control_groups import num_cores
from gvz.core.env_config import EnvConfig, check_types, leaves
from gvz.core.errors import ConfigError
from gvz.core.registry import OwnFiles
from gvz.run.curriculum_config import CurriculumConfig, check_curriculum
from gvz.run.group_config import GroupConfig
from gvz.task_table import TaskTable, task_table
from gvz.tasks import TrainingSet, named_tasks
from learner.agents.configs.rainbow import RainbowConfig
from learner.config import AgentConfig, LearnerConfig, OnPolicyConfig, ReplayConfig, ValueConfig, change_agent, unused

MIN_CLUSTER_SLOTS = 128
"""step records that a game has room for in the replay of a run with actor hosts"""
_FEW_TASKS = 16
"""Up to this number of tasks, every actor has a game of each task. With more, the actors share the tasks."""
_SPLITS: dict[int | str, TrainingSet] = {
    1: "train1",
    4: "train4",
    8: "train8",
    "pairs": "pairs",
    "compositions": "compositions",
    "train8_varied": "train8_varied",
}


@dataclass(frozen=True, kw_only=True, slots=True)
class CheckpointConfig:
    """When the whole state of a run is written, and how many copies are kept."""

    period_updates: int = 10_000
    """gradient steps between checkpoints; one more is written at the end and on Ctrl-C"""
    period_s: float = 900.0
    """seconds after which a run of one learner process writes one more, however few gradient steps it has made"""
    keep: int = 2
    """checkpoints kept with their replay; the newest valid one is resumed from"""

    def __post_init__(self) -> None:
        for name in ("period_updates", "period_s", "keep"):
            if not getattr(self, name) >= 1:
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
    training_set: Literal[1, 4, 8, "pairs", "compositions", "train8_varied"] = 4
    """tasks in the training set: 1 is the default task, 4 and 8 add tasks of level 1, pairs adds to 8 each two of
    their attributes that go together and are no named task, compositions any number of them, train8_varied adds to
    8 those of them that change no texture, on varied maps"""
    tasks: tuple[str, ...] | None = None
    """ids of the tasks to train on, instead of a training set; of several scenarios with env.action_set unified_v1"""
    seed: int = 1111
    """seed of everything: parameters, noise, replay sampling, episodes"""
    mode: Literal["async", "sync"] = "async"
    """async: actors are processes; sync: everything in this process, bit-for-bit reproducible"""
    max_processor_s: float | None = None
    """seconds of processor time, of learner, actors and games together, after which the run ends; default: never"""
    run_dir: Path | None = None
    """where the run is kept; default runs/<name>/seed_<seed>"""
    env: EnvConfig = field(default_factory=EnvConfig)
    actors: ActorsConfig = field(default_factory=ActorsConfig)
    cluster: ClusterConfig = field(default_factory=ClusterConfig)
    curriculum: CurriculumConfig = field(default_factory=CurriculumConfig)
    agent: AgentConfig = field(default_factory=RainbowConfig)
    replay: ReplayConfig | None = field(default_factory=ReplayConfig)
    """None for an agent that learns on-policy"""
    learner: LearnerConfig | OnPolicyConfig = field(default_factory=LearnerConfig)
    group: GroupConfig = field(default_factory=GroupConfig)
    checkpoint: CheckpointConfig = field(default_factory=CheckpointConfig)
    log: LogConfig = field(default_factory=LogConfig)

    def __post_init__(self) -> None:
        check_types(self, "CONFIG")
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._+-]*", self.name):
            raise ConfigError(f"name: got {self.name!r}, want letters, digits and . _ + - (it names a directory)")
        if not 0 <= self.seed < 2**31:
            raise ConfigError(f"seed: got {self.seed}, want 0..{2**31 - 1}")
        for name, value in leaves(self):
            if isinstance(value, float) and not math.isfinite(value):
                raise ConfigError(f"{name}: got {value}, want a finite number")
        if self.max_processor_s is not None and self.max_processor_s <= 0:
            raise ConfigError(f"max_processor_s: got {self.max_processor_s:g}, want more than 0")
        if self.env.buffers:
            raise ConfigError(f"env.buffers: got {self.env.buffers}, want none: the trainer's agents see frames alone")
        if self.env.action_set == "multi_discrete_v1":
            raise ConfigError(
                "env.action_set: got multi_discrete_v1, want unified_v1: the trainer's actions are discrete"
            )
        if self.mode == "sync" and self.actors.inference == "device":
            raise ConfigError(
                'actors.inference: got "device" with mode "sync", where one process plays and learns in turn; '
                'want "actors", or mode "async"'
            )
        if self.cluster.hosts:
            self._check_cluster()
        if self.group.num_processes > 1:
            self._check_group()
        check_curriculum(self.curriculum, self.table)
        if self.num_lanes > MAX_LANES:
            raise ConfigError(
                f"actors.num_actors, games_per_actor: got {self.num_actors} times {self.games_per_actor} games, want "
                f"at most {MAX_LANES}"
            )
        if self.agent.on_policy:
            self._check_rollouts()
        else:
            self._check_replay(*off_policy(self))

    def _check_cluster(self) -> None:
        for name, got, want in (("mode", self.mode, "async"), ("actors.inference", self.actors.inference, "actors")):
            if got != want:
                raise ConfigError(f'{name}: got "{got}" with cluster.hosts {self.cluster.hosts}; want "{want}"')
        if self.replay is not None and self.replay.capacity < (least := MIN_CLUSTER_SLOTS * self.num_lanes):
            raise ConfigError(
                f"replay.capacity: got {self.replay.capacity}, want at least {least} with cluster.hosts, which is "
                f"{MIN_CLUSTER_SLOTS} for each of {self.num_lanes} games: records of a host come in batches"
            )

    def _check_group(self) -> None:
        for name, got, fits, wanted in (
            ("agent.name", self.agent.name, not self.agent.on_policy, "an agent that learns from a replay"),
            ("mode", self.mode, self.mode == "async", "async"),
            ("max_processor_s", self.max_processor_s, self.max_processor_s is None, "none: all must end together"),
            ("cluster.hosts", self.cluster.hosts, not self.cluster.hosts, "0: these two were never tried together"),
            ("checkpoint.keep", self.checkpoint.keep, self.checkpoint.keep > 1, "at least 2: one that all have stays"),
        ):
            if not fits:
                raise ConfigError(f"{name}: got {got} with {self.group.num_processes} learner processes, want {wanted}")

    def _check_rollouts(self) -> None:
        learner = self.learner
        if not isinstance(learner, OnPolicyConfig) or self.replay is not None:
            raise _unfit(self, "learns on-policy", "learner=OnPolicyConfig(...), replay=None")
        if self.agent.learns_sight:
            raise ConfigError(
                f"agent.name: {self.agent.name!r} learns on-policy and its configuration has `learns_sight` True; want "
                "False: a loss of sight is for agents that learn from a replay"
            )
        num_steps = self.num_lanes * learner.rollout_steps
        if num_steps % learner.num_minibatches:
            raise ConfigError(
                f"learner.num_minibatches: got {learner.num_minibatches}, want a divisor of the {num_steps} steps of a "
                f"rollout, which are learner.rollout_steps {learner.rollout_steps} for each of {self.num_lanes} games"
            )

    def _check_replay(self, learner: LearnerConfig, replay: ReplayConfig) -> None:
        if learner.warmup_steps > replay.capacity:
            raise ConfigError(
                f"learner.warmup_steps: got {learner.warmup_steps}, more than replay.capacity "
                f"{replay.capacity} can hold; lower the one or raise the other"
            )
        if learner.batch_size > learner.warmup_steps:
            raise ConfigError(
                f"learner.batch_size: got {learner.batch_size}, more than the {learner.warmup_steps} "
                "decisions of learner.warmup_steps; no batch could be drawn"
            )
        if replay.num_newest >= learner.batch_size:
            raise ConfigError(
                f"replay.num_newest: got {replay.num_newest}, want less than learner.batch_size "
                f"{learner.batch_size}: a batch also holds drawn transitions; lower the one or raise the other"
            )
        for name, value in (
            ("actors.num_actors times games_per_actor", self.num_lanes),
            ("learner.batch_size", learner.batch_size),
            ("replay.num_newest", replay.num_newest),
        ):
            if learner.devices > 1 and value % learner.devices:
                raise ConfigError(
                    f"learner.devices: got {learner.devices}, want a divisor of {name}, which is {value}: every device "
                    "has an equal part of it; change the one or the other"
                )
        smallest = self.num_lanes * self._slots_per_game
        if replay.capacity < smallest:
            raise ConfigError(
                f"replay.capacity: got {replay.capacity}, want at least {smallest} for {self.num_lanes} games "
                "(each keeps a stream of its own)"
            )
        # a game can hold n_steps records and no complete transition; the first update comes after one decision more
        fewest = self.num_lanes * self._n_steps
        if learner.warmup_steps < fewest:
            raise ConfigError(
                f"learner.warmup_steps: got {learner.warmup_steps}, want at least {fewest}, which is "
                f"agent.n_steps ({self._n_steps}) for each of {self.num_lanes} games; with fewer decisions there "
                "may be no complete transition to draw; raise it, or lower actors.num_actors or actors.games_per_actor"
            )

    @property
    def table(self) -> TaskTable:
        """The tasks of this run.

        Raises:
            TaskError, ConfigError: as `task_table`.
        """
        ids = self.tasks
        if ids is None:
            ids = tuple(task.id for task in named_tasks(scenario=self.scenario, split=_SPLITS[self.training_set]))
        return task_table(ids, self.env, self.agent.discount, scale_rewards=self.agent.scale_rewards)

    @property
    def support(self) -> tuple[float, float] | None:
        """(v_min, v_max): what the atoms of a return distribution span; None for an agent without atoms."""
        return self.agent.support(*self.table.return_range)

    @property
    def own_files(self) -> OwnFiles:
        """Those of the agent and the encoder, if they are none of this package."""
        found = (Path(name) if name.endswith(".py") else None for name in (self.agent.name, self.agent.encoder))
        return OwnFiles(*found)

    def with_support(self, support: tuple[float, float] | None) -> "RunConfig":
        """The same with atoms of this range, if its agent has atoms."""
        return self if support is None else dataclasses.replace(self, agent=self.agent.with_support(*support))

    @property
    def env_steps_per_update(self) -> float:
        """Decisions, all games together, for a gradient step after warm-up; of a rollout, its steps."""
        if isinstance(self.learner, LearnerConfig):
            return self.learner.env_steps_per_update
        return self.num_lanes * self.learner.rollout_steps / self.learner.updates_per_rollout

    @property
    def num_actors(self) -> int:
        """Actor processes of the run, on all hosts. In sync mode 1: all games are played in one place."""
        return 1 if self.mode == "sync" else self.actors_per_host * max(1, self.cluster.hosts)

    @property
    def actors_per_host(self) -> int:
        """Actor processes of a machine that plays. By default one per core of this machine, but no more than the run
        has room for, and enough to give every task a game.
        """
        if self.actors.num_actors is not None:
            return self.actors.num_actors
        if self.mode == "sync":  # it must not depend on the machine it is on
            return 1
        num_tasks, hosts, most_lanes = len(self.table), max(1, self.cluster.hosts), self._most_lanes
        counts = range(num_cores(), 1, -1)
        fitting = (n for n in counts if n * hosts * self._games_of_each(n * hosts, num_tasks) <= most_lanes)
        fewest = math.ceil(num_tasks / (hosts * (self.actors.games_per_actor or num_tasks)))
        return max(next(fitting, 1), fewest if self.curriculum.kind == "fixed" else 1)

    @property
    def games_per_actor(self) -> int:
        """Games of one actor process; in sync mode all games of the run."""
        num_tasks = len(self.table)
        actors = self.actors_per_host * max(1, self.cluster.hosts)
        games = self._games_of_each(actors, num_tasks)
        if games * actors < num_tasks and self.curriculum.kind == "fixed":
            raise ConfigError(
                f"actors.games_per_actor: got {games} games for each of {actors} actors, but there are {num_tasks} "
                f"tasks; every task needs a game: want at least {math.ceil(num_tasks / actors)}"
            )
        return games * actors if self.mode == "sync" else games

    def _games_of_each(self, actors: int, num_tasks: int) -> int:
        if self.actors.games_per_actor is not None:
            return self.actors.games_per_actor
        if num_tasks > _FEW_TASKS:
            return max(4, math.ceil(num_tasks / actors))
        return num_tasks * math.ceil(4 / num_tasks)

    @property
    def _most_lanes(self) -> int:
        """Games that the step records, the replay and the warm-up have room for."""
        if not isinstance(self.learner, LearnerConfig) or self.replay is None:
            return MAX_LANES
        slots = max(self._slots_per_game, MIN_CLUSTER_SLOTS if self.cluster.hosts else 1)
        return min(MAX_LANES, self.replay.capacity // slots, self.learner.warmup_steps // self._n_steps)

    @property
    def _n_steps(self) -> int:
        return self.agent.n_steps if isinstance(self.agent, ValueConfig) else 1

    @property
    def _slots_per_game(self) -> int:
        """Step records of the replay that a game needs: it keeps a stream of its own."""
        return 4 * (max(self.agent.stack_size, self.agent.past_actions + 1) + self._n_steps)

    @property
    def num_lanes(self) -> int:
        """Games of the run; each is one lane of the replay."""
        return self.num_actors * self.games_per_actor

    @property
    def resolved_run_dir(self) -> Path:
        """Of process 0 of a group; that of another one is within it."""
        path = self.run_dir if self.run_dir is not None else Path("runs") / self.name / f"seed_{self.seed}"
        return path / f"process_{self.group.own_id}" if self.group.own_id else path

    @property
    def games_seed(self) -> int:
        """What the games' seeds are made of: another number in every process of a group."""
        return (self.seed + self.group.own_id * 0x9E3779B1) % 2**31


def off_policy(config: RunConfig) -> tuple[LearnerConfig, ReplayConfig]:
    """The learner and the replay of a run that learns from a replay.

    Raises:
        ConfigError: it has none.
    """
    learner, replay = config.learner, config.replay
    if not isinstance(learner, LearnerConfig) or replay is None:
        raise _unfit(config, "learns from a replay", "learner=LearnerConfig(...), replay=ReplayConfig(...)")
    return learner, replay


def without_effect(config: RunConfig) -> list[str]:
    """A line for each setting that is not at its default and that another one leaves without effect.

    A config file may have it at hand, so it is no error. Nothing is said of an agent in a file of its own.
    """
    agent, learner, found = config.agent, config.learner, list[str]()
    if isinstance(learner, LearnerConfig) and learner.target_ema is not None:
        found += unused("learner", learner, "target_ema", "target_period_updates")
    if agent.name.endswith(".py") or not isinstance(agent, ValueConfig):
        return found
    if not agent.augmentations and not (isinstance(agent, RainbowConfig) and agent.sight_augmentations):
        found += unused("agent", agent, "augmentations", "augmentation_strength", "augmentation_clean_share")
    if isinstance(agent, RainbowConfig):
        idle = ("noisy_sigma",) if agent.noisy == "off" else ("epsilon_start", "epsilon_end", "epsilon_decay_steps")
        found += unused("agent", agent, "noisy", *idle)
        if not agent.has_atoms:
            found += unused("agent", agent, "num_quantiles" if agent.distributional else "distributional", "num_atoms")
    return found


def _unfit(config: RunConfig, agent: str, wanted: str) -> ConfigError:
    got = f"{type(config.learner).__name__} and {'no replay' if config.replay is None else 'a replay'}"
    who = f"agent.name {config.agent.name!r}, which {agent}"
    return ConfigError(f"learner, replay: got {got} for {who}; want `{wanted}`")


def with_agent(config: RunConfig, name: str) -> RunConfig:
    """The run with another agent; with its kind of learner, too, if that is another.

    Raises:
        ConfigError: no such agent, or its configuration does not take these values.
    """
    agent = change_agent(config.agent, name)
    if agent.on_policy == config.agent.on_policy:
        return dataclasses.replace(config, agent=agent)
    kind, replay = (OnPolicyConfig, None) if agent.on_policy else (LearnerConfig, ReplayConfig())
    learner = kind(total_updates=config.learner.total_updates)
    return dataclasses.replace(config, agent=agent, learner=learner, replay=replay)
