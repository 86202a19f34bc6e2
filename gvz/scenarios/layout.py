"""Layouts: the geometry of a drawn map, and the rooms and pillars that scenarios draw.

A layout is one sector. Its walls are lines that are open on their right. Loads no numpy: scenarios import it, and a
help text names them.
"""

import itertools
import math
import random
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from gvz.wad.udmf import Block, UdmfMap, make_thing

if TYPE_CHECKING:
    from gvz.scenarios.floor import Floor

Place = tuple[float, float]
"""map units"""
Segment = tuple[Place, Place]
Box = tuple[int, int, int, int]
"""x and y of the south-western corner, then of the north-eastern one, tiles"""

MAP_SPOT = 9001
"""editor number of a place that scripts find by its tid"""
FIRST_SPOT, FIRST_PLACE = 10, 100
"""tids of the first start, and of the first place where enemies or kits appear; the others follow"""
NUM_PLACES = 64
"""places where enemies or kits appear in a map of rooms"""
TILE = 64
"""map units; rooms and corridors are made of tiles"""
FLOOR_UNIT = 8
"""map units that a pixel of a Floor is wide"""
WAY = 96
"""least gap between pillars, and between a pillar and a wall: the agent is 32 wide, enemies at most 60"""
_TRIES = 20


@dataclass(frozen=True, kw_only=True, slots=True)
class Layout:
    """The geometry of a map, and the parameters of the scenario's script that go with it."""

    walls: tuple[Segment, ...]
    """each open on its right, seen from its first end"""
    barriers: tuple[Segment, ...] = ()
    """lines that only missiles cross"""
    starts: tuple[Place, ...]
    """where the agent may start. If there are several, each is a map spot, tids from FIRST_SPOT"""
    height: int
    """of the ceiling"""
    parameters: Mapping[str, int | float | tuple[float, ...]] = field(default_factory=dict)
    places: tuple[Place, ...] = ()
    """where enemies or kits appear; all must be in reach of the starts"""
    marked: bool = False
    """whether the script finds the places as map spots, tids from FIRST_PLACE"""
    radius: float = 16.0
    """of who must reach them"""
    keep_clear: Callable[[float, float], bool] | None = None
    """as that of Variety, for this layout"""

    def build(self, base: UdmfMap) -> UdmfMap:
        """The map: walls, one sector like the first of the base map, and the starts."""
        room = UdmfMap(base.namespace, sectors=[{**base.sectors[0], "heightceiling": self.height}])
        numbers: dict[Place, int] = {}
        for ends, is_wall in [(s, True) for s in self.walls] + [(s, False) for s in self.barriers]:
            v1, v2 = (numbers.setdefault(end, len(numbers)) for end in ends)
            line: Block = {"v1": v1, "v2": v2, "sidefront": len(room.sidedefs), "blocking": True}
            room.sidedefs.append({"sector": 0, "texturemiddle": "-"} if is_wall else {"sector": 0})
            if not is_wall:
                line |= {"sideback": len(room.sidedefs), "twosided": True}
                room.sidedefs.append({"sector": 0})
            room.linedefs.append(line)
        room.vertices = [{"x": float(x), "y": float(y)} for x, y in numbers]
        room.things.append(make_thing(1, *self.starts[0]))
        if len(self.starts) > 1:
            room.things += [make_thing(MAP_SPOT, x, y, tid=tid) for tid, (x, y) in enumerate(self.starts, FIRST_SPOT)]
        if self.marked:
            room.things += [make_thing(MAP_SPOT, x, y, tid=tid) for tid, (x, y) in enumerate(self.places, FIRST_PLACE)]
        return room

    @property
    def clearance(self) -> float:
        """Least distance to walls, on a Floor, of places that can be reached: a place is known to a pixel."""
        return self.radius + FLOOR_UNIT

    def problem(self, floor: "Floor") -> str | None:
        """Why a map of this layout cannot be played; None if it can."""
        reached = floor.reached(self.starts[0], self.clearance)
        for name, places in (("start", self.starts), ("place", self.places)):
            for place in places:
                if floor.to_wall[floor.pixel(*place)] < self.clearance:
                    return f"the {name} {place} is in a wall"
                if not reached[floor.pixel(*place)]:
                    return f"the {name} {place} is out of reach of the start {self.starts[0]}"
        return None


# --------------------------------------------------------------------------------------------------- what layouts draw


def vary(rng: random.Random, strength: float, default: float, low: float, high: float) -> float:
    """A uniform draw of a range that lies round a default value and grows with the strength; 1 gives all of it."""
    return rng.uniform(default + strength * (low - default), default + strength * (high - default))


def ring(corners: Sequence[Place], *, solid: bool = False) -> tuple[Segment, ...]:
    """The walls round a room whose corners are given clockwise, or with `solid` round a pillar."""
    ends = [(round(x), round(y)) for x, y in (reversed(corners) if solid else corners)]
    return tuple(zip(ends, ends[1:] + ends[:1], strict=True))


def draw_pillar(rng: random.Random, middle: Place, radius: float) -> tuple[Segment, ...]:
    """The walls of a regular pillar with 3 to 8 corners."""
    num_corners, turn = rng.choice((3, 4, 4, 6, 8)), rng.random()
    angles = [2 * math.pi * (turn - n / num_corners) for n in range(num_corners)]
    x, y = middle
    return ring([(x + radius * math.cos(a), y + radius * math.sin(a)) for a in angles], solid=True)


@dataclass(frozen=True, kw_only=True, slots=True)
class Rooms:
    """Rooms and corridors in tiles, (x1, y1, x2, y2) each. All are connected."""

    size: int
    """tiles of the map's side"""
    rooms: tuple[Box, ...]
    corridors: tuple[Box, ...]

    def walls(self) -> tuple[Segment, ...]:
        """The edge of the tiles that belong to a room or corridor."""
        tiles = {
            (x, y) for x1, y1, x2, y2 in (*self.rooms, *self.corridors) for x in range(x1, x2) for y in range(y1, y2)
        }
        found = []
        for dx, dy in ((-1, 0), (1, 0), (0, -1), (0, 1)):  # from a tile to rock
            edges = {(x, y) for x, y in tiles if (x + dx, y + dy) not in tiles}
            along_x, along_y = abs(dy), abs(dx)
            for x, y in sorted(edges):
                if (x - along_x, y - along_y) in edges:
                    continue  # of a wall that began before
                length = next(n for n in itertools.count(1) if (x + n * along_x, y + n * along_y) not in edges)
                low = ((x + (dx > 0)) * TILE, (y + (dy > 0)) * TILE)
                high = (low[0] + along_x * length * TILE, low[1] + along_y * length * TILE)
                found.append((low, high) if dx < 0 or dy > 0 else (high, low))
        return tuple(found)


def draw_rooms(
    rng: random.Random, *, size: int, across: int, shrink: float, loops: float, corridor: tuple[int, int]
) -> Rooms:
    """Draws a room in each cell of a square grid, and corridors along a spanning tree and to more neighbours.

    Args:
        rng: what draws.
        size: tiles of the map's side.
        across: cells of a side.
        shrink: 0: rooms fill their cells; up to 1: each side of a room is cut by up to this part of what it may lose.
        loops: probability of a corridor between neighbours that the tree does not join.
        corridor: least and most width, tiles.
    """
    cuts = [round(n * size / across) for n in range(across + 1)]
    rooms: dict[tuple[int, int], Box] = {}
    for column in range(across):
        for row in range(across):
            spans = []
            for cell in (column, row):
                low, high = cuts[cell], cuts[cell + 1] - (cell < across - 1)  # a tile of rock before the next cell
                length = high - low - round(rng.random() * shrink * (high - low - 3))
                low += rng.randint(0, high - low - length)
                spans.append((low, low + length))
            rooms[column, row] = (spans[0][0], spans[1][0], spans[0][1], spans[1][1])
    cells = list(rooms)
    reached, pairs = {rng.choice(cells)}, []
    while len(reached) < len(cells):  # a random spanning tree
        edges = [(a, b) for a in cells if a in reached for b in _neighbours(a) if b in rooms and b not in reached]
        pairs.append(edge := rng.choice(edges))
        reached.add(edge[1])
    joined = {frozenset(pair) for pair in pairs}
    later = [(a, b) for a in cells for b in _neighbours(a)[:2] if b in rooms and frozenset((a, b)) not in joined]
    pairs += [pair for pair in later if rng.random() < loops]
    corridors = [box for a, b in pairs for box in _corridor(rng, rooms[a], rooms[b], a[0] == b[0], corridor)]
    return Rooms(size=size, rooms=tuple(rooms.values()), corridors=tuple(corridors))


def furnished(
    rng: random.Random,
    strength: float,
    rooms: Rooms,
    *,
    most_pillars: int,
    pillar_width: tuple[float, float],
    num_starts: int,
) -> Layout:
    """The layout of rooms with pillars in them, at most so many, and with starts and places marked for the script."""
    pillars = draw_pillars(rng, rooms, round(most_pillars * strength), pillar_width)
    starts, places = draw_places(rng, rooms, pillars, num_starts)
    return Layout(
        walls=rooms.walls() + sum((draw_pillar(rng, *one) for one in pillars), ()),
        starts=starts,
        height=round(vary(rng, strength, 104, 96, 240)),
        parameters={"num_places": len(places), "last_spot": FIRST_SPOT - 1 + len(starts)},
        places=places,
        marked=True,
    )


def _neighbours(cell: tuple[int, int]) -> list[tuple[int, int]]:
    x, y = cell
    return [(x + 1, y), (x, y + 1), (x - 1, y), (x, y - 1)]


def _corridor(rng: random.Random, one: Box, other: Box, vertical: bool, widths: tuple[int, int]) -> list[Box]:
    """A straight or bent way between neighbours in a row, or with `vertical` in a column."""
    if vertical:
        turned = _corridor(rng, _turned(one), _turned(other), False, widths)
        return [_turned(box) for box in turned]
    if one[0] > other[0]:
        one, other = other, one
    width = rng.randint(*widths)
    first = rng.randint(one[1], one[3] - width)
    last = rng.randint(other[1], other[3] - width)
    if rng.random() < 0.5 or abs(first - last) < width:  # straight, if the rooms lie so
        low, high = max(one[1], other[1]), min(one[3], other[3]) - width
        if low <= high:
            first = last = rng.randint(low, high)
    west, east = one[2], other[0]
    if first == last:
        return [(west, first, east, first + width)]
    if east - west < width:  # no room for a bend: it begins inside the rooms
        west, east = west - width, east + width
    bend = rng.randint(west, east - width)
    low, high = min(first, last), max(first, last) + width
    return [
        (west, first, bend + width, first + width),
        (bend, low, bend + width, high),
        (bend, last, east, last + width),
    ]


def _turned(box: Box) -> Box:
    return box[1], box[0], box[3], box[2]


def draw_pillars(
    rng: random.Random, rooms: Rooms, most: int, width: tuple[float, float]
) -> tuple[tuple[Place, float], ...]:
    """(Middle, radius) of at most so many pillars in rooms; a way is left round each of them."""
    taken: list[tuple[Place, float]] = []
    for _ in range(rng.randint(0, most)):
        for _ in range(_TRIES):
            x1, y1, x2, y2 = (TILE * edge for edge in rng.choice(rooms.rooms))
            radius = rng.uniform(*width) / 2
            gap = radius + WAY
            if min(x2 - x1, y2 - y1) > 2 * gap:
                place = rng.uniform(x1 + gap, x2 - gap), rng.uniform(y1 + gap, y2 - gap)
                if all(math.dist(place, other) >= gap + other_radius for other, other_radius in taken):
                    taken.append((place, radius))
                    break
    return tuple(taken)


def draw_places(
    rng: random.Random, rooms: Rooms, pillars: tuple[tuple[Place, float], ...], num_starts: int
) -> tuple[tuple[Place, ...], tuple[Place, ...]]:
    """(Starts, the NUM_PLACES others): middles of tiles in rooms, none next to a pillar; starts off walls first."""
    tiles = {(x, y) for x1, y1, x2, y2 in rooms.rooms for x in range(x1, x2) for y in range(y1, y2)}
    shuffled = rng.sample(sorted(tiles), len(tiles))

    def inner(tile: tuple[int, int]) -> bool:
        return {(tile[0] + dx, tile[1] + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)} <= tiles

    def free(tile: tuple[int, int]) -> bool:
        return all(math.dist(_middle(*tile), place) >= radius + 40 for place, radius in pillars)

    first = itertools.chain(filter(inner, shuffled), itertools.filterfalse(inner, shuffled))
    starts = list(itertools.islice(filter(free, first), num_starts))
    taken = set(starts)
    others = list(itertools.islice((tile for tile in shuffled if tile not in taken and free(tile)), NUM_PLACES))
    places = itertools.islice(itertools.cycle(others), NUM_PLACES)
    return tuple(itertools.starmap(_middle, starts)), tuple(itertools.starmap(_middle, places))


def _middle(x: int, y: int) -> Place:
    return TILE * (x + 0.5), TILE * (y + 0.5)
