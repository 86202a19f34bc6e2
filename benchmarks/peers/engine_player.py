"""One engine that plays a sequence of decisions which follow from a seed, and says what it gave:

    python engine_player.py

Each line on its standard input is a sequence to play. The answer has one digest for each decision. PYTHONPATH says
which package of vizdoom plays. Two packages give the same answers only if a player reads the same from both (`_seen`).
"""

import dataclasses
import hashlib
import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import vizdoom
from serve import serve

from gvz.core import janitor
from gvz.engine import engine as gvz_engine
from gvz.engine import process
from gvz.env import DoomEnv

_TIMEOUTS_TICS = (15, 300)
"""of the engine itself, in every second episode; the range is below 2,100, the time-out of an environment"""
_EPISODE_DECISIONS, _EPISODE_TICS = 120, 2100
"""after this many the next episode begins"""
_REWARDS = ("living", "death", "kill", "hit", "hit_taken", "damage_made", "damage_taken", "health", "armor", "item")
_VARIABLES = list(vizdoom.GameVariable.__members__.values())


def play(
    task: str, frame_skips: list[int], screen_format: str, buffers: list[str], decisions: int, seed: int
) -> dict[str, Any]:
    """Plays `decisions` decisions in as many episodes as they take. Two episodes each have the same frame skip.

    Returns: digests, one of every decision; deaths, timeouts: episodes that ended so; inside: those of them that ended
        before the last tic of a decision; package: where vizdoom was found.
    """
    rng = np.random.default_rng(seed)
    digests: list[str] = []
    ends = {"deaths": 0, "timeouts": 0, "inside": 0}
    with _game(task, screen_format, buffers) as (game, actions):
        episode = 0
        while len(digests) < decisions:
            frame_skip = frame_skips[episode // 2 % len(frame_skips)]
            timeout = int(rng.integers(*_TIMEOUTS_TICS)) if episode % 2 else 0
            game.set_episode_timeout(timeout)
            game.set_seed(int(rng.integers(2**31)))
            game.new_episode()
            episode += 1
            start, left = _seen(game), min(_EPISODE_DECISIONS, _EPISODE_TICS // frame_skip, decisions - len(digests))
            while left and not game.is_episode_finished():
                left -= 1
                before = game.get_episode_time()
                action = actions[rng.integers(len(actions))]
                if rng.random() < 1 / 16:  # without a state at its end
                    game.set_action(action)
                    game.advance_action(frame_skip, False)
                else:
                    game.make_action(action, frame_skip)
                digests.append(hashlib.blake2b(start + _seen(game), digest_size=8).hexdigest())
                start = b""
            if game.is_episode_finished():
                ends["deaths" if game.is_player_dead() else "timeouts"] += 1
                ends["inside"] += game.get_episode_time() - before < frame_skip
    return {"digests": digests, **ends, "package": str(Path(vizdoom.__file__).parent)}


@contextmanager
def _game(task: str, screen_format: str, buffers: list[str]) -> Iterator[tuple[vizdoom.DoomGame, list[list[bool]]]]:
    """A running engine with the settings of our environments, and the actions of the task."""
    env = DoomEnv(task)
    config = dataclasses.replace(env._engine_config, **dict.fromkeys(buffers, True))
    game = gvz_engine._make_game(config)
    game.set_screen_format(getattr(vizdoom.ScreenFormat, screen_format))
    game.set_available_game_variables(_VARIABLES)
    for number, name in enumerate(_REWARDS, 1):
        for kind in ("reward", "penalty"):
            if hasattr(game, f"set_{name}_{kind}"):
                getattr(game, f"set_{name}_{kind}")(number / 16)
    directory = janitor.make_directory()
    game.set_doom_config_path(str(directory / "vizdoom.ini"))
    process.start(game, directory, Path(vizdoom.exe_path), directory / "engine.log", 120.0)
    try:
        yield game, env._actions
    finally:
        process.end_if_ours(game, directory, os.getpid())
        env.close()


def _seen(game: vizdoom.DoomGame) -> bytes:
    """All that a player can read: the rewards, the clock, the ends, every variable, and the state with its buffers."""
    found = [
        struct.pack(
            "<ddq???",
            *(game.get_last_reward(), game.get_total_reward(), game.get_episode_time()),
            *(game.is_player_dead(), game.is_episode_finished(), game.is_episode_timeout_reached()),
        ),
        struct.pack(f"<{len(_VARIABLES)}d", *map(game.get_game_variable, _VARIABLES)),
        repr(game.get_last_action()).encode(),
    ]
    state = game.get_state()
    if state is None:
        return b"".join(found)
    found += [struct.pack("<qq", state.number, state.tic), state.game_variables.tobytes()]
    for buffer in (state.screen_buffer, state.depth_buffer, state.labels_buffer, state.automap_buffer):
        found.append(b"none" if buffer is None else buffer.tobytes())
    for label in state.labels or ():
        fields = sorted(name for name in dir(label) if not name.startswith("_"))
        found.append(repr([getattr(label, name) for name in fields]).encode())
    return b"".join(found)


if __name__ == "__main__":
    serve(play, "vizdoom")
