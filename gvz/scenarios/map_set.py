"""Sets of drawn maps: their names, their splits by number, and how strongly each part of a map may differ.

A drawn map follows from the scenario, its number, the split's pools and the strengths, and from nothing else.
"""

import re
from dataclasses import dataclass
from typing import Literal

from gvz.core.env_config import check_types
from gvz.core.errors import TaskError, nearest

VARIED, PROCEDURAL = "varied", "procedural"
MapSplit = Literal["varied", "train", "validation", "test"]
PARTS = ("layout", "textures", "decorations", "lights", "entities")
"""parts of a map that are drawn, each with a strength from 0 (as the default task has it) to 1 (all there is)"""

NUMBERS: dict[MapSplit, range] = {
    "varied": range(1000),
    "test": range(1_000_000),
    "validation": range(1_000_000, 2_000_000),
    "train": range(2_000_000, 2**31),
}
"""numbers of the maps of each split. No two splits of procedural maps share one; those of `varied` are drawn apart"""


@dataclass(frozen=True, slots=True)
class MapSet:
    """The maps of a task that plays every episode on a drawn map.

    Attributes:
        split: of procedural maps; or varied: the default layout, with looks from all pools.
        num_maps: the first so many maps of the split; 0 stands for all of them.
        strengths: (part, strength from 0 to 1) pairs; a part that is left out has strength 1. `varied` has its own.

    Raises:
        TaskError: a number, part or strength out of range. ConfigError: a field of another type.
    """

    split: MapSplit
    num_maps: int = 0
    strengths: tuple[tuple[str, float], ...] = ()

    def __post_init__(self) -> None:
        if self.split not in NUMBERS:
            raise _unknown_split(self.split)
        check_types(self, self._stem)
        most = len(NUMBERS[self.split])
        if not 0 <= self.num_maps <= most:
            raise TaskError(f"{self._stem}-{self.num_maps}: want 1 to {most} maps")
        object.__setattr__(self, "num_maps", self.num_maps or most)
        for part, strength in self.strengths:
            if part not in PARTS:
                raise TaskError(
                    f"{self._stem}: unknown part {part!r}{nearest(part, PARTS)}; want one of {', '.join(PARTS)}"
                )
            if not 0 <= strength <= 1 or round(strength, 3) != strength:  # the name gives three decimals back
                raise TaskError(
                    f"{self._stem}: got {part}={strength:g}, want a strength from 0 (as in the default task) to 1, "
                    "with at most three decimals"
                )
        given = {"layout": 0.0} if self.split == VARIED else dict(self.strengths)
        kept = tuple((part, float(given[part])) for part in PARTS if given.get(part, 1) != 1)
        object.__setattr__(self, "strengths", kept)

    def strength(self, part: str) -> float:
        """How strongly a part of PARTS may differ from the default task's, 0 to 1."""
        return dict(self.strengths).get(part, 1.0)

    def number_of(self, episode_seed: int) -> int:
        """The number of the map that the episode with this seed is played on."""
        return NUMBERS[self.split][episode_seed % self.num_maps]

    @property
    def _stem(self) -> str:
        return VARIED if self.split == VARIED else f"{PROCEDURAL}-{self.split}"

    @property
    def name(self) -> str:
        """Canonical: "varied", "varied-10", "procedural-train", "procedural-test-20+layout=0.5+lights=0"."""
        number = "" if self.num_maps == len(NUMBERS[self.split]) else f"-{self.num_maps}"
        if self.split == VARIED:
            return self._stem + number
        return "+".join((self._stem + number, *(f"{part}={value:g}" for part, value in self.strengths)))


def _unknown_split(name: str) -> TaskError:
    known = [split for split in NUMBERS if split != VARIED]
    return TaskError(
        f"{PROCEDURAL}: unknown split {name!r}{nearest(name, known)}; want one of {', '.join(known)}, and then perhaps "
        "'-<number of maps>'"
    )


def names_map_set(name: str) -> bool:
    """Whether a task's name, or a word of it between plus signs, is that of a set of drawn maps."""
    return re.split("[-+=]", name, maxsplit=1)[0] in (VARIED, PROCEDURAL)


def parse_map_set(name: str) -> MapSet:
    """The set of a name.

    Args:
        name: `varied` or `varied-<number of maps>`, without the attributes that may follow; or `procedural`, which is
            `procedural-train`, `procedural-<split>` or `procedural-<split>-<number of maps>`, then `+<part>=<strength>`
            for any parts.

    Raises:
        TaskError: another form, or something out of range; the message says what is possible.
    """
    stem, *settings = name.split("+")
    kind, *words = re.split("[-=]", stem)
    split = VARIED if kind == VARIED else "train"
    if kind == PROCEDURAL and words and words[0]:
        split = words.pop(0)
    if (split == VARIED) != (kind == VARIED):
        raise _unknown_split(split)
    if "=" in stem or len(words) > 1 or not all(re.fullmatch("[1-9][0-9]{0,9}", word) for word in words):
        example = "'varied-10'" if kind == VARIED else "'procedural-train-100'"
        raise TaskError(
            f"got {name!r}, want '{kind}{'-<split>' * (kind == PROCEDURAL)}-<number of maps>', as {example}"
        )
    strengths: dict[str, float] = {}
    for setting in settings:
        part, _, value = setting.partition("=")
        if not re.fullmatch(r"[0-9]+(\.[0-9]+)?", value) or part in strengths:
            raise TaskError(
                f"got {setting!r} in {name!r}, want each at most once: '<part>=<strength>', parts {', '.join(PARTS)}, "
                f"strengths from 0 to 1, as 'layout=0.5'; attributes go with {VARIED!r} alone"
            )
        strengths[part] = float(value)
    return MapSet(split, int(words[0]) if words else 0, tuple(strengths.items()))  # pyright: ignore[reportArgumentType]
