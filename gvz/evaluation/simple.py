"""The simple players by name. Loads no numpy: the names are choices of flags, which a help text shows."""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal

from gvz.core.env_config import EnvConfig

_SMALLEST = {"render_width": 160, "render_height": 120}
"""for players that ignore observations: it changes no score"""
SIMPLE_PLAYERS: Mapping[str, Mapping[str, Any]] = {
    "random": _SMALLEST,
    "idle": {**_SMALLEST, "action_set": "combinations"},
    "sweep": {**_SMALLEST, "action_set": "buttons"},
    "scripted": {"action_set": "buttons", "buffers": ("labels",)},
}
"""the fields of EnvConfig that each needs; the scripted one aims by the pixels of the default screen"""

if TYPE_CHECKING:
    SimplePlayerName = str
else:  # choices of a flag
    SimplePlayerName = Literal[tuple(SIMPLE_PLAYERS)]


def player_env(name: SimplePlayerName, env: EnvConfig) -> EnvConfig:
    """`env` as the simple player of this name needs it."""
    return dataclasses.replace(env, **SIMPLE_PLAYERS[name])
