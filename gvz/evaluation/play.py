"""Plays evaluation episodes over the cores. An episode's seed follows from the task, the episode's number and the base
seed alone, so that every player meets the same episodes.

One game a process. A policy that decides for 4 or 8 games at once would save CPU time: with the network of
`rainbow_4task` 3.37 -> 2.93 and 2.89 ms a decision, engine included, with that of `rainbow_quick` 2.00 -> 1.38 and
1.34 ms (medians of 1 and 3 runs of 1200 decisions, 2 cores of an EPYC 7003 under a load of 8 and 17, 2026-11). It is
not done: rows would depend on the size of the batch, and games that end at different times take some of it back.
"""

import contextlib
import dataclasses
import hashlib
import queue
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from typing import TYPE_CHECKING, Any, NamedTuple

from gvz.core.env_config import EnvConfig
from gvz.core.errors import EngineError, WaitTimeoutError
from gvz.core.stop import StopRequest
from gvz.core.watchdog import AwakeClock
from gvz.evaluation.players import Player
from gvz.evaluation.workers import worker_processes

if TYPE_CHECKING:
    from gvz.env import DoomEnv

Row = dict[str, Any]

EPISODE_TIMEOUT_S = 900.0
"""an episode takes seconds; if none ends within this time, a worker hangs"""
_POLL_S = 0.2
MAX_ATTEMPTS = 3
"""times an episode is played again when its engine died"""


class Episode(NamedTuple):
    """An evaluation episode; each base seed has episodes of its own."""

    task: str
    episode: int
    base_seed: int = 0


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class PlayerSpec:
    """A player and the rules that it plays by."""

    make_player: Callable[[], Player]
    """makes the player in the process that plays; picklable for more than one"""
    env: EnvConfig
    """what it plays in; an evaluation counts rewards by the profile's weights, whatever its own are"""
    identity: Mapping[str, Any]
    """fields of each of its rows, with `player` (its name); they distinguish its rows from others' in one file"""
    recycle_episodes: int | None = None
    """of DoomEnv; 0 for players that do not see fuzz, the only thing that a fresh engine changes"""

    def make_env(self, task: str) -> "DoomEnv":
        """A game of a task by these rules, without what is for training alone."""
        from gvz.env import DoomEnv

        env = dataclasses.replace(self.env, reward_weights=(), repeat_action_probability=0.0)
        return DoomEnv(task, env, recycle_episodes=self.recycle_episodes)


def episode_seed(task: str, episode: int, base_seed: int = 0) -> int:
    """The engine's seed of an evaluation episode, 31 bits: the same for every player, run and machine."""
    text = f"{task}#{episode}" + (f"#{base_seed}" if base_seed else "")
    digest = hashlib.blake2b(text.encode(), digest_size=4).digest()
    return int.from_bytes(digest, "little") & 0x7FFFFFFF


class Tally:
    """Adds up the decisions of one episode for its row."""

    def __init__(self, episode: Episode):
        self.components: dict[str, float] = {}
        self._episode = episode
        self._reward, self._steps = 0.0, 0

    def add(self, reward: float, info: Mapping[str, Any]) -> None:
        """A decision's reward and info."""
        self._reward += reward
        self._steps += 1
        for name, value in info["reward_components"].items():
            self.components[name] = self.components.get(name, 0.0) + float(value)

    def row(self, info: Mapping[str, Any], terminated: bool, truncated: bool) -> Row:
        """The row of the episode, which ended with this info; `play_episode` says what is in it."""
        return {
            **self._episode._asdict(),
            "seed": episode_seed(*self._episode),
            "score": float(info["score"]),
            "normalized_score": float(info["normalized_score"]),
            "kills": float(info["kills"]),
            "player_kills": float(info["player_kills"]),
            "reward": self._reward,
            "reward_components": self.components,
            "length_frames": int(info["episode_frames"]),
            "length_steps": self._steps,
            "terminated": bool(terminated),
            "truncated": bool(truncated),
            "vizdoom": _vizdoom_version(),
        }


@cache
def _vizdoom_version() -> str:
    return version("vizdoom")


def play_episode(env: "DoomEnv", player: Player, episode: int, base_seed: int = 0) -> Row:
    """Plays one episode to its end.

    Returns:
        task, episode, base_seed, seed, score, normalized_score (percent), kills, player_kills, reward,
        reward_components, length_frames, length_steps, terminated, truncated, vizdoom (its version).

    Raises:
        EngineError: the engine died in each of MAX_ATTEMPTS attempts.
    """
    task = env.task.id
    seed = episode_seed(task, episode, base_seed)
    for _ in range(MAX_ATTEMPTS):
        observation, info = env.reset(options={"episode_seed": seed})
        player.begin(env, observation, info, seed)
        tally = Tally(Episode(task, episode, base_seed))
        terminated = truncated = False
        while not (terminated or truncated):
            observation, reward, terminated, truncated, info = env.step(player.act())
            player.observe(observation, info)
            tally.add(float(reward), info)
        if not info.get("engine_crash", False):
            return tally.row(info, terminated, truncated)
    raise EngineError(f"{task}, evaluation episode {episode} (seed {seed}): the engine died {MAX_ATTEMPTS} times")


def play(
    jobs: Iterable[tuple[PlayerSpec, Episode]], *, num_workers: int, stop: StopRequest | None = None
) -> Iterator[tuple[PlayerSpec, Row]]:
    """Plays episodes and yields their rows as they come, in no order.

    Args:
        jobs: what to play; it is sorted by task, so that few games are started.
        num_workers: processes; 0 plays here.
        stop: where a signal is noted, which ends this between two rows.

    Raises:
        KeyboardInterrupt: `stop` was requested.
        GvzError: a worker died.
        WaitTimeoutError: no worker finished an episode for EPISODE_TIMEOUT_S; they are killed.
    """
    ordered = sorted(jobs, key=lambda job: (repr(job[0].env), job[1].task, id(job[0]), job[1][1:]))
    if num_workers == 0:
        with contextlib.closing(_Worker()) as worker:
            for player_spec, episode in ordered:
                yield player_spec, worker.play(player_spec, id(player_spec), episode)
        return
    left, died = len(ordered), "evaluation: a worker process died; what it had not finished can be played again"
    try:
        with worker_processes(max(1, min(num_workers, left)), died) as executor:
            futures = {executor.submit(_play, job[0], id(job[0]), job[1]): job[0] for job in ordered}
            finished: queue.SimpleQueue[Future[Row]] = queue.SimpleQueue()
            for future in futures:
                future.add_done_callback(finished.put)
            while left:
                future = _next(finished, stop)
                yield futures[future], future.result()
                left -= 1
    except queue.Empty:
        raise WaitTimeoutError(
            f"evaluation: waited {EPISODE_TIMEOUT_S:g} s for one of {num_workers} workers to end an episode; {left} "
            "are left, and can be played by the same command"
        ) from None


def _next(finished: queue.SimpleQueue[Future[Row]], stop: StopRequest | None) -> Future[Row]:
    """Raises queue.Empty after EPISODE_TIMEOUT_S; time in which this process was stopped does not count."""
    clock = AwakeClock(2 * _POLL_S)
    while clock.look() < EPISODE_TIMEOUT_S:
        if stop is not None and stop.requested:
            raise KeyboardInterrupt
        with contextlib.suppress(queue.Empty):
            return finished.get(timeout=_POLL_S)
    raise queue.Empty


class _Worker:
    """What a process keeps between episodes: the last player, and the game of the last task."""

    def __init__(self) -> None:
        self._player: tuple[int, Player] | None = None
        self._env: DoomEnv | None = None
        self._rules: tuple[str, EnvConfig, int | None] | None = None

    def play(self, player_spec: PlayerSpec, key: int, episode: Episode) -> Row:
        """Plays an episode. `key` is the same for the same player_spec, however often it was pickled."""
        if self._player is None or self._player[0] != key:
            self._player = (key, player_spec.make_player())
        return play_episode(self._game(player_spec, episode.task), self._player[1], episode.episode, episode.base_seed)

    def _game(self, player_spec: PlayerSpec, task: str) -> "DoomEnv":
        rules = (task, player_spec.env, player_spec.recycle_episodes)
        if self._env is None or self._rules != rules:
            self.close()
            self._env, self._rules = player_spec.make_env(task), rules
        return self._env

    def close(self) -> None:
        """Ends the game."""
        if self._env is not None:
            self._env.close()
        self._env = None


_worker = _Worker()
"""of this worker process"""


def _play(player_spec: PlayerSpec, key: int, episode: Episode) -> Row:
    return _worker.play(player_spec, key, episode)
