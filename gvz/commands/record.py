"""`gvz record`: an episode as a video."""

import contextlib
import sys
from collections.abc import Callable, Generator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gvz.core.errors import ConfigError
from gvz.evaluation.choice import ANY_EPISODE, EpisodeChoice, make_panel

if TYPE_CHECKING:
    from PIL.Image import Image

    from gvz.evaluation.playback import Moment

EXIT_INTERRUPTED = 130
ANIMATION_S = 20.0
"""how much of an episode is put into a .gif or .webp, seconds, unless --seconds says otherwise: they grow large"""


@dataclass(frozen=True, kw_only=True)
class Record:
    """Record an evaluation episode as a video: the game, and beside it action, values, rewards and score.

    Needs no display. An .mp4 shows every tic and needs the extra: pip install 'gvizdoom[video]'; .webp and .gif show
    every decision.

    Examples: gvz record runs/rainbow_4task/seed_1111 --task defend_the_center/complete --out complete.mp4
              gvz record --player scripted --task seek_and_kill/blue --seconds 8 --out blue.webp
    """

    out: Path
    """file to write: .mp4, .webp or .gif"""
    choice: Annotated[EpisodeChoice, tyro.conf.arg(name="")] = ANY_EPISODE
    seconds: float | None = None
    """of game time, from the episode's start; default all of it (.gif, .webp: at most 20)"""
    tensorboard: bool = False
    """show the .gif in TensorBoard, too, among the run's images"""

    def run(self) -> int:
        """Plays and writes; says how the episode ended."""
        from gvz.env import TICS_PER_SECOND
        from gvz.evaluation.play import Episode
        from gvz.evaluation.playback import perform
        from gvz.evaluation.video import add_to_tensorboard, check_video_file, write_video

        if self.seconds is not None and self.seconds <= 0:
            raise ConfigError(f"--seconds: got {self.seconds:g}, want more than 0")
        if self.tensorboard and (self.out.suffix != ".gif" or self.choice.run_dir is None):
            raise ConfigError("--tensorboard: want a run directory and an --out that ends with .gif, which it can show")
        check_video_file(self.out)
        player_spec, task = self.choice.resolve()
        panel, every_tic = make_panel(player_spec, task), self.out.suffix == ".mp4"
        seconds = self.seconds if every_tic or self.seconds is not None else ANIMATION_S
        timeout = task.scenario.timeout_frames(player_spec.env.profile)
        num_tics = timeout if seconds is None else min(timeout, int(seconds * TICS_PER_SECOND))
        shown: list[Moment] = []

        def pictures() -> "Generator[Image, None, None]":
            episode = Episode(task.id, self.choice.episode, self.choice.seed)
            with contextlib.closing(perform(player_spec, episode)) as moments, _progress(num_tics) as advance:
                for moment in moments:
                    shown[:] = [moment]
                    picture = panel.draw(moment)
                    if every_tic or moment.decided or moment.terminated or moment.truncated:
                        yield picture
                    advance(moment.frames)
                    if moment.frames >= num_tics:
                        return

        rate = Fraction(TICS_PER_SECOND, 1 if every_tic else player_spec.env.frame_skip)
        try:
            with contextlib.closing(pictures()) as drawn:
                write_video(self.out, drawn, rate)
        except KeyboardInterrupt:
            print("interrupted; nothing was written", file=sys.stderr)
            return EXIT_INTERRUPTED
        if self.tensorboard and self.choice.run_dir is not None:
            events = self.choice.run_dir / "tensorboard" / "episodes"
            add_to_tensorboard(self.out, events, f"episode/{task.id}", player_spec.identity["num_updates"])
        [last] = shown
        how = "died" if last.terminated else "reached the time-out" if last.truncated else "was cut off"
        print(f"{self.out}: {player_spec.identity['player']} {how} at tic {last.frames}, score {last.score:g}")
        return 0


COMMAND = Record


@contextlib.contextmanager
def _progress(total: int) -> Generator[Callable[[int], None], None, None]:
    """A bar on a terminal; gives the function that moves it."""
    from rich.console import Console
    from rich.progress import Progress

    console = Console(stderr=True)
    with Progress(console=console, disable=not console.is_terminal) as bar:
        shown = bar.add_task("tics", total=total)
        yield lambda done: bar.update(shown, completed=done)
