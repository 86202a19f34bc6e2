"""Plays evaluation episodes over the cores. The episode's seed follows from (task, episode) alone, so that every
player meets the same episodes. Imports gvz.evaluation.players, and gvz.env in the workers.
"""

import ctypes
import hashlib
import multiprocessing
import os
import signal
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import TYPE_CHECKING, Any

from gvz.errors import EngineError, GvzError
from gvz.evaluation.players import Player, PlayerSpec, make_player

if TYPE_CHECKING:
    from gvz.env import DoomEnv

Job = tuple[str, int]
"""(task id, number of the episode)"""
Row = dict[str, Any]

MAX_ATTEMPTS = 3
"""times an episode is begun anew when its engine died"""


def episode_seed(task: str, episode: int) -> int:
    """The engine's seed of an evaluation episode, 31 bits: the same for every player, run and machine."""
    digest = hashlib.blake2b(f"{task}#{episode}".encode(), digest_size=4).digest()
    return int.from_bytes(digest, "little") & 0x7FFFFFFF


def play_episode(env: "DoomEnv", player: Player, episode: int) -> Row:
    """Plays one episode to its end.

    Returns:
        task, episode, seed, score, normalized_score (percent), kills, player_kills, reward, reward_components,
        length_frames, length_steps, terminated, truncated.

    Raises:
        EngineError: the engine died in each of MAX_ATTEMPTS attempts.
    """
    task = env.task.id
    seed = episode_seed(task, episode)
    for _ in range(MAX_ATTEMPTS):
        observation, info = env.reset(options={"episode_seed": seed})
        player.begin(env, observation, info, seed)
        reward_sum, steps, components = 0.0, 0, {}
        terminated = truncated = False
        while not (terminated or truncated):
            observation, reward, terminated, truncated, info = env.step(player.act())
            player.observe(observation, info)
            reward_sum += float(reward)
            steps += 1
            for name, value in info["reward_components"].items():
                components[name] = components.get(name, 0.0) + float(value)
        if not info.get("engine_crash", False):
            return {
                "task": task,
                "episode": episode,
                "seed": seed,
                "score": float(info["score"]),
                "normalized_score": float(info["normalized_score"]),
                "kills": float(info["kills"]),
                "player_kills": float(info["player_kills"]),
                "reward": reward_sum,
                "reward_components": components,
                "length_frames": int(info["episode_frames"]),
                "length_steps": steps,
                "terminated": bool(terminated),
                "truncated": bool(truncated),
            }
    raise EngineError(f"{task}, evaluation episode {episode} (seed {seed}): the engine died {MAX_ATTEMPTS} times")


def play(
    jobs: Iterable[Job], player: PlayerSpec, env_config: dict[str, Any], *, num_workers: int, chunk: int = 4
) -> Iterator[Row]:
    """Plays episodes in `num_workers` processes and yields their rows as they come, in no order.

    Args:
        jobs: what to play.
        player: who plays.
        env_config: of `gvz.env.make_env`.
        num_workers: processes, at least 1.
        chunk: episodes handed to a worker at once.

    Raises:
        GvzError: a worker died.
    """
    ordered = sorted(jobs)
    chunks = [ordered[i : i + chunk] for i in range(0, len(ordered), chunk)]
    executor = ProcessPoolExecutor(
        max_workers=max(1, min(num_workers, len(chunks))),
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_begin_worker,
        initargs=(player, env_config, os.getpid()),
    )
    try:
        for future in as_completed([executor.submit(_play_chunk, jobs) for jobs in chunks]):
            yield from future.result()
    except BrokenProcessPool as error:
        raise GvzError("evaluation: a worker process died; what it had not finished can be played again") from error
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


class _Worker:
    """What a worker process keeps between chunks: the player, and the environment of the last task."""

    def __init__(self, player: PlayerSpec, env_config: dict[str, Any]):
        self._player, self._env_config = make_player(player), env_config
        self._env: DoomEnv | None = None

    def episode(self, task: str, episode: int) -> Row:
        if self._env is None or self._env.task.id != task:
            from gvz.env import make_env

            if self._env is not None:
                self._env.close()
            self._env = make_env(task, self._env_config)
        return play_episode(self._env, self._player, episode)


_worker: _Worker | None = None
"""of this worker process"""


def _begin_worker(player: PlayerSpec, env_config: dict[str, Any], parent_pid: int) -> None:
    global _worker
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # PR_SET_PDEATHSIG: end with the parent
    if os.getppid() != parent_pid:
        os._exit(1)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's to handle
    os.environ |= {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false", "NPROC": "1"}
    _worker = _Worker(player, env_config)


def _play_chunk(jobs: list[Job]) -> list[Row]:
    assert _worker is not None
    return [_worker.episode(task, episode) for task, episode in jobs]
