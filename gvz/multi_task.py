"""Several tasks as one Gymnasium environment: each episode is of one of them."""

from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np

from gvz.actions import Buttons, check_one_action_set
from gvz.core.env_config import EPISODE_SEEDS, EnvConfig, given_episode_seed, typed
from gvz.core.errors import ConfigError, TaskError
from gvz.env import Action, DoomEnv
from gvz.observation import Observation
from gvz.one_thread import one_thread
from gvz.scenarios.base import Task
from gvz.tasks import parse_task

if TYPE_CHECKING:
    from gvz.engine.engine import Label

Sampler = Callable[[np.random.Generator], str]
"""chooses an episode's task: a random number generator -> the id of one of the environment's tasks"""


class MultiTaskEnv(gymnasium.Env[Observation, np.int64 | np.ndarray]):
    """A game whose episodes are of several tasks, also of several scenarios (`action_set="unified_v1"`).

    `reset` takes the task from its options or else from the sampler; `info["task"]` names it. All else is as in
    `gvz.env.DoomEnv`. Tasks that were played last keep their engines.
    """

    metadata = DoomEnv.metadata

    def __init__(
        self,
        tasks: Sequence[Task | str],
        *,
        sampler: Sampler | None = None,
        max_engines: int = 4,
        **options: Any,
    ):
        """Compiles the maps of all tasks.

        Args:
            tasks: tasks or their ids.
            sampler: chooses the task of an episode; default: uniformly. The random numbers are those of `reset`'s seed.
            max_engines: engines that run at the same time, at least 1. An engine takes some 20 MB and 0.2 s to start.
            **options: arguments of DoomEnv.

        Raises:
            ConfigError: no task, one twice, tasks whose actions differ, or a sampler that is no function.
            TaskError, EngineError: as DoomEnv.
        """
        if typed(int, max_engines, "max_engines") < 1:
            raise ConfigError(f"max_engines: got {max_engines}, want at least 1")
        if sampler is not None and not callable(sampler):
            raise ConfigError(f"sampler: got {sampler!r}, want a function of a random number generator, or None")
        games = [DoomEnv(task, **options) for task in tasks]
        self._games = {game.task.id: game for game in games}
        if not games or len(self._games) < len(games):
            raise ConfigError(f"tasks: got {[game.task.id for game in games]}, want at least one, each once")
        check_one_action_set("tasks", [game.task for game in games], games[0].config.action_set)
        self._sampler = sampler
        self._max_engines = max_engines
        self._running: list[DoomEnv] = []
        """games with an engine; the one played last comes last"""
        self._game = games[0]
        self.render_mode, self.metadata = self._game.render_mode, self._game.metadata
        self.action_space, self.observation_space = self._game.action_space, self._game.observation_space

    @property
    def tasks(self) -> tuple[str, ...]:
        """Ids of the tasks."""
        return tuple(self._games)

    @property
    def task(self) -> Task:
        """The task of the present episode; before the first one, the first task."""
        return self._game.task

    @property
    def config(self) -> EnvConfig:
        """Sizes, action set and profile: the same in all tasks."""
        return self._game.config

    @property
    def action_meanings(self) -> tuple[Buttons, ...]:
        """The buttons that each action holds in the present episode's task."""
        return self._game.action_meanings

    @one_thread
    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: starts a new sequence of tasks and episodes; without it the sequence continues.
            options: {"task": id} chooses the task; {"episode_seed": n} as in DoomEnv. With both, the
                sequence does not advance.

        Raises:
            TaskError: no task has this id, or it is none of the environment's.
            ValueError, EngineError, ResourceError: as DoomEnv.
        """
        options = options or {}
        episode_seed = given_episode_seed(options, ("task",))
        given = self._game_of(options["task"]) if "task" in options else None
        super().reset(seed=seed)
        if given is None:
            sampler = self._uniform if self._sampler is None else self._sampler
            given = self._game_of(sampler(self.np_random))
        self._game = game = given
        if game in self._running:
            self._running.remove(game)
        elif len(self._running) == self._max_engines:
            self._running.pop(0).close()
        self._running.append(game)
        if episode_seed is None:
            episode_seed = int(self.np_random.integers(EPISODE_SEEDS))
        return game.reset(options={"episode_seed": episode_seed})

    def _game_of(self, task: object) -> DoomEnv:
        """The game of a task, named by any of its names.

        Raises:
            TaskError: as `reset`.
        """
        name = task.id if isinstance(task, Task) else str(task)
        if name not in self._games:
            name = parse_task(name).id
        if name not in self._games:
            raise TaskError(f"reset: got task {name!r}, want one of {', '.join(self._games)}")
        return self._games[name]

    @one_thread
    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """As DoomEnv's."""
        return self._game.step(action)

    def action_masks(self) -> np.ndarray:
        """bool[A]: the actions that the present episode's task allows."""
        return self._game.action_masks()

    def labels(self) -> "Sequence[Label]":
        """As DoomEnv's."""
        return self._game.labels()

    def render(self) -> np.ndarray | None:
        """As DoomEnv's."""
        return self._game.render()

    @one_thread
    def close(self) -> None:
        """Ends all engines. Can be repeated."""
        while self._running:
            self._running.pop().close()

    def __copy__(self) -> "MultiTaskEnv":
        return deepcopy(self)  # as DoomEnv

    def _uniform(self, rng: np.random.Generator) -> str:
        return self.tasks[int(rng.integers(len(self._games)))]
