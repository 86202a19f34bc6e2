"""A task as a Gymnasium environment: observation, actions, reward, time-out, seeds, crashes of the engine."""

import dataclasses
import os
import time
from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import TYPE_CHECKING, Any, Literal

import gymnasium
import numpy as np
from gymnasium.error import ResetNeeded
from gymnasium.spaces import Discrete, MultiDiscrete

from gvz.actions import AXES_V1, action_buttons, choice_mask
from gvz.core.env_config import EPISODE_SEEDS, EnvConfig, as_integer, given_episode_seed, typed
from gvz.core.errors import ConfigError, EngineError, UnknownOptionError
from gvz.engine.engine import Engine, EngineConfig, check_config
from gvz.engine.probe import ensure_loads
from gvz.observation import (
    Observation,
    observation_space,
    observe_buffers,
    observe_classes,
    observe_screen,
    observe_sight,
)
from gvz.one_thread import one_thread
from gvz.scenarios.base import BOOKKEEPING, Task
from gvz.scenarios.checks import ALWAYS_READ
from gvz.scenarios.compiler import compile_task
from gvz.segmentation import segmented_frame, segmenter_of
from gvz.tasks import parse_task
from gvz.viewer import Window

if TYPE_CHECKING:
    from gvz.engine.engine import GameState, Label

Action = int | np.integer | np.ndarray
"""what `DoomEnv.step` takes: an action's number, or with `multi_discrete_v1` a number for each group of buttons"""
TICS_PER_SECOND = 35
_WEAPON_UP_TIC = 10
"""tic at which the weapon is ready: episodes with a weapon start there, as LevDoom's do"""
_COUNTED = {"kills": "KILLCOUNT", "goals": "GOALS"}
"""metric -> the variable that counts it"""
_MAX_CRASHES = 3
"""crashes in a row, without a complete episode in between, after which the environment raises an error"""


class DoomEnv(gymnasium.Env[Observation, np.int64 | np.ndarray]):
    """One game of a task.

    - Observation: uint8 [H, W, C], the screen as the player sees it, or with `config.frames` the classes of what it
      shows, or what a network takes them for; with `config.buffers` a dict of `screen` and of `depth` [H, W, 1],
      `labels` [H, W, 1] (numbers of gvz.LABEL_CLASSES) and `automap` [H, W, C] (the whole map).
    - Actions: `action_meanings`, each held for `config.frame_skip` game tics.
    - Reward: the sum of `info["reward_components"]`.
    - Termination: the agent died; the final observation shows this moment. (Buffers, frames of classes and `sight` are
      those before it.)
    - Truncation: the time-out, with its true final observation; or a crash of the engine (`info["engine_crash"]`): then
      the last observation is repeated and the reward is 0.
    - Info, each step: task (its id), score (at most upper_bound), normalized_score (percent of upper_bound),
      upper_bound, reward_components, variables (those that the agent may see), kills (the engine's count, including
      enemies that enemies killed), player_kills (enemies that the agent killed), episode_frames, episode_seed,
      engine_crash (in `reset`: the engine had died and was replaced); in the last step also solved_episode (a survival
      scenario's time-out was reached). With `config.sight` also sight: each of SIGHT_CLASSES -> whether it is in sight
      in each column of the frame, from left to right.
    - Seeds: `reset(seed=n)` seeds the sequence of episodes. Each episode has its own seed, `info["episode_seed"]`, and
      `reset(options={"episode_seed": m})` replays that episode alone. It also chooses the map, where maps are drawn.
    - Threads: `reset`, `step` and `close` raise AlreadyPendingCallError while another thread is in one of them.
    - Forks: a fork of the process has no episode. Its first `reset` starts an engine of its own.
    """

    metadata = {  # noqa: RUF012  Gymnasium's; an instance's has the pictures per second of its own frame skip
        "render_modes": ["rgb_array", "human"],
        "render_fps": TICS_PER_SECOND / EnvConfig().frame_skip,
    }

    def __init__(
        self,
        task: Task | str,
        config: EnvConfig | Mapping[str, Any] | None = None,
        *,
        render_mode: Literal["rgb_array", "human"] | None = None,
        recycle_episodes: int | None = None,
        **fields: Any,
    ):
        """Compiles the task's map and checks that it loads; the engine itself starts at the first `reset`.

        Args:
            task: a task or its id, "defend_the_center/gore+mossy_bricks".
            config: sizes, action set, profile; or fields of EnvConfig, which Gymnasium's JSON makes of one.
            render_mode: rgb_array: `render()` gives the screen, uint8 [render_height, render_width, 3];
                human: a window shows the game at its normal speed.
            recycle_episodes: restart the engine after at most this many episodes; default: only if the task needs it.
                A task with fuzzy enemies always restarts it after every episode: the engine's fuzz effect continues
                from episode to episode, so only a fresh engine repeats it. Nothing else in the picture depends on
                earlier episodes. 0 never restarts, for players that ignore observations.
            **fields: single fields of EnvConfig, instead of those of `config`: `frame_skip=8`,
                `reward_weights={"kill": 2.0}`.

        Raises:
            TaskError: no such task.
            ConfigError: an unknown field or reward component, a value of a wrong type or out of range, an impossible
                render size, no network for segmented frames.
            EngineError: the map does not load.
        """
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise ValueError(f"render_mode: got {render_mode!r}, want None or one of {self.metadata['render_modes']}")
        recycle_episodes = typed(int | None, recycle_episodes, "recycle_episodes")
        if recycle_episodes is not None and recycle_episodes < 0:
            raise ConfigError(f"recycle_episodes: got {recycle_episodes}, want 0 or more")
        self.task = task if isinstance(task, Task) else parse_task(task)
        self.config = config = _with_fields(config, fields)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": TICS_PER_SECOND / config.frame_skip}
        scenario = self.task.scenario
        self._compiled = compile_task(self.task, config.profile)
        self._timeout_frames = scenario.timeout_frames(config.profile)
        self._upper_bound = float(scenario.upper_bound(config.profile))
        self._rewarder = scenario.make_rewarder(dict(config.reward_weights), config.profile)
        self.action_meanings = action_buttons(scenario, config.action_set)
        self._actions = [[button in held for button in scenario.buttons] for held in self.action_meanings]
        bookkeeping = {name: user for name, user in BOOKKEEPING.items() if name != "MAP_MAGIC"}
        own = tuple(dict.fromkeys((*scenario.game_variables, *ALWAYS_READ)))
        self._names = (*own, *bookkeeping)
        self._engine_config = EngineConfig(
            wad=self._compiled.wad_path,
            buttons=scenario.buttons,
            variables=(*own, *bookkeeping.values()),
            width=config.render_width,
            height=config.render_height,
            render_weapon=scenario.render_weapon,
            depth="depth" in config.buffers,
            labels="labels" in config.buffers or config.frames == "classes" or config.sight,
            automap="automap" in config.buffers,
            start_tic=_WEAPON_UP_TIC if scenario.render_weapon else 1,
        )
        check_config(self._engine_config)
        self._segmenter = segmenter_of(self.task.scenario.id, config) if config.frames == "segmented" else None
        ensure_loads(self._compiled.wad_path)
        if config.action_set == "multi_discrete_v1":
            self.action_space = MultiDiscrete([len(axis) for axis in AXES_V1])
        else:
            self.action_space = Discrete(len(self.action_meanings))
        self.observation_space = observation_space(config)
        if recycle_episodes is None or (self._compiled.has_fuzz and recycle_episodes > 0):
            recycle_episodes = int(self._compiled.has_fuzz)
        self._recycle_episodes = recycle_episodes
        self._window: Window | None = None
        self._show_at_s = 0.0
        self._engine: Engine | None = None
        self._engine_episodes = 0
        self._crashes = 0
        self._screen: np.ndarray | None = None
        self._state: GameState | None = None
        self._observation: Observation | None = None
        self._playing = False
        self._held: list[bool] | None = None  # the buttons of the last decision

    @one_thread
    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode.

        Args:
            seed: starts a new sequence of episodes; without it the sequence continues.
            options: {"episode_seed": n} plays the episode with this seed; the sequence does not advance.

        Raises:
            ValueError: an unknown option, or an episode seed outside [0, 2^31).
            EngineError: the engine does not start, or does not run the task's map.
            ResourceError: render_mode human without a display, or too little shared memory.
        """
        given = given_episode_seed(options or {})
        super().reset(seed=seed)
        self._playing = False  # if this call is interrupted, there is no episode to go on with
        self._episode_seed = int(self.np_random.integers(EPISODE_SEEDS)) if given is None else given
        forked = self._engine is not None and self._engine.owner_pid != os.getpid()
        if forked or 0 < self._recycle_episodes <= self._engine_episodes:
            self._stop_engine()
        engine, crash = self._begin()
        self._engine_episodes += 1
        self._repeat_rng, self._held = np.random.default_rng(self._episode_seed), None
        self._screen = engine.screen
        self._start_tic = engine.tic()
        self._read(engine)
        self._rewarder.reset(self._variables)
        if self.render_mode == "human":
            self._show(tics=0)
        observation = self._observe(engine)
        info = self._info(dict.fromkeys(self._rewarder.weights, 0.0), False, False)
        if crash is not None:
            info |= {"engine_crash": True, "engine_error": str(crash)}
        self._playing = True
        return observation, info

    @one_thread
    def step(self, action: Action) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Holds the action's buttons for `frame_skip` tics, or for the rest until the time-out.

        Raises:
            ResetNeeded: no episode is running.
            ValueError: no such action.
            TaskError: an event of the reward gave no number of at least 0.
            EngineError: the engine crashed too often in a row.
        """
        engine = self._engine
        if engine is None or not self._playing or engine.owner_pid != os.getpid():
            raise ResetNeeded("DoomEnv.step: no episode is running in this process; call reset first")
        if isinstance(self.action_space, MultiDiscrete):
            held = np.asarray(action)
            if not self.action_space.contains(held):
                raise ValueError(f"DoomEnv.step: action {action!r}, want integers of {self.action_space}")
            chosen = int(np.ravel_multi_index(tuple(held), tuple(self.action_space.nvec)))
        elif not 0 <= (chosen := as_integer(action)) < len(self._actions):
            raise ValueError(f"DoomEnv.step: action {action!r}, want 0..{len(self._actions) - 1}")
        if self._repeat_rng.random() >= self.config.repeat_action_probability or self._held is None:
            self._held = self._actions[chosen]
        tics = min(self.config.frame_skip, self._timeout_frames - self._frames)
        self._playing = False  # if this call is interrupted, the game is ahead of what its caller knows
        try:
            terminated = not engine.advance(self._held, tics)
        except EngineError as error:
            return self._crashed(error)
        self._read(engine)
        truncated = not terminated and self._frames >= self._timeout_frames
        if terminated or truncated:
            self._crashes = 0
        if self.render_mode == "human":
            self._show(tics)
        observation, components = self._observe(engine), self._rewarder.step(self._variables, terminated)
        info = self._info(components, terminated, truncated)
        self._playing = not (terminated or truncated)
        return observation, sum(components.values()), terminated, truncated, info

    def action_masks(self) -> np.ndarray:
        """bool[A]: the actions that the task allows; of `multi_discrete_v1` bool[15], the choices of each axis in turn.

        sb3-contrib's algorithms with masks ask for it by this name.
        """
        return np.array(choice_mask(self.task.scenario, self.config.action_set))

    def render(self) -> np.ndarray | None:
        """The last rendered screen, uint8 [render_height, render_width, 3]; None without render mode rgb_array."""
        if self.render_mode != "rgb_array":
            return None
        if self._screen is None:
            raise ResetNeeded("DoomEnv.render: nothing was rendered, or the environment was closed; call reset first")
        return self._screen.copy()

    def labels(self) -> "Sequence[Label]":
        """The things in sight at the last observation, with name and place on the rendered screen.

        Raises:
            ValueError: "labels" is not among `config.buffers`.
        """
        if "labels" not in self.config.buffers:
            raise ValueError("DoomEnv.labels: want 'labels' among the buffers of the EnvConfig")
        return () if self._state is None or self._state.labels is None else self._state.labels

    @one_thread
    def close(self) -> None:
        """Ends the engine and its window, and frees the engine's memory. Can be repeated.

        Afterwards `render` raises ResetNeeded, and `reset` starts a new engine.
        """
        self._stop_engine()
        self._screen = None
        if self._window is not None:
            self._window.close()
            self._window = None
        self._playing = False

    def __getstate__(self) -> dict[str, Any]:
        if self._engine is not None:
            raise TypeError("DoomEnv: a running game can be neither copied nor pickled; close it, or make another one")
        return self.__dict__

    def __copy__(self) -> "DoomEnv":
        return deepcopy(self)  # two games share nothing, such as the history of their rewards

    def _begin(self) -> tuple[Engine, EngineError | None]:
        """Starts the episode, on a new engine if needed; returns the engine, and the error if an engine died."""
        crash = None
        map_wad, map_magic = self._compiled.map_of(self._episode_seed)
        while True:
            if self._engine is None:
                self._engine = Engine(self._engine_config)
            try:
                self._engine.new_episode(self._episode_seed, map_wad)
                magic = self._engine.variable(BOOKKEEPING["MAP_MAGIC"])
            except EngineError as error:
                crash = error
                self._note_crash(error)
                continue
            if magic != map_magic:  # ViZDoom plays another map rather than none
                self._stop_engine()
                raise EngineError(
                    f"{self.task.id}: {self._compiled.wad_path} runs a map with magic number {magic:.0f}, "
                    f"want {map_magic}, that of the map of episode seed {self._episode_seed}, which its script sets in "
                    "`global int 60`"
                )
            return self._engine, crash

    def _read(self, engine: Engine) -> None:
        """Reads the game's variables after a decision."""
        self._variables = dict(zip(self._names, engine.variables(), strict=True))
        self._frames = engine.tic() - self._start_tic

    def _observe(self, engine: Engine) -> Observation:
        config = self.config
        if self._engine_config.labels or config.buffers:
            self._state = engine.state() or self._state
        if self._segmenter is not None:
            size = config.frame_width, config.frame_height
            observation = segmented_frame(self._segmenter(engine.screen), *size, config.segmenter_temperature)
        elif config.frames == "classes":
            assert self._state is not None
            observation = observe_classes(self._state, config)
        else:
            observation = observe_screen(engine.screen, config)
            if config.buffers:
                assert self._state is not None
                observation = {"screen": observation, **observe_buffers(self._state, config)}
        self._observation = observation
        return observation

    def _crashed(self, error: EngineError) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """The engine died: the episode is truncated after the last decision."""
        assert self._observation is not None
        self._note_crash(error)
        info = self._info(dict.fromkeys(self._rewarder.weights, 0.0), False, True)
        return deepcopy(self._observation), 0.0, False, True, {**info, "engine_crash": True, "engine_error": str(error)}

    def _note_crash(self, error: EngineError) -> None:
        self._stop_engine()
        self._crashes += 1
        if self._crashes > _MAX_CRASHES:
            raise EngineError(
                f"{self.task.id}: {self._crashes} engine crashes without a whole episode between; the last: {error}"
            ) from error

    def _stop_engine(self) -> None:
        if self._engine is not None:
            self._engine.close()
            self._screen = self._engine.screen
        self._engine = None
        self._engine_episodes = 0

    def _info(self, components: dict[str, float], terminated: bool, truncated: bool) -> dict[str, Any]:
        variables, scenario = self._variables, self.task.scenario
        score = float(self._frames)
        if (counted := _COUNTED.get(scenario.metric)) is not None:  # KILLCOUNT also has what enemies kill
            score = min(variables[counted], self._upper_bound)
        info: dict[str, Any] = {
            "task": self.task.id,
            "score": score,
            "normalized_score": 100.0 * score / self._upper_bound,
            "upper_bound": self._upper_bound,
            "reward_components": components,
            "variables": {name: variables[name] for name in scenario.game_variables},
            "kills": variables["KILLCOUNT"],
            "player_kills": variables["PLAYER_KILLS"],
            "episode_frames": self._frames,
            "episode_seed": self._episode_seed,
            "engine_crash": False,
        }
        if self.config.sight:
            assert self._state is not None
            info["sight"] = observe_sight(self._state, self.config)
        if terminated or truncated:
            survived = truncated and self._frames >= self._timeout_frames
            info["solved_episode"] = survived and scenario.metric == "frames_alive"
        return info

    def _show(self, tics: int) -> None:
        """Draws the screen in the window `tics` game tics after the last one, at the game's normal speed."""
        assert self._screen is not None
        if self._window is None:
            self._window = Window(self.task.id, self.config.render_width, self.config.render_height)
        now = time.monotonic()
        self._show_at_s = max(self._show_at_s + tics / TICS_PER_SECOND, now)
        time.sleep(self._show_at_s - now)
        self._window.show(self._screen)


def make_env(task_id: str, env_config: Mapping[str, Any], **options: Any) -> DoomEnv:
    """A DoomEnv from plain data: fields of EnvConfig, and options of DoomEnv. Actors call this."""
    return DoomEnv(task_id, **env_config, **options)


def _with_fields(config: EnvConfig | Mapping[str, Any] | None, fields: Mapping[str, Any]) -> EnvConfig:
    if config is None or isinstance(config, Mapping):
        config, fields = EnvConfig(), {**(config or {}), **fields}
    known = [field.name for field in dataclasses.fields(EnvConfig)]
    if unknown := sorted(fields.keys() - set(known)):
        raise UnknownOptionError(f"env: unexpected keyword argument '{unknown[0]}', want one of {', '.join(known)}")
    return dataclasses.replace(typed(EnvConfig, config, "config"), **fields)
