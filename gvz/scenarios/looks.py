"""What drawn maps look like: textures, decorations, light, enemies or kits.

Each part has a strength (gvz.scenarios.map_set): 0 leaves it as in the default task. With strength 1, which `varied`
has, choices are uniform unless said otherwise:

- Walls: 1 (half of the maps), 2 or 3 textures; each side of a wall has one of them. Of WALLS, a quarter of FLATS.
- Floor, ceiling: one texture each, of FLATS, a quarter of WALLS.
- Size of the textures: as they are (two thirds of the maps) or double, for walls and for floor and ceiling.
- Light: a level of LIGHT, out of Doom's 0 to 255; half of the maps tinge it, by three channels of TINGE.
- Decorations: 0 to the scenario's most, each of 1 to 4 kinds of this map, of SOLID and LOOSE, at any place of the map
  that is not too near to a wall, a start, an enemy's place or another decoration.
- Entities (enemies or kits): half of the maps change their size, by one factor of SCALE for width and height; half give
  each class one of TINTS. Of 5 maps one draws them see-through, alpha of ALPHA, and one as a silhouette in one of
  SILHOUETTES.

A strength in between takes this share of every pool, moves every number this share of its way from the default, and
multiplies the probabilities of changed entities. Double textures and tinged light keep theirs. HELD_OUT keeps a fifth
of what is in the pools for `procedural-test` and a tenth for `procedural-validation`; `procedural-train` has the rest,
and `varied`, whose test is the named tasks, all.

Nothing of the look of any named task, for training or testing, in either profile, is in a pool: no texture or near copy
of one, no kind of decoration, no render style. The test list draws sizes from 0.3 to 3, for width and height apart and
for each enemy; here proportions stay, and a map has one size. Left out besides are textures with holes, of the sky,
that move, with writing, and those that are very dark, bright or restless.
"""

import math
import random
import re
from collections.abc import Collection, Iterable, Sequence
from functools import cache, lru_cache
from typing import TypeVar

import numpy as np

from gvz.scenarios.base import Content, Scenario, Value, Variety, words
from gvz.scenarios.floor import Floor
from gvz.scenarios.layout import Layout
from gvz.scenarios.map_set import VARIED, MapSet
from gvz.wad.udmf import NO_REFERENCE, UdmfMap, make_thing

WALLS = words(
    """
    A-ASKIN3 A-ASKIN4 A-ASKIN5 A-BRBK28 A-BRBRK A-BRICK1 A-BRICK2 A-BROCK2 A-BROK28 A-BROWN1 A-BROWN2 A-BROWN4
    A-DBRI1 A-DBRI18 A-DBRI2 A-DROCK1 A-DROCK2 A-MARBLE A-MOSRK2 A-MOULD A-MUD A-MYWOOD A-TILE A-VINE3 A-WOOD1
    AQBRIK01 AQBRIK02 AQBRIK03 AQCOMP01 AQCONC03 AQCONC04 AQCONC05 AQCONC06 AQCONC07 AQCONC09 AQCONC10 AQCONC12
    AQCONC18 AQLITE04 AQMETL03 AQMETL04 AQMETL06 AQMETL07 AQMETL13 AQMETL14 AQMETL32 AQPANL01 AQPANL02 AQPANL03
    AQPANL05 AQPANL08 AQPIPE01 AQPIPE02 AQPIPE03 AQPIPE04 AQPIPE05 AQPIPE06 AQPIPE07 AQPIPE08 AQPIPE09 AQPIPE10
    AQPIPE11 AQPIPE12 AQPIPE13 AQPIPE14 AQRUST02 AQRUST03 AQRUST04 AQRUST05 AQRUST06 AQRUST09 AQSUPP02 AQSUPP09
    AQSUPP12 AQTILE01 AQTILE02 AQTILE03 AQTRIM04 AQTRIM05 AQTRIM08 AROCK2 ASHWALL ASHWALL6 ASPHALT BASE BIGBRIK2
    BIGBRIK3 BIGDOOR2 BIGDOOR3 BIGDOOR4 BIGDOOR5 BIGDOOR6 BIGMURAL BIGWALL BRICK10 BRICK11 BRICK2 BRICK3 BRICK6
    BRICK8 BRICK9 BRONZE1 BROVINE BROVINE2 BROWN1 BROWN144 BROWNGRN BROWNPIP BSTONE2 CARLLF1 CARLLF2 CARLRT1 CARLRT2
    CAVERN7 CEMENT3 CEMENT6 CEMENT7 COMP2 COMPTALL COMPUTE1 COMPUTE3 COMPWERA COMPWERC CR128HGB CR128LB CR128LG
    CR64HBB CR64HBG CR64HGG CR64SLGB CRLWDH6 CRLWDL12 CRLWDL6B CRLWDVS CRSMB CRTINYB CRWDH64 CRWDT32 DOGLDIR DOGRMSC
    DOKGRIR DOKODO1B DOKODO2B DOOR1 DOORHI DOPUNK4 DRTOPFR ESPIBR1 ESPIBR2 ESPIG1 ESPIG2 ESPIG3 ESPIGR1 ESPIGR2
    ESPITAN1 ESPITAN2 ESPITAN3 GRAY10 GRAY2 GRAY4 GRAY6 GRAYBIG GRAYRED GRAYTAN0 GRAYTAN5 GRAYWARN LONGWALL MARBGRAY
    MARBLE1 MARBLE2 MC10 METAL1 METAL2 MOD1 MOD2 MOD3 MOD4 MOD5 MODWALL1 MURAL1 MURAL2 PANCASE1 PANEL1 PANEL2 PANEL5
    PANEL6 PANEL8 PIPE2 PIPE3 PIPES PIPEWAL1 PIPEWAL2 REDWALL ROCK1 ROCK4 ROCK5 SHAWN2 SILVER1 SILVER3 SKIN2
    SKINEDGE SKINFACE SKINLOW SKINMET1 SKINMET2 SKINTEK1 SKSNAKE2 SKSPINE1 SKSPINE2 SLADWALL SMSTONE6 SPACEW2
    SPACEW4 SPCDOOR0 SPCDOOR1 SPCDOOR2 SPCDOOR4 STARBR1 STARBR2 STARG1 STARG2 STARG3 STARG4 STARGR1 STARGR2 STARTAN1
    STARTAN2 STARTAN3 STONE4 STONE5 STONE6 STONE7 STONEW1 STUCCO2 SUPPORT2 TEKBRON1 TEKBRON2 TEKGREN1 TEKGREN2
    TEKGREN3 TEKGREN4 TEKLITE TEKLITE2 TEKWALL2 TEKWALL4 TEKWALL5 TEKWALL6 WOOD1 WOOD3 WOOD4 WOOD5 WOOD6 WOODMET1
    ZIMMER3 ZIMMER5 ZIMMER7 ZIMMER8
    """
)
"""wall textures"""

FLATS = words(
    """
    AQF001 AQF002 AQF003 AQF004 AQF008 AQF009 AQF013 AQF016 AQF017 AQF019 AQF020 AQF021 AQF022 AQF023 AQF024 AQF026
    AQF027 AQF028 AQF029 AQF030 AQF034 AQF045 AQF046 AQF047 AQF048 AQF049 AQF050 AQF053 AQF055 AQF056 AQF057 AQF067
    AQF068 AQF069 AQF070 AQF072 AQF074 AQF075 AQF076 CEIL3_1 CEIL3_2 CEIL3_6 CEIL5_3 DEM1_5 DEM1_6 FCGRATE2 FLAT1
    FLAT10 FLAT1_1 FLAT1_2 FLAT1_3 FLAT20 FLAT23 FLAT3 FLAT4 FLAT5 FLAT5_1 FLAT5_2 FLAT5_3 FLAT8 FLAT9 FLOOR3_3
    FLOOR4_1 FLOOR4_5 FLOOR4_8 FLOOR5_1 FLOOR5_2 FLOOR5_4 FLOOR6_2 GRNROCK MFLR8_1 MFLR8_3 MFLR8_4 RROCK10 RROCK11
    RROCK12 RROCK14 RROCK16 RROCK17 RROCK18 RROCK19 RROCK20 SFLR6_4 STEP1 STEP2
    """
)
"""floor and ceiling textures"""

SOLID = {
    35: "Candelabra",
    41: "EvilEye",
    43: "TorchTree",
    47: "Stalagtite",
    48: "TechPillar",
    49: "BloodyTwitch",
    51: "Meat3",
    52: "Meat4",
    53: "Meat5",
    54: "BigTree",
    70: "BurningBarrel",
    73: "HangNoGuts",
    76: "HangTSkull",
    85: "TechLamp",
    86: "TechLamp2",
    2028: "Column",
    5050: "Stalagmite",
}
"""decorations that stop steps and shots: editor number -> actor class"""
LOOSE = (24, 34, 59, 60, 79, 80, 81)
"""editor numbers of those that do not: a candle, remains"""
_PASSABLE = 19000
"""added to an editor number: the class of the same looks that is not solid"""

LIGHT = (192, 255)
TINGE = (144, 255)
SCALE = (0.8, 1.25)
ALPHA = (0.7, 0.9)
TINTS = (
    *((1.7, 0.4, 0.4), (0.4, 1.7, 0.4), (0.5, 0.7, 2.0), (1.7, 1.6, 0.4), (1.7, 0.5, 1.7), (0.4, 1.6, 1.7)),
    *((1.8, 1.0, 0.3), (1.7, 1.7, 1.7), (1.0, 0.5, 1.9), (1.9, 1.2, 1.3), (0.8, 1.6, 1.0), (1.4, 1.0, 0.7)),
)
"""red, green and blue that white becomes; black stays black, and all is of this colour between"""
SILHOUETTES = (0xFF5050, 0x50FF50, 0x6090FF, 0xFFFF50, 0xFF50FF, 0x50FFFF, 0xFFFFFF, 0xFFA030)
STYLES = ("STYLE_Translucent", "STYLE_Stencil")
"""render styles; most maps keep the normal one"""

HELD_OUT = {
    "test": frozenset(
        words(
            """
            A-ASKIN5 A-BROCK2 A-BROK28 A-DBRI1 A-TILE AQBRIK01 AQCONC05 AQCONC12 AQPIPE06 AQPIPE07 AQPIPE10 AQPIPE14
            AQTRIM08 CARLRT1 CEMENT3 CEMENT7 COMPUTE3 CR128HGB CR128LB CR128LG CR64HBB CR64SLGB CRLWDVS CRSMB DOKGRIR
            ESPIBR2 ESPITAN3 GRAY2 GRAYBIG GRAYRED GRAYTAN0 GRAYTAN5 GRAYWARN MOD1 MOD2 MOD3 MOD5 PANEL2 PIPES PIPEWAL1
            ROCK1 SILVER3 SKINFACE SKINMET2 SKINTEK1 SKSPINE2 SPACEW4 STARG1 STARG3 STARG4 STONE5 TEKWALL2 TEKWALL6
            ZIMMER7
            AQF020 AQF022 AQF045 AQF055 AQF057 AQF068 AQF075 DEM1_6 FLAT1_3 FLOOR4_5 FLOOR5_2 MFLR8_1 MFLR8_3 RROCK11
            RROCK16
            """
        )
    )
    | {24, 41, 43, 54, 70}
    | {TINTS[4], TINTS[5], TINTS[10]}
    | {SILHOUETTES[5], SILHOUETTES[7]},
    "validation": frozenset(
        words(
            """
            A-ASKIN3 A-DBRI18 A-DBRI2 AQCONC03 AQMETL32 BIGDOOR2 BIGDOOR3 BIGDOOR4 BRICK3 BROVINE BROWNPIP DOORHI
            MARBGRAY PIPEWAL2 SKINEDGE SKINLOW SKINMET1 STARBR1 STARBR2 STARG2 STARTAN1 WOOD4
            AQF001 AQF008 AQF009 AQF013 AQF034 AQF076 CEIL3_2 FLAT20 FLAT5_2 FLAT9 FLOOR3_3 FLOOR4_1 SFLR6_4
            """
        )
    )
    | {34, 48, 76}
    | {TINTS[8]}
    | {SILHOUETTES[4]},
}
"""split -> the textures, decorations, tints and silhouettes that no other split of procedural maps has. A texture
differs from those of other splits by at least 8 of 255, on average of two 16x16 thumbnails"""

_GRID = 16
"""places of decorations lie on a grid of this many map units, moved by up to half of it"""
_START_GAP, _GAP, _PLACE_GAP = 128, 112, 64
"""least distance of a decoration from a start of the agent, from the next decoration, and from a drawn layout's places
of enemies or kits"""
_SOLID_WALL_GAP, _WALL_GAP = 80, 40
"""least distance from a wall: behind what is solid there is a way 64 units wide"""
_SOLID_RADIUS = 32
"""largest of SOLID, map units"""
_TRIES = 20
"""places that are tried for one decoration"""

T = TypeVar("T")


@cache
def pool(members: tuple[T, ...], split: str, strength: float) -> tuple[T, ...]:
    """Those of a pool that a split may have, and of them this share, at least one, the same for all maps."""
    if split != VARIED:
        others = frozenset[object]().union(*(held for name, held in HELD_OUT.items() if name != split))
        own = HELD_OUT.get(split)
        members = tuple(one for one in members if (one not in others if own is None else one in own))
    order = sorted(range(len(members)), key=lambda n: random.Random(f"{members[n]}").random())
    chosen = set(order[: math.ceil(strength * len(members))])
    return tuple(one for n, one in enumerate(members) if n in chosen)


def drawn_from(scenario: Scenario, maps: MapSet, number: int, part: str) -> random.Random:
    """What draws a part of a map: parts are apart, so that a change of one leaves the others as they were."""
    stem = scenario.id if maps.split == VARIED else f"procedural/{scenario.id}"
    return random.Random(f"{stem}/{number}/{part}")


def draw_look(
    scenario: Scenario,
    content: Content,
    room: UdmfMap,
    maps: MapSet,
    number: int,
    given: Collection[str] = (),
    layout: Layout | None = None,
    floor: Floor | None = None,
) -> Content:
    """Gives a map another look.

    Args:
        scenario: whose map it is; it has a variety.
        content: of the default task, perhaps with attributes.
        room: its map; changed in place, before the content's things are added.
        maps: the set with the map.
        number: of the map.
        given: properties of entities that are not drawn: an attribute sets them, or keeps them as they are.
        layout: of the map, if it has one of its own.
        floor: of this layout.

    Returns:
        The content with other looks of enemies or kits.
    """
    variety = scenario.variety
    assert variety is not None, "checked where the task was made"
    rngs = (drawn_from(scenario, maps, number, part) for part in ("surfaces", "light", "decorations", "entities"))
    surfaces, light, decorations, entities = rngs
    if strength := maps.strength("textures"):
        _draw_surfaces(surfaces, room, *(pool(names, maps.split, strength) for names in (WALLS, FLATS)))
    if strength := maps.strength("lights"):
        _draw_light(light, room, strength)
    if strength := maps.strength("decorations"):
        starts = [(t.x, t.y) for t in content.things.get(content.base_wad or "", ())]
        kinds = pool((*SOLID, *LOOSE), maps.split, strength)
        most = round(strength * variety.max_decorations)
        _draw_decorations(decorations, variety, room, starts, kinds, most, layout, floor)
    return _draw_entities(entities, variety, content, maps, given)


def _draw_surfaces(rng: random.Random, room: UdmfMap, wall_pool: Sequence[str], flat_pool: Sequence[str]) -> None:
    walls = [_texture(rng, wall_pool, flat_pool) for _ in range(rng.choice((1, 1, 2, 3)))]
    floor, ceiling = _texture(rng, flat_pool, wall_pool), _texture(rng, flat_pool, wall_pool)
    wall_size, plane_size = (rng.choice((1.0, 1.0, 2.0)) for _ in range(2))
    for side in room.sidedefs:
        if "texturemiddle" in side:
            side["texturemiddle"] = rng.choice(walls)
            side["scalex_mid"] = side["scaley_mid"] = 1 / wall_size
    for sector in room.sectors:
        sector["texturefloor"], sector["textureceiling"] = floor, ceiling
        for name in ("xscalefloor", "yscalefloor", "xscaleceiling", "yscaleceiling"):
            sector[name] = 1 / plane_size


def _texture(rng: random.Random, usual: Sequence[str], other: Sequence[str]) -> str:
    return rng.choice(other if rng.random() < 0.25 else usual)


def _draw_light(rng: random.Random, room: UdmfMap, strength: float) -> None:
    level, colour = rng.randint(*LIGHT), 0xFFFFFF
    if rng.random() < 0.5:
        red, green, blue = (round(255 + strength * (rng.randint(*TINGE) - 255)) for _ in range(3))
        colour = red << 16 | green << 8 | blue
    for sector in room.sectors:
        default = int(sector["lightlevel"])
        sector["lightlevel"], sector["lightcolor"] = round(default + strength * (level - default)), colour


def _draw_decorations(
    rng: random.Random,
    variety: Variety,
    room: UdmfMap,
    starts: Iterable[tuple[float, float]],
    pool: Sequence[int],
    most: int,
    layout: Layout | None,
    floor: Floor | None,
) -> None:
    """Adds decorations; those for which no place is found are left out.

    Args:
        rng: what draws.
        variety: of the scenario.
        room: the map with its own things.
        starts: places of the agent that the content adds.
        pool: kinds of decorations.
        most: decorations of the map.
        layout: of the map, if it has one of its own.
        floor: of this layout.
    """
    if layout is None or floor is None:
        starts = [*starts, *((float(thing["x"]), float(thing["y"])) for thing in room.things)]
        places, keep_clear, others = open_places(*_walls(room)), variety.keep_clear, ()
    else:
        starts, others = layout.starts, layout.places
        places, keep_clear = floor.places(starts[0], layout.clearance), layout.keep_clear
    kinds = [rng.choice(pool) for _ in range(rng.randint(1, 4))]
    taken: list[tuple[float, float]] = []
    for _ in range(rng.randint(0, most)):
        kind = rng.choice(kinds)
        wall_gap = _SOLID_WALL_GAP if variety.solid and kind in SOLID else _WALL_GAP
        for _ in range(_TRIES):
            x, y, to_wall = rng.choice(places)
            x, y = (round(v + rng.uniform(-_GRID / 2, _GRID / 2)) for v in (x, y))
            if (
                to_wall >= wall_gap + _GRID  # as far as it may have been moved, and more
                and all(math.dist((x, y), place) >= _START_GAP for place in starts)
                and all(math.dist((x, y), place) >= _GAP for place in taken)
                and all(math.dist((x, y), place) >= _PLACE_GAP for place in others)
                and not (keep_clear is not None and keep_clear(x, y))
            ):
                taken.append((x, y))
                number = kind if variety.solid or kind in LOOSE else _PASSABLE + kind
                room.things.append(make_thing(number, x, y, angle=rng.randrange(0, 360, 45)))
                break


def solid_places(room: UdmfMap) -> list[tuple[tuple[float, float], float]]:
    """(Place, radius) of a map's solid decorations, with the largest radius of one."""
    return [((float(t["x"]), float(t["y"])), _SOLID_RADIUS) for t in room.things if t["type"] in SOLID]


Corner = tuple[float, float]


def _walls(room: UdmfMap) -> tuple[tuple[tuple[Corner, Corner], ...], tuple[bool, ...]]:
    """(Both ends of each line, whether the map ends there)."""
    corners = [(float(vertex["x"]), float(vertex["y"])) for vertex in room.vertices]
    ends = tuple((corners[int(line["v1"])], corners[int(line["v2"])]) for line in room.linedefs)
    return ends, tuple(line.get("sideback", NO_REFERENCE) == NO_REFERENCE for line in room.linedefs)


@lru_cache(maxsize=8)
def open_places(
    lines: tuple[tuple[Corner, Corner], ...], one_sided: tuple[bool, ...]
) -> tuple[tuple[float, float, float], ...]:
    """(x, y, distance to the next line) of the places of a grid that are inside a map, map units.

    Args:
        lines: both ends of each line of the map.
        one_sided: whether the map ends at a line.
    """
    corners = np.array(lines).reshape(-1, 2)
    axes = (np.arange(low, high, _GRID) for low, high in zip(corners.min(axis=0), corners.max(axis=0), strict=True))
    x, y = (axis.ravel() for axis in np.meshgrid(*axes))
    inside, distance = np.zeros(x.shape, bool), np.full(x.shape, np.inf)
    for ((x1, y1), (x2, y2)), is_end in zip(lines, one_sided, strict=True):
        along = ((x - x1) * (x2 - x1) + (y - y1) * (y2 - y1)) / ((x2 - x1) ** 2 + (y2 - y1) ** 2)
        along = along.clip(0, 1)
        distance = np.minimum(distance, np.hypot(x - x1 - along * (x2 - x1), y - y1 - along * (y2 - y1)))
        if is_end and y1 != y2:  # a ray eastwards from a place inside crosses an odd number of them
            inside ^= ((y1 > y) != (y2 > y)) & (x < x1 + (y - y1) / (y2 - y1) * (x2 - x1))
    return tuple(zip(x[inside].tolist(), y[inside].tolist(), distance[inside].tolist(), strict=True))


def _draw_entities(
    rng: random.Random, variety: Variety, content: Content, maps: MapSet, given: Collection[str]
) -> Content:
    """The content with other looks of enemies or kits, and with all classes that some map of the set needs."""
    strength = maps.strength("entities")
    entity: dict[str, Value] = {}
    if rng.random() < 0.5 * strength:
        scale = 1 + strength * (rng.uniform(*SCALE) - 1)
        sizes = (name for name in ("ScaleX", "ScaleY") if name not in given)
        entity |= {name: scale * _number(content.entity.get(name, 1.0)) for name in sizes}
    style = rng.choice((*STYLES, None, None, None))
    if strength < 1 and rng.random() >= strength:
        style = None
    if "RenderStyle" in given:
        style = None
    if style == "STYLE_Translucent":
        entity |= {"RenderStyle": style, "Alpha": 1 + strength * (rng.uniform(*ALPHA) - 1)}
    elif style == "STYLE_Stencil":
        entity |= {"RenderStyle": style, "StencilColor": rng.choice(pool(SILHOUETTES, maps.split, strength))}
    names = {name: name for name in variety.entities}
    if rng.random() < 0.5 * strength and "Translation" not in given:
        tints = pool(TINTS, maps.split, strength)
        names = {name: _tinted(name, TINTS.index(rng.choice(tints))) for name in variety.entities}
    parameters = {name: _renamed(content.parameters[name], names) for name in variety.entity_parameters}
    actors = {
        _tinted(name, tint): f"ACTOR {_tinted(name, tint)} : {name}\n{{\n"
        f'  Translation "0:255=%[0.0,0.0,0.0]:[{red},{green},{blue}]"\n}}\n'
        for name in variety.entities
        for tint, (red, green, blue) in enumerate(TINTS)
    }
    if not variety.solid:
        actors |= {
            f"Passable{name}": f"ACTOR Passable{name} : {name} {_PASSABLE + kind}\n{{\n  -SOLID\n}}\n"
            for kind, name in SOLID.items()
        }
    return content.overlaid(Content(entity=entity, parameters=parameters, actors=actors))


def _number(value: Value) -> float:
    assert isinstance(value, int | float), "the default task's sizes are fixed"
    return float(value)


def _tinted(name: str, tint: int) -> str:
    return f"{name}Tint{tint}"


def _renamed(value: Value, names: dict[str, str]) -> Value:
    """A parameter that names classes, with other ones."""
    if isinstance(value, tuple):
        return tuple(names.get(str(name), name) for name in value)
    return re.sub(r"\w+", lambda match: names.get(match[0], match[0]), str(value))
