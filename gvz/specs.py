"""The vocabulary of sizes that game, actors and learner share. Imports gvz.errors and the standard library only."""

from dataclasses import dataclass
from typing import Literal, get_args

from gvz.errors import ConfigError

ActionSet = Literal["buttons", "combinations", "unified"]
Profile = Literal["thesis", "levdoom"]
Buffer = Literal["depth", "labels", "automap"]
Interpolation = Literal["linear", "area"]
SimplePlayer = Literal["random", "idle", "sweep", "scripted"]
"""who plays without training"""


@dataclass(frozen=True, kw_only=True, slots=True)
class EnvConfig:
    """How a task is rendered and stepped. Sizes in pixels, `frame_skip` in game tics.

    Source: thesis 3.1.1 and 5.1 (84x84 RGB, frame skip 4). Differs: rendered at 256x144 instead of 640x480,
    the same 16:9 field of view of 108 degrees at a fifth of the cost.
    """

    frame_height: int = 84
    """height of an observation frame, pixels"""
    frame_width: int = 84
    """width of an observation frame, pixels"""
    grayscale: bool = False
    """one luminance channel instead of RGB"""
    frame_skip: int = 4
    """game tics an action is held; one decision = frame_skip frames"""
    render_width: int = 256
    """width the engine renders, pixels (must be a ViZDoom screen resolution with render_height)"""
    render_height: int = 144
    """height the engine renders, pixels"""
    action_set: ActionSet = "buttons"
    """buttons: one button held an action; combinations: all non-contradictory sets; unified: one space for all"""
    profile: Profile = "thesis"
    """whose numbers where they differ: the thesis's text, or LevDoom's maps and settings"""
    interpolation: Interpolation = "linear"
    """how the rendered screen is shrunk; linear is ten times cheaper and loses no enemy (see observation.py)"""
    buffers: tuple[Buffer, ...] = ()
    """more than the screen: observations become a dict of `screen` and these"""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("frame_height", 8, 1080),
            ("frame_width", 8, 1920),
            ("frame_skip", 1, 35),
            ("render_width", 160, 1920),
            ("render_height", 120, 1200),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ConfigError(f"env.{name}: got {value}, want {low}..{high}")
        for name, kind in (("action_set", ActionSet), ("profile", Profile), ("interpolation", Interpolation)):
            if getattr(self, name) not in get_args(kind):
                raise ConfigError(f"env.{name}: got {getattr(self, name)!r}, want one of {', '.join(get_args(kind))}")
        if not set(self.buffers) <= set(get_args(Buffer)):
            raise ConfigError(f"env.buffers: got {self.buffers!r}, want some of {', '.join(get_args(Buffer))}")

    @property
    def channels(self) -> int:
        return 1 if self.grayscale else 3

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """(H, W, C) of one observation frame, uint8."""
        return (self.frame_height, self.frame_width, self.channels)
