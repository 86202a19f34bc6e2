"""`gvz watch`: an episode in a window."""

import contextlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import tyro

from gvz.core.errors import ConfigError
from gvz.evaluation.choice import ANY_EPISODE, EpisodeChoice
from gvz.scenarios.base import Task

if TYPE_CHECKING:
    from gvz.evaluation.play import PlayerSpec
    from gvz.viewer import Window


@dataclass(frozen=True, kw_only=True)
class Watch:
    """Watch evaluation episodes in a window, at the speed of the game; Escape or closing the window ends it.

    Beside the game stand action, values, rewards and score. Without a display, `gvz record` writes the same pictures.

    Examples: gvz watch runs/rainbow_4task/seed_1111 --task defend_the_center/complete
              gvz watch --player random --task seek_and_kill/blue --episodes 3
    """

    choice: Annotated[EpisodeChoice, tyro.conf.arg(name="")] = ANY_EPISODE
    episodes: int | None = None
    """how many, one after the other; default until the window is closed"""
    speed: float = 1.0
    """how many times the game's own speed (35 tics a second)"""

    def run(self) -> int:
        """Plays and shows; a line for each episode that ends."""
        if self.episodes is not None and self.episodes < 1:
            raise ConfigError(f"--episodes: got {self.episodes}, want at least 1")
        if not 0 < self.speed < math.inf:
            raise ConfigError(f"--speed: got {self.speed:g}, want more than 0")
        player_spec, task = self.choice.resolve()
        from gvz.evaluation.window import open_window

        window = open_window(
            "watch",
            f"{task.id}: {player_spec.identity['player']}",
            "`gvz record` writes the same pictures to a file",
        )
        episode = self.choice.episode
        with contextlib.closing(window):
            while not window.closed and (self.episodes is None or episode < self.choice.episode + self.episodes):
                self._show(window, player_spec, task, episode)
                episode += 1
        return 0

    def _show(self, window: "Window", player_spec: "PlayerSpec", task: Task, episode: int) -> None:
        """Plays an episode in the window, unless somebody closes it before."""
        from gvz.evaluation.panel import Panel
        from gvz.evaluation.play import Episode
        from gvz.evaluation.playback import perform
        from gvz.evaluation.window import show

        panel = Panel(player_spec.identity["player"], task, player_spec.env)
        with contextlib.closing(perform(player_spec, Episode(task.id, episode, self.choice.seed))) as moments:
            last = show(window, panel, moments, speed=self.speed)
        if last is not None:
            print(f"{task.id}, episode {episode}: {last.ending}")


COMMAND = Watch
