"""Parts of content that several scenarios have."""

from collections.abc import Iterable, Mapping

from gvz.scenarios.base import Attribute, Content, Textures, Thing, Uniform
from gvz.scenarios.layout import MAP_SPOT

RESIZED = Content(entity={"ScaleX": Uniform(0.3, 3.0), "ScaleY": Uniform(0.3, 3.0)})
"""enemies or kits of any width and height"""
RESIZED_ENEMIES = Attribute(name="resized_enemies", groups=("entity_size",), aliases=("resized",), content=RESIZED)
SHORT_AGENT = Attribute(
    name="short_agent", groups=("agent_height",), content=Content(agent={"ViewHeight": Uniform(0.0, 100.0)})
)
COUNTED_MARINE = {"MarineChainsawVzd": "ACTOR MarineChainsawVzd : MarineChainsaw\n{\n  +COUNTKILL\n}\n"}
"""class name -> definition: a marine with a chainsaw whose death counts as a kill"""


def retextured(name: str, wall: str, floor: str, ceiling: str) -> Attribute:
    """An attribute that changes all textures."""
    return Attribute(name=name, groups=("textures",), content=Content(textures=Textures(wall, floor, ceiling)))


def rendered(name: str, style: str, *aliases: str) -> Attribute:
    """An attribute that gives enemies or kits a render style of the engine's, such as STYLE_Add."""
    content = Content(entity={"RenderStyle": style})
    return Attribute(name=name, groups=("entity_rendering",), aliases=aliases, content=content)


GLOWING_ENEMIES = rendered("glowing_enemies", "STYLE_Add", "glowing")


def things_at(places: Mapping[int, Iterable[tuple[float, float]]]) -> tuple[Thing, ...]:
    """Things by editor number at these places, map units."""
    return tuple(Thing(number, x, y) for number, spots in places.items() for x, y in spots)


def starts_at(places: Iterable[tuple[float, float]], first_tid: int) -> tuple[Thing, ...]:
    """Places for the agent to start at, map units; their tids are consecutive."""
    return tuple(Thing(MAP_SPOT, x, y, tid) for tid, (x, y) in enumerate(places, first_tid))


def definition(head: str, *properties: str, spawn: str) -> str:
    """A DECORATE class that looks the same all its life.

    Args:
        head: its name, and ` : ` with the class that it is made of, if there is one.
        properties: a line each.
        spawn: its sprites, and what comes after the last one.
    """
    lines = "".join(f"  {line}\n" for line in properties)
    return f"ACTOR {head}\n{{\n{lines}  States\n  {{\n  Spawn:\n    {spawn}\n  }}\n}}\n"


ACS_APART = """\
function int Apart(int a, int b)
{
    if (a > b)
        return a - b;
    return b - a;
}
"""
"""ACS: how far apart two coordinates are"""
ACS_NEAR = """\
// A coordinate near that of one of the map's places.
function int Near(int coordinate)
{
    return coordinate + Random(0.0 - $scatter, $scatter);
}
"""
"""ACS: a random place near a spot; `scatter` is a parameter of the script"""
