"""Graded attributes: the content of an attribute at a severity between 0 (as without it) and 1 (whole).

Numbers go this part of the way. What comes again and again comes so much more rarely (`Period`). Textures are blended,
the new one this opaque. Of the added things this share stands, evenly spread. A way of drawing (`RenderStyle`) is given
to this share of the enemies or kits, drawn for each.

An attribute that brings another map or other classes of things has nothing in between, nor has one that sets a property
to Toward or Chance. It is whole, but in force only in this share of the episodes; an episode's seed says whether.
"""

import dataclasses
import hashlib
import random
from collections.abc import Mapping

from gvz.scenarios.base import Blend, Chance, Content, Period, Textures, Thing, Toward, Uniform, Value


def is_whole(change: Content) -> bool:
    """Whether an attribute's content cannot be graded."""
    named = any(isinstance(value, str | tuple | bool) for value in change.parameters.values())
    part = any(isinstance(value, Toward | Chance) for value in (*change.entity.values(), *change.agent.values()))
    return named or part or bool(change.base_wad or change.actors)


def in_force(severity: float, attribute: str, episode_seed: int) -> bool:
    """Whether a whole attribute is in force in an episode; one that is, is so at every higher severity."""
    return random.Random(f"{attribute} {episode_seed}").random() < severity


def graded(before: Content, change: Content, severity: float) -> Content:
    """What a change that is not whole sets at a severity.

    Args:
        before: the content that the change is made to.
        change: the attribute's content.
        severity: from 0 to 1, both excluded.
    """
    textures, blends = None, {}
    if change.textures is not None:
        assert before.textures is not None, "a scenario's own content has textures"
        pairs = zip(dataclasses.astuple(before.textures), dataclasses.astuple(change.textures), strict=True)
        names, blends = [], {}
        for one, other in pairs:
            blend = Blend(one.upper(), other.upper(), severity)
            name = f"X{hashlib.sha256(repr(blend).encode()).hexdigest()[:7].upper()}"
            names.append(name)
            blends[name] = blend
        textures = Textures(*names)
    return dataclasses.replace(
        change,
        textures=textures,
        blends=blends,
        things={wad: _spread(things, severity) for wad, things in change.things.items()},
        parameters=_part_way(before.parameters, change.parameters, severity),
        entity=_part_way(before.entity, change.entity, severity),
        agent=_part_way(before.agent, change.agent, severity),
    )


def _spread(items: tuple[Thing, ...], share: float) -> tuple[Thing, ...]:
    """This share of the things, evenly spread."""
    permille = round(1000 * share)
    return tuple(item for n, item in enumerate(items) if (n + 1) * permille // 1000 > n * permille // 1000)


def _part_way(before: Mapping[str, Value], change: Mapping[str, Value], share: float) -> dict[str, Value]:
    return {name: _between(before.get(name), value, share) for name, value in change.items()}


def _between(before: Value | None, value: Value, share: float) -> Value:
    if isinstance(value, str | bool):
        return Chance(str(value), share, str(before) if isinstance(before, str | bool) else None)
    assert isinstance(value, int | float | Uniform), "change is not whole"
    if not isinstance(before, int | float | Uniform):
        return Toward(value, share)
    if isinstance(value, Period) and before == 0:
        return Period(round(value / share))
    if isinstance(before, int) and isinstance(value, int):
        return round(before + share * (value - before))
    (low, high), (new_low, new_high) = _ends(before), _ends(value)
    ends = low + share * (new_low - low), high + share * (new_high - high)
    return Uniform(*ends) if ends[0] < ends[1] else float(ends[0])


def _ends(value: float | Uniform) -> tuple[float, float]:
    return (value.low, value.high) if isinstance(value, Uniform) else (value, value)
