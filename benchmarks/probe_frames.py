"""Frames for the supervised probe: what the scripted player sees, what it does, and where things are in sight."""

import hashlib
import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import asdict
from typing import Any

import numpy as np

from actors.preprocess import push_frame
from gvz.core.cache import cache_directory
from gvz.core.env_config import EnvConfig
from gvz.core.files import written_whole
from gvz.env import DoomEnv
from gvz.evaluation.play import play_episode
from gvz.evaluation.players import ScriptedPlayer
from gvz.evaluation.simple import player_env
from gvz.observation import Observation, in_sight
from gvz.scenarios.compiler import compile_task
from gvz.tasks import Task

SCHEMA = 1
"""Raised by one when frames recorded before can no longer be used, for example after a change of a script."""
THINGS = ("enemy", "projectile", "kit", "poison")
"""classes of the labels buffer that the probe looks for"""
NUM_COLUMNS = 8
"""of a frame, of about equal width; in each of them things are looked for"""
KEPT_PERIOD = 4
"""one of this number of decisions is kept: the next frames look almost the same"""
MIN_EPISODES = 2
"""of a task, whatever the number of frames"""
BASE_SEED = 2
"""of the episodes; evaluation has 0, the simple players were tuned on 1"""

Frames = dict[str, np.ndarray]
"""N kept decisions: `stacks` u8[N, H, W, S * C], the last S frames, oldest first; `actions` int[N], the script's;
`seen` bool[N, T, K], whether each of THINGS is in sight in each column from left to right; `episodes` int[N]"""


def chosen(frames: Frames, rows: np.ndarray) -> Frames:
    """These rows alone."""
    return {name: values[rows] for name, values in frames.items()}


def joined(parts: Sequence[Frames]) -> Frames:
    """All rows of all parts."""
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def task_frames(task: Task, env: EnvConfig, stack_size: int, num_frames: int) -> Frames:
    """`num_frames` kept decisions of the scripted player on a task; from the cache if they are there."""
    env = player_env("scripted", env)
    magic = compile_task(task, env.profile).map_magic
    text = json.dumps([SCHEMA, task.id, magic, asdict(env), stack_size, num_frames, NUM_COLUMNS])
    file = cache_directory() / "probe" / f"{hashlib.blake2b(text.encode(), digest_size=12).hexdigest()}.npz"
    if file.exists():
        with np.load(file) as saved:
            return dict(saved)
    player, found = Recorder(stack_size, -(-num_frames // MIN_EPISODES)), list[Frames]()
    with closing(DoomEnv(task, env)) as game:
        while sum(len(one["actions"]) for one in found) < num_frames:
            play_episode(game, player, len(found), BASE_SEED)
            found.append(joined(player.kept) | {"episodes": np.full(len(player.kept), len(found))})
    frames = chosen(joined(found), np.arange(num_frames))
    with written_whole(file) as writing:
        np.savez(writing, allow_pickle=False, **frames)
    return frames


class Recorder:
    """The scripted player; `kept` is what it saw and did in the last episode, at most `max_frames` decisions."""

    def __init__(self, stack_size: int, max_frames: int):
        self._script = ScriptedPlayer()
        self._stack_size, self._max_frames = stack_size, max_frames

    def begin(self, env: DoomEnv, observation: Observation, info: dict[str, Any], seed: int) -> None:
        assert isinstance(observation, dict)
        self._script.begin(env, observation, info, seed)
        self._stack = np.tile(observation["screen"], self._stack_size)
        self._labels, self._num_decisions, self.kept = observation["labels"], 0, list[Frames]()

    def act(self) -> int:
        action = self._script.act()
        if self._num_decisions % KEPT_PERIOD == 0 and len(self.kept) < self._max_frames:
            row = {
                "stacks": self._stack,
                "actions": np.array(action),
                "seen": in_sight(self._labels, THINGS, NUM_COLUMNS),
            }
            self.kept.append({name: value[None].copy() for name, value in row.items()})
        self._num_decisions += 1
        return action

    def observe(self, observation: Observation, info: dict[str, Any]) -> None:
        assert isinstance(observation, dict)
        self._script.observe(observation, info)
        push_frame(self._stack, observation["screen"])
        self._labels = observation["labels"]
