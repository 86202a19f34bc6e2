"""From the engine's rendered screen to the agent's observation: sizes, colours, buffers."""

from collections.abc import Sequence
from functools import cache
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from gymnasium import spaces

from gvz.core.env_config import LABEL_CLASSES, SIGHT_CLASSES, SIGHT_COLUMNS, EnvConfig

if TYPE_CHECKING:
    from gvz.engine.engine import GameState

Observation = np.ndarray | dict[str, np.ndarray]
"""uint8 [H, W, C]; with `EnvConfig.buffers` a dict of `screen` and these buffers."""

# Shrinking 256x144 to 84x84 (one core of an EPYC 7003): linear 20 us, area 224 us. Linear reads 2 of 3 columns.
# Measured over 216 sightings of the farthest enemies of Defend the Center (4-8 pixels wide before shrinking): they
# differ from the wall by 40 grey levels with linear and 29 with area. In units of the wall's own variation, this is 6.3
# (at worst 3.0) and 7.0 (4.5). So linear makes walls coarser and enemies stronger, and no enemy is lost.
_INTERPOLATIONS = {"linear": cv2.INTER_LINEAR, "area": cv2.INTER_AREA}

CLASS_GREYS = {
    "wall": 0,
    "plane": 20,
    "weapon": 40,
    "scenery": 60,
    "effect": 80,
    "other": 110,
    "poison": 140,
    "enemy": 170,
    "key": 200,
    "kit": 225,
    "projectile": 250,
}
"""grey levels in frames of classes: what an agent acts on is bright and what is around it dark; what it must tell apart
(poison and kits, enemies and missiles) is far from each other"""
_GREYS = np.array([CLASS_GREYS[name] for name in LABEL_CLASSES], np.uint8)

_SIGHT_PIXELS = 2
"""of a thing in a column of the frame that count as in sight"""

_CLASS_OF_NAME = {
    "Poison": "poison",  # a class of our own, derived from Health as kits are
    "BulletPuff": "effect",  # ViZDoom's category of these two is Explosive, as for missiles
    "RevenantTracerSmoke": "effect",
    "RocketSmokeTrail": "effect",
}
_CLASS_OF_CATEGORY = {
    "Self": "weapon",
    "Monster": "enemy",
    "Explosive": "projectile",
    "Health": "kit",
    "Decoration": "scenery",
    "Gore": "scenery",
    "LightSource": "scenery",
    "Vegetation": "scenery",
    "Gibs": "effect",
    "Key": "key",
}
"""category of vizdoom.Label -> class"""


def observation_space(config: EnvConfig) -> spaces.Space[Any]:
    """The Gymnasium space of the observations."""

    def box(channels: int) -> spaces.Box:
        return spaces.Box(0, 255, (config.frame_height, config.frame_width, channels), np.uint8)

    if not config.buffers:
        return box(config.channels)
    channels = {"depth": 1, "labels": 1, "automap": config.channels}
    return spaces.Dict({"screen": box(config.channels), **{name: box(channels[name]) for name in config.buffers}})


def observe_screen(screen: np.ndarray, config: EnvConfig) -> np.ndarray:
    """Rendered u8[H W 3] -> u8[frame_height frame_width C]; a new array with each call."""
    frame = _resized(screen, config)
    return cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY)[:, :, None] if config.grayscale else frame


def observe_classes(state: "GameState", config: EnvConfig) -> np.ndarray:
    """What each pixel shows, as CLASS_GREYS: u8[frame_height frame_width 1], resized as the screen is; a new array."""
    assert state.labels_buffer is not None
    return _resized(_GREYS[_class_numbers(state)][state.labels_buffer], config)[:, :, None]


def observe_buffers(state: "GameState", config: EnvConfig) -> dict[str, np.ndarray]:
    """The buffers of `config`, each in the observation's size; new arrays with each call.

    `labels` holds numbers of LABEL_CLASSES.
    """
    found = {}
    if state.depth_buffer is not None:
        found["depth"] = _values(state.depth_buffer, config)
    if state.labels_buffer is not None:
        found["labels"] = _class_numbers(state)[_values(state.labels_buffer, config)]
    if state.automap_buffer is not None:
        found["automap"] = observe_screen(state.automap_buffer, config)
    return found


def observe_sight(state: "GameState", config: EnvConfig) -> dict[str, list[bool]]:
    """Each of SIGHT_CLASSES -> whether it is in sight in each column of the frame, from left to right."""
    assert state.labels_buffer is not None
    seen = in_sight(_class_numbers(state)[_values(state.labels_buffer, config)], SIGHT_CLASSES, SIGHT_COLUMNS)
    return dict(zip(SIGHT_CLASSES, seen.tolist(), strict=True))


def in_sight(labels: np.ndarray, classes: Sequence[str], num_columns: int) -> np.ndarray:
    """Whether two pixels or more of a column are of each class: labels u8[H W 1] -> bool[classes columns]."""
    numbers = np.array([LABEL_CLASSES.index(name) for name in classes])
    pixels = (labels[None, :, :, 0] == numbers[:, None, None]).sum(axis=1)  # [classes, W]
    return np.add.reduceat(pixels, _column_starts(labels.shape[1], num_columns), axis=1) >= _SIGHT_PIXELS


@cache
def _column_starts(width: int, num_columns: int) -> tuple[int, ...]:
    """The first pixel of each column: all of about equal width."""
    return tuple(int(columns[0]) for columns in np.array_split(np.arange(width), num_columns))


def _resized(picture: np.ndarray, config: EnvConfig) -> np.ndarray:
    size = (config.frame_width, config.frame_height)
    return cv2.resize(picture, size, interpolation=_INTERPOLATIONS[config.interpolation])


def _values(pixels: np.ndarray, config: EnvConfig) -> np.ndarray:
    """u8[H W] -> u8[frame_height frame_width 1], without new values (nearest neighbour)."""
    size = (config.frame_width, config.frame_height)
    return cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST)[:, :, None]


def label_class(category: str, name: str) -> str:
    """The class of LABEL_CLASSES of a thing, by `object_category` and `object_name` of its vizdoom.Label."""
    return _CLASS_OF_NAME.get(name) or _CLASS_OF_CATEGORY.get(category, "other")


def _class_numbers(state: "GameState") -> np.ndarray:
    """u8[256]: value in the engine's labels buffer -> number in LABEL_CLASSES. The values change with each frame."""
    numbers = np.full(256, LABEL_CLASSES.index("other"), np.uint8)
    numbers[:2] = LABEL_CLASSES.index("wall"), LABEL_CLASSES.index("plane")  # the only values that are fixed
    for label in state.labels or ():
        numbers[label.value] = LABEL_CLASSES.index(label_class(label.object_category, label.object_name))
    return numbers
