"""The flags of `gvz watch` and `gvz record` that choose a player and an episode."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gvz.core.env_config import EnvConfig, Profile
from gvz.core.errors import ConfigError
from gvz.core.registry import NO_OWN_FILES, OwnFiles
from gvz.evaluation.simple import SimplePlayerName
from gvz.scenarios.base import Task
from gvz.tasks import parse_task

if TYPE_CHECKING:
    from gvz.evaluation.play import PlayerSpec


@dataclass(frozen=True, kw_only=True)
class EpisodeChoice:
    """A player, a task, an episode."""

    run_dir: Annotated[
        tyro.conf.Positional[Path | None],
        tyro.conf.arg(metavar="[RUN_DIR]", help_behavior_hint=""),
    ] = None
    """a run directory, or zoo:NAME (see gvz zoo): its policy plays greedily, noise off"""
    player: SimplePlayerName | None = None
    """instead: random, idle, sweep (a fixed sequence of buttons), or the scenario's simple script"""
    own_files: Annotated[OwnFiles, tyro.conf.arg(name="")] = NO_OWN_FILES
    checkpoint: str = "newest"
    """which of the run's policies: gradient steps, or newest"""
    task: str | None = None
    """id, for example seek_and_kill/blue+obstacles; default the run's first training task"""
    episode: int = 0
    """number of the evaluation episode, as `gvz evaluate` counts them"""
    seed: int = 0
    """base seed of the episode"""
    profile: Profile | None = None
    """rules of the task, for --player: thesis by default; a run keeps the rules it was trained by"""

    def resolve(self) -> "tuple[PlayerSpec, Task]":
        """Who plays what.

        Raises:
            ConfigError, TaskError, CheckpointError: there is no such player, task or checkpoint.
        """
        from gvz.evaluation.episode_log import simple_player
        from gvz.evaluation.trained import check_profile, check_tasks, find_checkpoint, read_run_config, trained_player
        from gvz.evaluation.zoo import run_directory

        if self.player is not None and self.run_dir is not None:
            raise ConfigError(f"got --player {self.player} and also {self.run_dir}, want one of them")
        if self.player is None and self.run_dir is None:
            raise ConfigError("want a run directory or --player")
        agent, encoder = self.own_files
        of_runs = {"--agent": agent, "--encoder": encoder, "--checkpoint": self.checkpoint != "newest"}
        if self.player is not None and (given := [flag for flag, value in of_runs.items() if value]):
            raise ConfigError(f"{given[0]}: got it beside --player {self.player}, want it with a run directory alone")
        for name, value in (("episode", self.episode), ("seed", self.seed)):
            if not 0 <= value < 2**63:
                raise ConfigError(f"--{name}: got {value}, want a number from 0 to 2^63 - 1")
        if self.run_dir is None:
            assert self.player is not None
            if self.task is None:
                raise ConfigError("--task: want a task id, for example defend_the_center/gore (gvz tasks lists them)")
            return simple_player(self.player, EnvConfig(profile=self.profile or "thesis")), parse_task(self.task)
        run_dir = run_directory(self.run_dir)
        config = read_run_config(run_dir, self.own_files)
        task = config.table.tasks[0] if self.task is None else parse_task(self.task)
        check_tasks(config, [task])
        check_profile(config, self.profile)
        num_updates = find_checkpoint(run_dir, self.checkpoint)
        if task.scenario not in config.table.scenarios:  # a run's weights are of its own scenario's components
            config = dataclasses.replace(config, env=dataclasses.replace(config.env, reward_weights=()))
        return trained_player(run_dir, config, num_updates), task


ANY_EPISODE = EpisodeChoice()
"""the default of every flag"""
