"""The vector environment that `gvz.make_vec` makes."""

import contextlib
import dataclasses
import os
import weakref
from collections.abc import Generator, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError, ResetNeeded
from gymnasium.spaces import Discrete, MultiDiscrete
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from gvz.actions import check_one_action_set
from gvz.core.control_groups import num_cores
from gvz.core.env_config import EPISODE_SEEDS, EnvConfig
from gvz.core.errors import ConfigError
from gvz.env import DoomEnv
from gvz.observation import Observation
from gvz.scenarios.base import Task
from gvz.transport.messages import Decision, Outcome, VectorSpec
from gvz.vector import arguments
from gvz.vector.crew import Crew
from gvz.vector.frames import FrameLayout, Frames
from gvz.vector.infos import batch_infos

Batch = tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]
"""observations uint8[B, H, W, C] or a dict of these, rewards f64[B], terminated bool[B], truncated bool[B], infos"""


class DoomVectorEnv(VectorEnv[Observation, np.ndarray, np.ndarray]):
    """N games, played by worker processes.

    - `reset` and `step` play all games, as Gymnasium's vector environments do. With the same seeds they give the same
      observations, rewards, ends and infos as `gymnasium.vector.SyncVectorEnv` of the same `DoomEnv`s.
    - `send` and `recv` play the games that are ready, as EnvPool does: `recv` returns as soon as `batch_size` games
      have answered.
    - Infos have one more key: `env_id`, the number of the game.
    - An engine that crashes truncates its episode, as in `DoomEnv`. So does a worker that dies; it is replaced. After
      any other error in a worker the environment is closed. It is also closed if Ctrl-C interrupts a call that speaks
      to the workers: nobody knows then which answers are still to come.
    - Workers and engines end with this object, with this process, however it ends, and with the thread that made this
      object.

    Attributes:
        tasks: id of each game's task.
        batch_size: games that `recv` waits for, B.
        autoreset_mode: Gymnasium's, as its own vector environments have it.
    """

    closed = True
    """there is nothing to close, yet or any more"""

    def __init__(
        self,
        tasks: Task | str | Sequence[Task | str],
        num_envs: int | None = None,
        config: EnvConfig | Mapping[str, Any] | None = None,
        *,
        batch_size: int | None = None,
        num_workers: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        copy: bool = True,
        render_mode: Literal["rgb_array"] | None = None,
        recycle_episodes: int | None = None,
        **fields: Any,
    ):
        """Compiles the maps, checks that they load, and starts the workers. Engines start at the first `reset`.

        Args:
            tasks: a task or its id, or several; game i plays tasks[i % len(tasks)].
            num_envs: number of games, N; by default one for each task.
            config: as for `DoomEnv`, the same for every game.
            batch_size: games that `recv` waits for; by default all.
            num_workers: processes; by default one for each core, at most one for each game.
            autoreset_mode: Gymnasium's NEXT_STEP ("NextStep"), SAME_STEP ("SameStep") or DISABLED ("Disabled").
            copy: observations are copies. False: `reset`, `step` and `recv` return views of the shared memory, which
                the call after the next one overwrites; all games must be in one batch.
            render_mode: rgb_array: `render()` gives the screens.
            recycle_episodes: as for `DoomEnv`.
            **fields: single fields of EnvConfig.

        Raises:
            TaskError: no such task.
            ConfigError: a wrong value, or tasks whose actions differ.
            EngineError: a map does not load.
            ResourceError: not enough memory.
        """
        ids = arguments.task_ids(tasks)
        self.num_envs = arguments.number("num_envs", num_envs, default=len(ids))
        self.batch_size = arguments.number("batch_size", batch_size, default=self.num_envs, most=self.num_envs)
        cores = min(self.num_envs, num_cores())
        num_workers = arguments.number("num_workers", num_workers, default=cores, most=self.num_envs)
        self.autoreset_mode = arguments.autoreset_mode(autoreset_mode)
        if not copy and self.batch_size < self.num_envs:
            raise ConfigError(f"make_vec: got copy=False and batch_size={self.batch_size}, want {self.num_envs}")
        if render_mode not in (None, "rgb_array"):
            raise ConfigError(f"make_vec: got render_mode {render_mode!r}, want None or 'rgb_array'")
        options = {"render_mode": render_mode, "recycle_episodes": recycle_episodes}
        envs = {task: DoomEnv(task, config, **options, **fields) for task in dict.fromkeys(ids)}
        first = envs[ids[0]]
        check_one_action_set("make_vec", [env.task for env in envs.values()], first.config.action_set)
        self.tasks = tuple(envs[ids[game % len(ids)]].task.id for game in range(self.num_envs))
        self.render_mode = render_mode
        self.metadata = {**first.metadata, "autoreset_mode": self.autoreset_mode}
        self.single_observation_space, self.single_action_space = first.observation_space, first.action_space
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._action_masks = np.array([envs[ids[game % len(ids)]].action_masks() for game in range(self.num_envs)])
        self._config, self._copy = first.config, copy
        self._rngs = [seeding.np_random() for _ in range(self.num_envs)]  # and their seeds
        self._next_seeds: list[int | None] = [None] * self.num_envs  # drawn, and not used by an episode yet
        self._begun, self._ended, self._pending = np.zeros((3, self.num_envs), bool)
        self._halves = np.zeros(self.num_envs, np.intp)  # where each game's last observation is
        layout = FrameLayout(
            env=self._config,
            num_envs=self.num_envs,
            num_workers=num_workers,
            same_step=self.autoreset_mode is AutoresetMode.SAME_STEP,
        )
        self._frames = Frames.create(layout)
        specs = [
            VectorSpec(
                worker=worker,
                games=games.tolist(),
                tasks=[self.tasks[game] for game in games],
                num_envs=self.num_envs,
                num_workers=num_workers,
                env_config=dataclasses.asdict(self._config),
                options=options,
                same_step=layout.same_step,
                answer_after=max(1, self.batch_size // num_workers),
            )
            for worker, games in enumerate(np.array_split(np.arange(self.num_envs), num_workers))
        ]
        self._crew = Crew(specs, self._frames)
        self._end = weakref.finalize(self, self._crew.close)  # also when the interpreter exits
        self.closed = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode in every game. Answers that `recv` has not taken are dropped.

        Args:
            seed: game i gets seed + i, or seed[i]. Without one it continues its sequence of episodes.
            options: {"episode_seed": n} as for `DoomEnv.reset`; {"reset_mask": bool[N]} resets only these games.

        Returns:
            Observations of all games, uint8[N, H, W, C] or a dict of these, and infos of those that were reset.

        Raises:
            ValueError: an unknown option, a wrong mask or seed, or not one seed for each game.
            ResetNeeded: the mask leaves out a game that has never begun.
            ClosedEnvironmentError, GvzError: as `recv`.
        """
        self._require_open("reset")
        seeds = arguments.seeds(seed, self.num_envs)
        episode_seed, mask = arguments.reset_options(options, self.num_envs)
        if not (mask | self._begun).all():
            raise ResetNeeded(
                f"reset: games {np.flatnonzero(~(mask | self._begun)).tolist()} have not begun; reset all"
            )
        half = 1 - int(self._halves[0])  # the one that the last call has not returned
        self._receive(self.num_playing)
        if not self._copy:
            self._halves[mask] = 1 - half  # answers that are dropped are written over
        for game in np.flatnonzero(mask).tolist():
            if seeds[game] is not None:
                self._rngs[game], self._next_seeds[game] = seeding.np_random(seeds[game]), None
        self._send(np.flatnonzero(mask), [None] * int(mask.sum()), episode_seed)
        outcomes = {outcome.game: outcome for outcome in self._receive(int(mask.sum()))}
        if not self._copy:
            for game in np.flatnonzero(self._halves != half).tolist():  # all games in one half again
                self._frames.repeat(game, half)
                self._halves[game] = half
        games = np.arange(self.num_envs)
        return self._observe(games), self._infos([outcomes.get(game) for game in games.tolist()])

    def step(self, actions: np.ndarray) -> Batch:
        """One decision in every game.

        Args:
            actions: int[N], or int[N, axes] with `action_set="multi_discrete_v1"`.

        Returns:
            Observations, rewards, terminated, truncated and infos of all games.

        Raises:
            GvzError, ValueError: as `send` and `recv`.
        """
        self.send(actions)
        return self._batch(self._receive(self.num_envs))

    def send(self, actions: np.ndarray, env_ids: np.ndarray | None = None) -> None:
        """Gives some games their next action, and does not wait.

        Args:
            actions: int[B].
            env_ids: int[B], the games; by default all.

        Raises:
            ClosedEnvironmentError: the environment was closed.
            ResetNeeded: a game has not begun, or its episode is over and autoreset is disabled.
            AlreadyPendingCallError: a game has not answered its last action, or `recv` has not taken the answer.
            ValueError: no such game or action, a game twice, or not one action for each game.
        """
        self._require_open("send")
        games = arguments.game_numbers(env_ids, self.num_envs)
        space = self.single_action_space
        assert isinstance(space, Discrete | MultiDiscrete), "DoomEnv's action space"
        numbers: list[int | list[int] | None] = [*arguments.action_numbers(actions, games, space)]
        self._require_begun("send", games)
        over = self._ended[games]
        if over.any() and self.autoreset_mode is AutoresetMode.DISABLED:
            raise ResetNeeded(f"send: the episodes of games {games[over].tolist()} are over; reset them (reset_mask)")
        self._send(games, [None if end else action for action, end in zip(numbers, over.tolist(), strict=True)])

    def recv(self) -> Batch:
        """The answers of the next `batch_size` games that have one.

        Returns:
            Observations, rewards, terminated, truncated and infos of these games, the smallest number first;
            `infos["env_id"]` has the numbers.

        Raises:
            ClosedEnvironmentError: the environment was closed.
            NoAsyncCallError: fewer games have an action.
            GvzError: what a worker could not do; the environment is closed then.
        """
        self._require_open("recv")
        if self.num_playing < self.batch_size:
            message = f"recv: {self.num_playing} games have an action, want {self.batch_size}; send first"
            raise NoAsyncCallError(message, "recv")
        return self._batch(self._receive(self.batch_size))

    @property
    def num_playing(self) -> int:
        """Games that have an action and whose answer `recv` has not taken."""
        return int(self._pending.sum())

    @property
    def np_random_seed(self) -> tuple[int, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """The seed of each game's sequence of episodes, also if `reset` was given none; as SyncVectorEnv has it."""
        return tuple(seed for _, seed in self._rngs)

    def render(self) -> tuple[np.ndarray, ...] | None:
        """The last rendered screen of every game, uint8[render_height, render_width, 3]; None without a render mode.

        Raises:
            ClosedEnvironmentError, GvzError: as `recv`.
            ResetNeeded: a game has not begun, or its worker has died. AlreadyPendingCallError: as `send`.
        """
        self._require_open("render")
        if self.render_mode is None:
            return None
        games = np.arange(self.num_envs)
        self._require_begun("render", games)
        self._require_idle("render", games)
        with self._closed_by_errors():
            screens = self._crew.render()
        if lost := [game for game, screen in screens.items() if not screen]:
            raise ResetNeeded(f"render: games {lost} have rendered nothing since their worker died; play on, or reset")
        shape = (self._config.render_height, self._config.render_width, 3)
        return tuple(np.frombuffer(screens[game], np.uint8).reshape(shape).copy() for game in games.tolist())

    def action_masks(self) -> np.ndarray:
        """bool[N, A]: the actions that each game's task allows, as `DoomEnv.action_masks` has them."""
        return self._action_masks.copy()

    def close_extras(self, **kwargs: Any) -> None:
        """Ends workers and engines; `close` calls it."""
        del kwargs
        self._end()

    def __getstate__(self) -> dict[str, Any]:
        raise TypeError("DoomVectorEnv: its worker processes can be neither copied nor pickled; make another one")

    def _send(
        self, games: np.ndarray, actions: Sequence[int | list[int] | None], episode_seed: int | None = None
    ) -> None:
        self._require_idle("send", games)
        decisions = [
            Decision(
                game, 1 - int(self._halves[game]), action, self._seed(game) if episode_seed is None else episode_seed
            )
            for game, action in zip(games.tolist(), actions, strict=True)
        ]
        with self._closed_by_errors():
            for decision in decisions:
                if decision.action is None and episode_seed is None:
                    self._next_seeds[decision.game] = None
            self._pending[games] = True
            self._crew.send(decisions)

    def _receive(self, count: int) -> list[Outcome]:
        """The next outcomes, the smallest number of a game first."""
        with self._closed_by_errors():
            outcomes = self._crew.receive(count)
            for outcome in outcomes:
                game, over = outcome.game, outcome.terminated or outcome.truncated
                self._begun[game], self._pending[game] = True, False
                self._ended[game] = over and outcome.final_info is None
                self._halves[game] = 1 - self._halves[game]
                if outcome.final_info is not None:
                    self._next_seeds[game] = None
        return sorted(outcomes, key=lambda outcome: outcome.game)

    def _seed(self, game: int) -> int:
        """Of the game's next episode; the same until an episode has begun with it. As `DoomEnv` draws it."""
        rng, _ = self._rngs[game]
        if (seed := self._next_seeds[game]) is None:
            seed = self._next_seeds[game] = int(rng.integers(EPISODE_SEEDS))
        return seed

    def _batch(self, outcomes: list[Outcome]) -> Batch:
        games = np.array([outcome.game for outcome in outcomes])
        return (
            self._observe(games),
            np.array([outcome.reward for outcome in outcomes], np.float64),
            np.array([outcome.terminated for outcome in outcomes], bool),
            np.array([outcome.truncated for outcome in outcomes], bool),
            self._infos(outcomes),
        )

    def _observe(self, games: np.ndarray) -> Observation:
        return self._frames.copy(games, self._halves[games]) if self._copy else self._frames.view(int(self._halves[0]))

    def _infos(self, outcomes: Sequence[Outcome | None]) -> dict[str, Any]:
        return batch_infos([None if outcome is None else self._info(outcome) for outcome in outcomes])

    def _info(self, outcome: Outcome) -> dict[str, Any]:
        game = outcome.game
        info = {**outcome.info, "env_id": game}
        if outcome.final_info is not None:
            info |= {"final_obs": self._frames.final_copy(game), "final_info": outcome.final_info}
        return info

    def _require_open(self, call: str) -> None:
        if self.closed:
            raise ClosedEnvironmentError(f"{call}: the vector environment was closed")
        if self._crew.owner_pid != os.getpid():
            raise ClosedEnvironmentError(f"{call}: a fork has no vector environment of its parent's; make one here")

    def _require_begun(self, call: str, games: np.ndarray) -> None:
        if not self._begun[games].all():
            raise ResetNeeded(f"{call}: games {games[~self._begun[games]].tolist()} have not begun; call reset first")

    def _require_idle(self, call: str, games: np.ndarray) -> None:
        if self._pending[games].any():
            waiting = games[self._pending[games]].tolist()
            raise AlreadyPendingCallError(f"{call}: recv has not taken the answers of games {waiting}", call)

    @contextlib.contextmanager
    def _closed_by_errors(self) -> Generator[None, None, None]:
        try:
            yield
        except BaseException:  # Ctrl-C, too: a message may be half sent, or an answer lost
            self.close()
            raise


def of_task(task: str, num_envs: int, **options: Any) -> DoomVectorEnv:
    """Gymnasium's entry point: gymnasium.make_vec("GViZDoom/DefendTheCenter-Gore-v0", num_envs=8)."""
    return DoomVectorEnv(task, num_envs, **options)
