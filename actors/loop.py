"""The acting loop: several games, one batched decision, step records out.

The same loop runs in a worker process and, in sync mode, inside the learner's.
"""

import importlib
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np

from actors.policy import AskedPolicy, ExportedPolicy, Policy, RandomPolicy
from actors.preprocess import ObservationBatch
from gvz.core.errors import ConfigError, ResumeError
from gvz.transport.inference import RequestWriter
from gvz.transport.messages import ActorSpec, EpisodeStats, Fault, Message, ParamsHeader
from gvz.transport.ring import RingWriter, WriterState


@dataclass(kw_only=True, slots=True)
class Game:
    """One lane: an environment and what has happened since its episode began."""

    env: gymnasium.Env[np.ndarray, int]
    index: int
    """row of the batch that the policy sees"""
    lane: int
    task: int
    next_task: int
    """of the episodes after this one"""
    episode: int
    """number within the lane"""
    seed: int = 0
    frame: np.ndarray = field(default_factory=lambda: np.empty(0, np.uint8))
    """uint8[H, W, C], o_t"""
    reward: float = 0.0
    """r_t"""
    terminated: bool = False
    truncated: bool = False
    params_version: int = 0
    """of the parameters that chose the last action"""
    actions: list[int] = field(default_factory=list)
    """since the episode began; with the seed they reproduce it"""
    reward_sum: float = 0.0
    reward_components: dict[str, float] = field(default_factory=dict)
    info: dict[str, Any] = field(default_factory=dict)


class ActorLoop:
    """Plays the games of one actor.

    Args:
        spec: what to play, and how.
        ring: where records go; `step` writes one for each game.
        emit: takes an `EpisodeStats` for each episode that ends, and a `Fault` for each engine that crashed.
        requests: where the observations are kept and the actions come from, if the learner's process chooses them.
    """

    def __init__(
        self,
        spec: ActorSpec,
        ring: RingWriter,
        emit: Callable[[Message], None],
        requests: RequestWriter | None = None,
    ):
        self._spec = spec
        self._ring = ring
        self._emit = emit
        self._obs = ObservationBatch.of(spec, len(spec.lanes))
        self.games: list[Game] = []
        ring.beat(WriterState.STARTING)
        self._policy = self._local_policy() if requests is None else AskedPolicy(requests)
        if requests is not None:
            self._obs.keep_in(requests.observation)

    def begin(self, state: dict[str, Any] | None = None) -> None:
        """Starts every game: at its first episode, or where `state` says.

        Raises:
            ConfigError: the environment's frames are not what the spec says.
            ResumeError: a game does not come to where it was.
        """
        spec = self._spec
        tasks = spec.lane_tasks if state is None else [game["task"] for game in state["games"]]
        for index, (lane, task, episode) in enumerate(zip(spec.lanes, tasks, spec.first_episodes, strict=True)):
            self._ring.beat(WriterState.STARTING)
            game = Game(env=self._make_env(task), index=index, lane=lane, task=task, next_task=task, episode=episode)
            self.games.append(game)
            if state is None:
                self._reset(game)
            else:
                self._replay(game, state["games"][index])
        if state is not None:
            self._policy.num_calls = state["num_calls"]

    def set_params(self, params: np.ndarray, header: ParamsHeader) -> None:
        """Acts by `params` float32[P] from now on, which nobody may change any more."""
        self._policy.set_params(params, header)

    def assign(self, lane: int, task: int) -> None:
        """The next episodes of a lane are of the task with this index; the present one ends first."""
        next(game for game in self.games if game.lane == lane).next_task = task

    def step(self) -> None:
        """One decision for every game: writes one record each, then plays on. The ring must have the room."""
        self._ring.beat(WriterState.ACTING)
        actions, extras = self._policy.act(self._obs.arrays)
        self._write(actions, extras)
        for game in self.games:  # first: whatever ends this process while it plays on, their records are published
            if game.terminated or game.truncated:
                self._report(game)
        for game, action in zip(self.games, actions.tolist(), strict=True):
            if game.terminated or game.truncated:
                self._begin_next(game)
            else:
                self._ring.beat(WriterState.ACTING)
                game.params_version = self._policy.params_version
                self._play(game, action)

    def state(self) -> dict[str, Any]:
        """All that `begin` needs to come back here, as msgpack types. The parameters are not in it."""
        games = [
            {
                "task": game.task,
                "next_task": game.next_task,
                "episode": game.episode,
                "actions": list(game.actions),
                "params_version": game.params_version,
                "frame_crc": zlib.crc32(game.frame.tobytes()),
            }
            for game in self.games
        ]
        return {"num_calls": self._policy.num_calls, "games": games}

    def close(self) -> None:
        """Closes every game. Can be repeated."""
        while self.games:
            self.games.pop().env.close()

    def _local_policy(self) -> Policy:
        spec, obs = self._spec, self._obs.arrays
        seed = derive_seed(spec.seed, spec.actor, *spec.first_episodes)
        if not spec.policy:
            return RandomPolicy(spec.num_actions, len(spec.lanes), seed)
        return ExportedPolicy(spec.policy, spec.num_params, obs, seed, spec.fold, spec.fold_period_steps)

    def _make_env(self, task: int) -> gymnasium.Env[np.ndarray, int]:
        module, _, name = self._spec.env_entry_point.partition(":")
        return getattr(importlib.import_module(module), name)(self._spec.tasks[task], self._spec.env_config)

    def _write(self, actions: np.ndarray, extras: np.ndarray) -> None:
        """Publishes o_t, r_t, the end flags, a_t and what goes with them of every game."""
        games = self.games
        steps, frames = self._ring.reserve(len(games))
        steps["episode"] = [game.episode for game in games]
        steps["params_version"] = self._policy.params_version
        steps["reward"] = [game.reward for game in games]
        steps["lane"] = self._spec.lanes
        steps["task"] = self._obs.arrays["task"]
        steps["first"] = [not game.actions for game in games]
        steps["terminated"] = [game.terminated for game in games]
        steps["truncated"] = [game.truncated for game in games]
        steps["action"] = np.where(steps["terminated"] | steps["truncated"], 0, actions)
        if self._spec.variables:
            steps["vector"] = self._obs.arrays["vector"]
        if self._spec.num_extras:
            steps["extras"] = extras
        if self._spec.num_sights:
            steps["sight"] = [np.ravel(list(game.info["sight"].values())) for game in games]
        for frame, game in zip(frames, games, strict=True):
            frame[...] = game.frame
        self._ring.commit()

    def _play(self, game: Game, action: int) -> None:
        frame, reward, game.terminated, game.truncated, game.info = game.env.step(action)
        game.frame, game.reward = frame, float(reward)
        game.actions.append(action)
        game.reward_sum += game.reward
        for name, value in game.info["reward_components"].items():
            game.reward_components[name] = game.reward_components.get(name, 0.0) + float(value)
        self._obs.push(game.index, action, frame, game.info.get("variables", {}))

    def _report(self, game: Game) -> None:
        """Says what became of the episode, whose last record is written."""
        crashed = bool(game.info.get("engine_crash", False))
        if crashed:
            self._report_crash(game, f"at decision {len(game.actions)}")
        self._emit(
            EpisodeStats(
                lane=game.lane,
                task=game.task,
                episode=game.episode,
                seed=game.seed,
                score=float(game.info["score"]),
                reward=game.reward_sum,
                reward_components=game.reward_components,
                length_frames=int(game.info["episode_frames"]),
                length_steps=len(game.actions),
                params_version=game.params_version,
                terminated=game.terminated,
                truncated=game.truncated,
                cut=crashed,
            )
        )

    def _begin_next(self, game: Game) -> None:
        """Starts the episode after the one that has ended."""
        game.episode += 1
        if game.next_task != game.task:
            self._ring.beat(WriterState.RESETTING)  # a map may be compiled, which takes its time
            game.env.close()
            game.task, game.env = game.next_task, self._make_env(game.next_task)
        self._reset(game)

    def _report_crash(self, game: Game, when: str) -> None:
        where = f"lane {game.lane}, task {self._spec.tasks[game.task]}, episode {game.episode}, seed {game.seed}"
        message = f"{where}: the engine died {when}; a new one is started"
        error = str(game.info.get("engine_error", ""))
        fault = Fault(actor=self._spec.actor, lane=game.lane, kind="engine_crash", message=message, traceback=error)
        self._emit(fault)

    def _reset(self, game: Game) -> None:
        """Starts episode `game.episode`."""
        self._ring.beat(WriterState.RESETTING)
        game.seed = derive_seed(self._spec.seed, game.task, game.lane, game.episode)
        game.frame, game.info = game.env.reset(options={"episode_seed": game.seed})
        if game.info.get("engine_crash", False):
            self._report_crash(game, "before the first decision")
        if game.frame.shape != self._spec.frame_shape or game.frame.dtype != np.uint8:
            raise ConfigError(
                f"{self._spec.env_entry_point}({self._spec.tasks[game.task]!r}): got a frame "
                f"{game.frame.dtype}{list(game.frame.shape)}, want uint8{list(self._spec.frame_shape)}"
            )
        game.reward, game.terminated, game.truncated = 0.0, False, False
        game.actions, game.reward_sum, game.reward_components = [], 0.0, {}
        self._obs.begin(game.index, game.task, game.frame, game.info.get("variables", {}))

    def _replay(self, game: Game, state: dict[str, Any]) -> None:
        """Brings a game to where `state` left it: same episode, same seed, same actions."""
        game.episode, game.params_version = state["episode"], state["params_version"]
        game.next_task = state["next_task"]
        self._reset(game)
        for action in state["actions"]:
            self._ring.beat(WriterState.RESETTING)
            self._play(game, action)
        if zlib.crc32(game.frame.tobytes()) != state["frame_crc"]:
            raise ResumeError(
                f"lane {game.lane}, task {self._spec.tasks[game.task]}: replaying {len(game.actions)} actions of "
                f"episode {game.episode} (seed {game.seed}) did not come to the same frame; resume with the engine "
                "and the maps that the run was started with"
            )


def derive_seed(*entropy: int) -> int:
    """A 31-bit seed from integers of at least 0: the same for the same numbers, independent for others."""
    return int(np.random.SeedSequence(entropy).generate_state(1)[0] & 0x7FFFFFFF)
