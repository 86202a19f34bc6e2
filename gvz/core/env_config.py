"""The vocabulary of sizes that game, actors and learner share, and the check of a field's type."""

import contextlib
import math
import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import cache, partial
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from gvz.core.errors import ConfigError
from gvz.core.ranges import Range, check_ranges

ActionSet = Literal["buttons", "combinations", "unified_v1", "multi_discrete_v1"]
Profile = Literal["thesis", "levdoom"]
Buffer = Literal["depth", "labels", "automap"]
Interpolation = Literal["linear", "area"]
LABEL_CLASSES = (
    *("wall", "plane", "weapon", "enemy", "projectile"),
    *("kit", "poison", "scenery", "effect", "other"),
    "key",
)
"""What a pixel of the buffer `labels` shows, by number: 0 walls and the HUD; 1 floors and ceilings; 2 the agent's
own weapon; 3 living enemies; 4 missiles and fire; 5 what heals; 6 vials of poison; 7 decorations, lights and
corpses; 8 puffs, smoke and blood; 9 anything else: portals, ammunition, barrels; 10 keys. A number never changes its
meaning."""
SIGHT_CLASSES = ("enemy", "projectile", "kit", "poison", "key")
"""the classes that an agent acts on"""
SIGHT_COLUMNS = 12
"""of a frame, of about equal width; in each of them things are looked for"""


@dataclass(frozen=True, kw_only=True, slots=True)
class EnvConfig:
    """How a task is rendered, stepped and rewarded. Sizes in pixels, `frame_skip` in game tics.

    `reward_weights` may also be a mapping. It is kept as pairs, sorted by name.

    Source: thesis 3.1.1 and 5.1 (84x84 RGB, frame skip 4). Differs: rendered at 256x144 instead of 640x480,
    the same 16:9 field of view of 108 degrees at a fifth of the cost.
    """

    frame_height: Annotated[int, Range(8, 1080)] = 84
    """height of an observation frame, pixels"""
    frame_width: Annotated[int, Range(8, 1920)] = 84
    """width of an observation frame, pixels"""
    grayscale: bool = False
    """one luminance channel instead of RGB"""
    frames: Literal["screen", "classes", "segmented"] = "screen"
    """classes: instead of the screen, a grey picture of what each pixel shows (LABEL_CLASSES). segmented: a picture of
    what a network takes each pixel of the screen for"""
    segmenter: str = ""
    """the network of segmented frames: one that comes with GViZDoom, by its name (train4: one for each scenario, which
    has seen four training tasks; varied: has seen eight training tasks and varied maps), or the path of an ONNX
    file (gvz segmenter trains one), or of a directory with a file for each scenario; default: that of the scenario's
    name"""
    segmenter_temperature: Annotated[float, Range(0.1, 10)] = 1.0
    """the network's probabilities are raised to the power of 1 / this before they become colours: above 1, unlikely
    classes are seen better (temperature scaling, Guo et al. 2017)"""
    frame_skip: Annotated[int, Range(1, 35)] = 4
    """game tics an action is held; one decision = frame_skip frames"""
    repeat_action_probability: float = 0.0
    """sticky actions, for training: with this probability a decision's buttons stay those of the decision before.
    Evaluations have none (Machado et al. 2018)"""
    render_width: Annotated[int, Range(160, 1920)] = 256
    """width the engine renders, pixels (must be a ViZDoom screen resolution with render_height)"""
    render_height: Annotated[int, Range(120, 1200)] = 144
    """height the engine renders, pixels"""
    action_set: ActionSet = "buttons"
    """buttons: one button held an action; combinations: all non-contradictory sets; unified_v1: one list of actions for
    all scenarios; multi_discrete_v1: a MultiDiscrete space for all scenarios, not for the trainer"""
    profile: Profile = "thesis"
    """whose numbers where they differ: the thesis's text, or LevDoom's maps and settings"""
    interpolation: Interpolation = "linear"
    """how the rendered screen is shrunk; linear is ten times cheaper and loses no enemy (see observation.py)"""
    buffers: tuple[Buffer, ...] = ()
    """more than the screen: observations become a dict of `screen` and these"""
    sight: bool = False
    """`info` has `sight`: which of SIGHT_CLASSES are in sight in each of SIGHT_COLUMNS columns of the frame"""
    reward_weights: tuple[tuple[str, float], ...] = ()
    """reward components and their weights, in place of the profile's: kill 2 death 0; seek_and_kill.moved 0 is of one
    scenario alone"""

    def __post_init__(self) -> None:
        if isinstance(self.reward_weights, Mapping):
            object.__setattr__(self, "reward_weights", tuple(self.reward_weights.items()))
        check_types(self, "env")
        object.__setattr__(self, "reward_weights", tuple(sorted(self.reward_weights)))
        names = [name for name, _ in self.reward_weights]
        if len(set(names)) < len(names):
            raise ConfigError(f"env.reward_weights: got {' '.join(names)}, want each component once")
        if self.frames != "screen" and self.buffers:
            raise ConfigError(f"env.buffers: got {' '.join(self.buffers)} with env.frames {self.frames}, want none")
        if self.segmenter and self.frames != "segmented":
            raise ConfigError(f"env.segmenter: got {self.segmenter} with env.frames {self.frames}, want segmented")
        if self.segmenter_temperature != 1.0 and self.frames != "segmented":
            raise ConfigError(
                f"env.segmenter_temperature: got {self.segmenter_temperature} with env.frames {self.frames}, want 1"
            )
        if self.grayscale and self.frames == "segmented":
            raise ConfigError("env.grayscale: got True with env.frames segmented, whose three channels are classes")
        if self.interpolation != "linear" and self.frames == "segmented":
            raise ConfigError(f"env.interpolation: got {self.interpolation} with env.frames segmented, want linear")
        check_ranges("env", self)
        if not 0.0 <= self.repeat_action_probability < 1.0:
            raise ConfigError(
                f"env.repeat_action_probability: got {self.repeat_action_probability}, want at least 0 and less than 1"
            )
        if self.sight and self.frame_width < SIGHT_COLUMNS:
            raise ConfigError(f"env.frame_width: got {self.frame_width} with env.sight, want {SIGHT_COLUMNS} or more")

    @property
    def channels(self) -> int:
        return 1 if self.grayscale or self.frames == "classes" else 3

    @property
    def frame_shape(self) -> tuple[int, int, int]:
        """(H, W, C) of one observation frame, uint8."""
        return (self.frame_height, self.frame_width, self.channels)


_LARGEST_EXACT = 2**53
"""integers up to this are floating-point numbers, too"""


def typed(kind: Any, value: Any, where: str, *, convert: bool = True) -> Any:
    """`value` as the type `kind`, which a field of a configuration is annotated with.

    A number of numpy becomes Python's, an integer a float where a float is wanted, a list a tuple, a string a path.
    Nothing else is converted: True is no 1, and 4.0 no 4.

    Args:
        kind: bool, int, float, str, Path, another class, a Literal, a tuple or a Mapping of these, or one of several
            and None. What is Any is not looked at.
        value: anything.
        where: the field, for the error.
        convert: False is for a caller that keeps `value` as it is: then a list is no tuple.

    Raises:
        ConfigError: it is of another type, none of the Literal's values, or not finite.
    """
    origin, args = get_origin(kind), get_args(kind)
    part = partial(typed, convert=convert)
    if kind is Any:
        return value
    if origin in (UnionType, Union):
        kinds = [one for one in args if one is not NoneType]
        if value is None and len(kinds) < len(args):
            return None
        if len(kinds) == 1:
            return part(kinds[0], value, where)
        for one in kinds:
            with contextlib.suppress(ConfigError):
                return part(one, value, where)
        raise ConfigError(f"{where}: got {value!r}, want {kind}")
    if origin is Mapping:
        if not isinstance(value, Mapping):
            raise ConfigError(f"{where}: got {value!r}, want a mapping")
        of_name, of_value = args
        return {part(of_name, n, where): part(of_value, one, f"{where}[{n!r}]") for n, one in value.items()}
    if origin is tuple:
        if not isinstance(value, list | tuple if convert else tuple):
            wanted, example = ("a list", f"[{value!r}]") if convert else ("a tuple", f"({value!r},)")
            such_as = f", such as {example}" if type(value) is args[0] else ""
            raise ConfigError(f"{where}: got {value!r}, want {wanted}{such_as}")
        if args[-1] is ...:
            return tuple(part(args[0], item, where) for item in value)
        if len(value) != len(args):
            raise ConfigError(f"{where}: got {value!r}, want {' and '.join(arg.__name__ for arg in args)}")
        return tuple(part(arg, item, f"{where}, {value!r}") for arg, item in zip(args, value, strict=True))
    if origin is Literal:
        if not any(type(value) is type(arg) and value == arg for arg in args):  # True and 1.0 equal 1, and are not it
            raise ConfigError(f"{where}: got {value!r}, want one of {', '.join(map(str, args))}")
        return value
    if kind is Path and isinstance(value, str):
        return Path(value)
    is_number = issubclass(type(value), Real) and type(value) is not bool
    is_integer = is_number and issubclass(type(value), Integral)
    if kind is int and is_integer:
        return int(value)
    if kind is float and is_number:
        if (is_integer and abs(value) > _LARGEST_EXACT) or not math.isfinite(value):
            raise ConfigError(f"{where}: got {value}, want a finite float")
        return float(value)
    if not isinstance(value, origin or kind) or (kind is not bool and isinstance(value, bool)):
        raise ConfigError(f"{where}: got {value!r}, want {'a function' if origin is Callable else kind.__name__}")
    return value


def leaves(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """(dotted name, value) of every field of a dataclass and of the dataclasses in it."""
    for field in fields(config):
        value = getattr(config, field.name)
        if is_dataclass(value):
            yield from leaves(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value


_hints = cache(get_type_hints)


def check_types(config: Any, prefix: str, *, convert: bool = True) -> None:
    """Gives each field of a frozen dataclass the type that it is annotated with; for its `__post_init__`.

    Args:
        config: the dataclass.
        prefix: what its fields are named behind in errors.
        convert: False only looks at the types, and leaves the values as they are: 1 and 1.0 differ in a script.

    Raises:
        ConfigError: as `typed`; names the field behind `prefix`.
    """
    for name, kind in _hints(type(config)).items():
        value = typed(kind, getattr(config, name), f"{prefix}.{name}", convert=convert)
        if convert:
            object.__setattr__(config, name, value)


EPISODE_SEEDS = 2**31
"""an episode's seed is smaller than this"""


def given_episode_seed(options: Any, others: Sequence[str] = ()) -> int | None:
    """The episode seed in the options of an environment's `reset`; None if it has none.

    Raises:
        ValueError: no mapping, an option that is neither `episode_seed` nor of `others`, or an episode seed outside
            [0, 2^31).
    """
    if not isinstance(options, Mapping):
        raise ValueError(f"reset: options: got {options!r}, want a dict, such as {{'episode_seed': 1}}")
    known = ("episode_seed", *others)
    if unknown := [name for name in options if name not in known]:
        raise ValueError(f"reset: unknown options {unknown}, want {' or '.join(known)}")
    given = options.get("episode_seed")
    if given is not None and not 0 <= as_integer(given) < EPISODE_SEEDS:
        raise ValueError(f"reset: episode_seed {given!r}, want an integer, 0..{EPISODE_SEEDS - 1}")
    return None if given is None else as_integer(given)


def as_integer(value: object) -> int:
    """The value as an integer; -1 for anything else, such as 1.5 or an array."""
    try:
        return operator.index(value)  # pyright: ignore[reportArgumentType]
    except TypeError:
        return -1
