"""`gvz play`: a person plays evaluation episodes."""

import contextlib
import itertools
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gvz.core.env_config import EnvConfig, Profile
from gvz.core.errors import ConfigError
from gvz.scenarios.base import Task
from gvz.tasks import parse_task

if TYPE_CHECKING:
    from gvz.evaluation.episode_log import RecordFile
    from gvz.viewer import Window

SPEED = 1.0
"""times the game's own; no flag, since scores at another speed do not compare"""


@dataclass(frozen=True, kw_only=True)
class Play:
    """Play a task yourself, in a window, with the keyboard; each finished episode becomes a row of a record file.

    Episode n is the same game that every other player meets, and the rows are those of `gvz evaluate`: `gvz report`
    takes them. The same command goes on with the next episode. Escape or closing the window ends it; an episode that
    is not finished is not recorded.

    Keys: arrows or w a s d move and turn, space or the left control key shoots, shift runs, e uses. The panel shows
    those of the task. What is pressed when a decision is due, or was pressed since the last one, is held until the
    next: several keys are the action of `action_set="combinations"` that differs from them by the fewest buttons, and
    of two such actions the one with the key pressed last.

    Examples: gvz play seek_and_kill/blue
              gvz play defend_the_center/complete --every-tic --out me.jsonl
    """

    task: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK")]
    """id, for example seek_and_kill/blue+obstacles (gvz tasks lists the named ones)"""
    every_tic: bool = False
    """decide 35 times a second, and not as often as agents do: every 4 tics"""
    episodes: int | None = None
    """how many, one after the other; default until the window is closed"""
    out: Path = Path("human.jsonl")
    """record file, JSON lines; may hold other players' rows, too"""
    name: str = "human"
    """in the records, where " every tic" is added with --every-tic; give each person one"""
    seed: int = 0
    """base seed: each draws episodes of its own. 0 is the set that all published scores are of"""
    profile: Profile = "thesis"
    """rules of the task"""

    def run(self) -> int:
        """Plays and records; a line for each episode."""
        task = parse_task(self.task)
        self._check()
        from gvz.evaluation.episode_log import RecordFile
        from gvz.evaluation.window import open_window

        with (
            contextlib.closing(open_window("play", task.id, "play on a computer with a screen")) as window,
            contextlib.closing(RecordFile(self.out)) as file,
        ):
            try:
                self._play(window, task, file)
            except KeyboardInterrupt as interruption:
                raise KeyboardInterrupt("the same command goes on from here") from interruption
        return 0

    def _check(self) -> None:
        from gvz.evaluation.simple import SIMPLE_PLAYERS

        if self.episodes is not None and self.episodes < 1:
            raise ConfigError(f"--episodes: got {self.episodes}, want at least 1")
        if not 0 <= self.seed < 2**63:  # what a report reads
            raise ConfigError(f"--seed: got {self.seed}, want a number from 0 to 2^63 - 1")
        if not self.name.strip() or self.name in SIMPLE_PLAYERS:
            raise ConfigError(f"--name: got {self.name!r}, want a name of your own, not {', '.join(SIMPLE_PLAYERS)}")

    def _play(self, window: "Window", task: Task, file: "RecordFile") -> None:
        """Plays what is not recorded yet, until there are enough episodes or the window is closed."""
        from gvz.actions import action_buttons
        from gvz.evaluation.episode_log import row_identity, rows_of
        from gvz.evaluation.human import HumanPlayer, key_help
        from gvz.evaluation.panel import Panel
        from gvz.evaluation.play import Episode, PlayerSpec
        from gvz.evaluation.playback import perform
        from gvz.evaluation.window import show

        frame_skip = 1 if self.every_tic else EnvConfig().frame_skip
        env = EnvConfig(
            profile=self.profile,
            frame_skip=frame_skip,
            action_set="combinations",
            render_width=160,  # of the game that nobody sees: the smallest
            render_height=120,
        )
        identity = row_identity({"player": self.name + (" every tic" if self.every_tic else "")}, env)
        player_spec = PlayerSpec(
            make_player=lambda: HumanPlayer(window), env=env, identity=identity, recycle_episodes=0
        )
        recorded, keys = rows_of(player_spec, file.rows), key_help(action_buttons(task.scenario, env.action_set))
        every = (Episode(task.id, number, self.seed) for number in itertools.count())
        missing = (episode for episode in every if episode not in recorded)
        for episode in itertools.islice(missing, self.episodes):
            panel = Panel(player_spec.identity["player"], task, env, notes=("keys", *keys, "escape: end"))
            prompt = f"episode {episode.episode}: press a key to begin"
            with contextlib.closing(perform(player_spec, episode)) as moments:
                last = show(window, panel, moments, speed=SPEED, prompt=prompt)
            if last is None:
                return
            assert last.row is not None, "the episode has ended"
            file.append({**identity, **last.row})
            print(f"{task.id}, episode {episode.episode}: {last.ending}")


COMMAND = Play
