"""`gvz record`: an episode as a video."""

import contextlib
import math
from collections.abc import Generator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from gvz.core.errors import ConfigError
from gvz.core.files import written_whole
from gvz.evaluation.choice import ANY_EPISODE, EpisodeChoice

if TYPE_CHECKING:
    from PIL.Image import Image

    from gvz.evaluation.playback import Moment

ANIMATION_S = 20.0
"""how much of an episode is put into a .gif or .webp, seconds, unless --seconds says otherwise: they grow large"""


@dataclass(frozen=True, kw_only=True)
class Record:
    """Record an evaluation episode as a video: the game with action, values, rewards and score.

    Needs no display. An .mp4 shows every tic and needs the extra: pip install 'gvizdoom[video]'; .webp and .gif show
    every decision.

    Examples: gvz record runs/rainbow_4task/seed_1111 --task defend_the_center/complete --out complete.mp4
              gvz record --player scripted --task seek_and_kill/blue --seconds 8 --out blue.webp
    """

    out: Path
    """file to write: .mp4, .webp or .gif"""
    choice: Annotated[EpisodeChoice, tyro.conf.arg(name="")] = ANY_EPISODE
    seconds: float | None = None
    """of game time, from the episode's start; default: the whole episode, of a .gif or .webp its first 20 seconds"""
    tensorboard: bool = False
    """show the .gif in TensorBoard, too, among the run's images"""

    def run(self) -> int:
        """Plays and writes; says how the episode ended."""
        from gvz.env import TICS_PER_SECOND
        from gvz.evaluation.panel import Panel
        from gvz.evaluation.play import Episode
        from gvz.evaluation.playback import perform
        from gvz.evaluation.video import add_to_tensorboard, check_video_file, write_video
        from gvz.evaluation.zoo import run_directory
        from gvz.run.bars import Bar, Bars

        if self.seconds is not None and not 0 < self.seconds < math.inf:
            raise ConfigError(f"--seconds: got {self.seconds:g}, want more than 0")
        if self.tensorboard and (self.out.suffix != ".gif" or self.choice.run_dir is None):
            raise ConfigError("--tensorboard: want a run directory and an --out that ends with .gif, which it can show")
        check_video_file(self.out)
        player_spec, task = self.choice.resolve()
        name, every_tic = player_spec.identity["player"], self.out.suffix == ".mp4"
        panel = Panel(name, task, player_spec.env)
        seconds = self.seconds if every_tic or self.seconds is not None else ANIMATION_S
        timeout = task.scenario.timeout_frames(player_spec.env.profile)
        num_tics = timeout if seconds is None else min(timeout, int(seconds * TICS_PER_SECOND))
        shown: list[Moment] = []

        def pictures() -> "Generator[Image, None, None]":
            episode = Episode(task.id, self.choice.episode, self.choice.seed)
            with contextlib.closing(perform(player_spec, episode)) as moments, Bars(math.inf) as bars:
                for moment in moments:
                    shown[:] = [moment]
                    picture = panel.draw(moment)
                    if every_tic or moment.decided or moment.terminated or moment.truncated:
                        yield picture
                    bars.show([Bar(name=task.id, done=moment.frames, total=num_tics, unit="tics")])
                    if moment.frames >= num_tics:
                        return

        rate = Fraction(TICS_PER_SECOND, 1 if every_tic else player_spec.env.frame_skip)
        try:
            with written_whole(self.out) as writing, contextlib.closing(pictures()) as drawn:
                write_video(writing, drawn, rate)
        except KeyboardInterrupt as interruption:
            raise KeyboardInterrupt("nothing was written") from interruption
        if self.tensorboard and self.choice.run_dir is not None:
            events = run_directory(self.choice.run_dir) / "tensorboard" / "episodes"
            add_to_tensorboard(self.out, events, f"episode/{task.id}", player_spec.identity["num_updates"])
        [last] = shown
        print(f"{self.out}: {name} {last.ending}")
        return 0


COMMAND = Record
