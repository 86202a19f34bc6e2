"""Procedural maps: layouts that can be played, pools that are held out, strengths, the same map everywhere."""

import itertools
import random
from collections import deque
from contextlib import closing
from math import hypot

import numpy as np
import pytest

from gvz.core.env_config import EnvConfig
from gvz.core.errors import TaskError
from gvz.env import DoomEnv
from gvz.evaluation.play import episode_seed, play_episode
from gvz.evaluation.players import ScriptedPlayer
from gvz.evaluation.simple import player_env
from gvz.scenarios import layout, looks
from gvz.scenarios.base import Content, Scenario, Task
from gvz.scenarios.compiler import compile_task, map_source, task_content
from gvz.scenarios.floor import Floor
from gvz.scenarios.layout import FIRST_PLACE, NUM_PLACES, Layout, Rooms, ring
from gvz.scenarios.looks import FLATS, LOOSE, SILHOUETTES, SOLID, TINTS, WALLS
from gvz.scenarios.map_set import NUMBERS, PARTS, MapSet
from gvz.tasks import all_scenarios, parse_task, scenarios
from gvz.wad.acs import compile_acs
from gvz.wad.decorate import declared_actors
from gvz.wad.lumps import read_maps, read_wad
from gvz.wad.udmf import NO_REFERENCE, UdmfMap, is_inside, parse_textmap
from tests.scenarios.conftest import bad_lines
from tests.scenarios.pictures import thumbnail

SCENARIOS = [one for one in scenarios().values() if one.variety is not None]
TRAIN = MapSet("train")
FIRST = NUMBERS["train"][0]
SPLITS = ("train", "validation", "test")
LEAST_DIFFERENCE = 8.0
"""of two 16x16 thumbnails, 0 to 255, on average"""


def drawn(scenario: Scenario, number: int, strength: float = 1.0) -> Layout:
    assert scenario.variety is not None
    return scenario.variety.draw_layout(looks.drawn_from(scenario, TRAIN, number, "layout"), strength)


def whole_map(scenario: Scenario, number: int, maps: MapSet = TRAIN) -> UdmfMap:
    return parse_textmap(map_source(Task(scenario, maps=maps), "thesis", number).textmap)


def base_map() -> UdmfMap:
    return UdmfMap("zdoom", sectors=[{"texturefloor": "FLAT1", "textureceiling": "FLAT1"}])


def problem(one: Layout) -> str | None:
    return one.problem(Floor(one.build(base_map())))


def ends(room: UdmfMap, walls_only: bool = True) -> list[tuple[float, float, float, float]]:
    lines = [line for line in room.linedefs if not walls_only or line.get("sideback", NO_REFERENCE) == NO_REFERENCE]
    vertices = [(float(v["x"]), float(v["y"])) for v in room.vertices]
    return [(*vertices[int(line["v1"])], *vertices[int(line["v2"])]) for line in lines]


def crossed(
    walls: list[tuple[float, float, float, float]], one: tuple[float, float], other: tuple[float, float]
) -> bool:
    """Whether a wall stands between two places."""

    def side(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> float:
        return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])

    return any(
        side(one, other, a) * side(one, other, b) < 0 and side(a, b, one) * side(a, b, other) < 0
        for a, b in (((x1, y1), (x2, y2)) for x1, y1, x2, y2 in walls)
    )


def walked(room: UdmfMap, start: tuple[float, float], clearance: float) -> set[tuple[float, float]]:
    """The places of a grid of 16 units that a walker from a start comes to: exact distances, step by step."""
    lines = tuple(((x1, y1), (x2, y2)) for x1, y1, x2, y2 in ends(room))
    to_wall = {(x, y): far for x, y, far in looks.open_places(lines, (True,) * len(lines))}
    solid = [(float(t["x"]), float(t["y"])) for t in room.things if t["type"] in SOLID]

    def free(place: tuple[float, float]) -> bool:
        clear = all(hypot(place[0] - x, place[1] - y) >= clearance + 16 for x, y in solid)
        return clear and to_wall.get(place, 0) >= clearance

    first = min(to_wall, key=lambda place: hypot(place[0] - start[0], place[1] - start[1]))
    found, queue = {first}, deque([first])
    while queue:
        x, y = queue.popleft()
        for place in ((x + 16, y), (x - 16, y), (x, y + 16), (x, y - 16)):
            if place not in found and free(place):
                found.add(place)
                queue.append(place)
    return found


# ---------------------------------------------------------------------------------------------------------- the layouts


def check_layouts(numbers: range) -> None:
    for scenario in all_scenarios().values():
        for number in numbers:
            one = drawn(scenario, number, strength=(1.0, 0.5, 0.05)[number % 3])
            assert problem(one) is None, (scenario, number)
            room = one.build(base_map())
            for place in (*one.starts, *one.places):
                assert is_inside(room, *place), (scenario, number, place)
            score_bound_can_be_reached(scenario, one, room)


def score_bound_can_be_reached(scenario: Scenario, one: Layout, room: UdmfMap) -> None:
    match scenario.id:
        case "seek_and_kill":  # 20 enemies stand in the maze at the start, each at a place of its own
            assert len(set(one.places)) >= 24
            assert len(one.starts) >= 12
        case "health_gathering":
            assert len(set(one.places)) >= 60
            assert len(one.starts) == 9
        case "defend_the_center":
            seen = [not crossed(ends(room), (0, 0), place) for place in one.places]
            assert len(seen) == 5
            assert sum(seen) >= 3
        case "dodge_projectiles":
            (_, north, _, south) = next(line for line in ends(room, walls_only=False) if line not in ends(room))
            assert 288 <= north - south <= 608
            for y in np.linspace(south + 16, north - 16, 5):
                assert not any(crossed(ends(room), (-480, float(y)), place) for place in one.places)
            assert min(b[1] - a[1] for a, b in itertools.pairwise(one.places)) >= 40  # imps do not overlap
        case "find_ammunition" | "find_the_key" | "guarded_goal" | "rockets":  # as many places as `default` has
            assert len(set(one.starts)) == 25
            floor, scatter = Floor(room), one.parameters["scatter"]
            assert isinstance(scatter, float)
            for x, y in one.starts:  # what is put near a place can be reached from there
                for dx, dy in itertools.product((-scatter, scatter), repeat=2):
                    assert floor.to_wall[floor.pixel(x + dx, y + dy)] > 0
        case other:
            raise AssertionError(f"what bounds the score of {other}?")


def test_layouts_can_be_played():
    check_layouts(range(FIRST, FIRST + 60))


@pytest.mark.slow
@pytest.mark.parametrize("part", range(10))
def test_ten_thousand_layouts_can_be_played(part: int):
    """All scenarios; a tenth of the numbers each."""
    check_layouts(range(FIRST + 1000 * part, FIRST + 1000 * (part + 1)))


@pytest.mark.parametrize("scenario", SCENARIOS, ids=str)
def test_a_walker_comes_to_every_place_of_a_whole_map(scenario: Scenario):
    """Decorations included; found by steps and exact distances, not by the raster that the maps are checked with."""
    for number in range(FIRST, FIRST + 3):
        one = drawn(scenario, number)
        found = walked(whole_map(scenario, number), one.starts[0], one.radius)
        for x, y in (*one.starts, *one.places):
            nearest = min(hypot(x - a, y - b) for a, b in found)
            assert nearest <= 24, (number, x, y)


def test_the_check_finds_what_cannot_be_played():
    hall = ring([(0, 0), (0, 256), (256, 256), (256, 0)])
    far = ring([(512, 0), (512, 256), (768, 256), (768, 0)])
    good = Layout(walls=hall, starts=((64, 64),), places=((192, 192),), height=128)
    assert problem(good) is None
    columns = Floor(good.build(base_map()), [((128, y), 32) for y in range(0, 257, 64)])
    assert good.problem(columns) == "the place (192, 192) is out of reach of the start (64, 64)"
    apart = Layout(walls=hall + far, starts=((64, 64),), places=((640, 128),), height=128)
    assert problem(apart) == "the place (640, 128) is out of reach of the start (64, 64)"
    inside = Layout(walls=hall, starts=((64, 64), (8, 64)), height=128)
    assert problem(inside) == "the start (8, 64) is in a wall"
    divided = hall + ring([(120, 0), (120, 244), (136, 244), (136, 0)], solid=True)
    narrow = Layout(walls=divided, starts=((64, 64),), places=((192, 192),), height=128)
    assert problem(narrow) == "the place (192, 192) is out of reach of the start (64, 64)"


def test_a_map_that_cannot_be_played_is_an_error(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Layout, "problem", lambda *_: "the start is in a wall")
    with pytest.raises(
        TaskError, match="seek_and_kill/procedural-train, map 2000007: the start is in a wall; this is a"
    ):
        map_source(parse_task("seek_and_kill/procedural"), "thesis", FIRST + 7)


def test_the_walls_of_rooms_go_round_them_with_the_open_side_on_the_right():
    rooms = Rooms(size=3, rooms=((0, 0, 1, 1), (2, 0, 3, 3)), corridors=((1, 0, 2, 1),))
    assert set(rooms.walls()) == {
        ((0, 0), (0, 64)),  # west end, northwards
        ((0, 64), (128, 64)),
        ((128, 64), (128, 192)),
        ((128, 192), (192, 192)),
        ((192, 192), (192, 0)),
        ((192, 0), (0, 0)),
    }


def test_a_number_varies_over_a_range_that_grows_with_the_strength():
    for strength, low, high in ((1.0, 96, 240), (0.5, 100, 172), (0.0, 104, 104)):
        draws = [layout.vary(random.Random(seed), strength, 104, 96, 240) for seed in range(200)]
        assert low <= min(draws) <= low + 2
        assert high - 2 <= max(draws) <= high


def test_a_map_at_a_quarter_of_the_strength_has_a_quarter_of_the_decorations():
    quarter = MapSet("train", strengths=(("layout", 0.0), ("decorations", 0.25)))
    things = [whole_map(SCENARIOS[-1], FIRST + n, quarter).things for n in range(12)]
    assert 3 < max(sum(t["type"] in {*SOLID, *LOOSE} for t in one) for one in things) <= 6, "of 24"


def test_rooms_stay_inside_the_map_and_apart():
    for seed in range(40):
        rooms = layout.draw_rooms(random.Random(seed), size=24, across=4, shrink=0.8, loops=0.3, corridor=(2, 3))
        for x1, y1, x2, y2 in (*rooms.rooms, *rooms.corridors):
            assert 0 <= x1 < x2 <= 24
            assert 0 <= y1 < y2 <= 24
        for (ax1, ay1, ax2, ay2), (bx1, by1, bx2, by2) in itertools.combinations(rooms.rooms, 2):
            assert ax2 < bx1 or bx2 < ax1 or ay2 < by1 or by2 < ay1


# ----------------------------------------------------------------------------------------------------- pools, strengths


def test_splits_share_no_texture_decoration_tint_or_silhouette():
    for members in ((*WALLS, *FLATS), (*SOLID, *LOOSE), TINTS, SILHOUETTES):
        pools = {split: set(looks.pool(members, split, 1.0)) for split in SPLITS}
        assert set().union(*pools.values()) == set(members)
        assert sum(map(len, pools.values())) == len(set(members))
        assert len(members) / 8 <= len(pools["test"]) <= len(members) / 3
        assert pools["validation"]


def test_held_out_textures_look_different_from_those_of_other_splits():
    for one, other in itertools.combinations(SPLITS, 2):
        pictures = [np.array([thumbnail(n) for n in looks.pool((*WALLS, *FLATS), s, 1.0)]) for s in (one, other)]
        for name, picture in zip(looks.pool((*WALLS, *FLATS), one, 1.0), pictures[0], strict=True):
            assert np.abs(pictures[1] - picture).mean(axis=(1, 2, 3)).min() >= LEAST_DIFFERENCE, name


@pytest.mark.parametrize("split", SPLITS)
def test_maps_hold_nothing_but_what_their_split_may_have(split):
    kinds = {k + add for k in looks.pool((*SOLID, *LOOSE), split, 1.0) for add in (0, 19000)} | {1, 9001}
    textures = set(looks.pool((*WALLS, *FLATS), split, 1.0))
    for scenario in SCENARIOS:
        for number in NUMBERS[split][:8]:
            room = whole_map(scenario, number, MapSet(split))
            assert {side["texturemiddle"] for side in room.sidedefs if "texturemiddle" in side} <= textures
            assert {sector[name] for sector in room.sectors for name in ("texturefloor", "textureceiling")} <= textures
            assert {thing["type"] for thing in room.things} <= kinds


def test_a_share_of_a_pool_is_part_of_every_larger_share():
    sizes = []
    for strength in (0.0, 0.01, 0.3, 0.7, 1.0):
        sizes.append(len(looks.pool(WALLS, "train", strength)))
        assert set(looks.pool(WALLS, "train", strength)) <= set(looks.pool(WALLS, "train", 1.0))
    assert sizes[:2] == [0, 2]  # of 181
    assert sizes == sorted(sizes)


@pytest.mark.parametrize("scenario", SCENARIOS, ids=str)
def test_without_strengths_the_map_is_the_default_tasks(scenario: Scenario):
    none = MapSet("test", strengths=tuple((part, 0.0) for part in PARTS))
    default = map_source(Task(scenario), "thesis")
    assert map_source(Task(scenario, maps=none), "thesis", 5).textmap == default.textmap


@pytest.mark.parametrize("scenario", SCENARIOS, ids=str)
def test_each_part_of_a_map_is_drawn_apart(scenario: Scenario):
    """Another strength of one part leaves the others as they were."""
    parts = {"lights": ("lightlevel", "lightcolor"), "textures": ("texturefloor", "textureceiling")}
    whole = whole_map(scenario, FIRST + 3)
    for part, fields in parts.items():
        less = whole_map(scenario, FIRST + 3, MapSet("train", strengths=((part, 0.0),)))
        assert less.vertices == whole.vertices
        assert [(t["x"], t["y"], t["type"]) for t in less.things] == [(t["x"], t["y"], t["type"]) for t in whole.things]
        same = {
            name: less.sectors[0].get(name) == whole.sectors[0].get(name) for group in parts.values() for name in group
        }
        assert not all(same[name] for name in fields), part
        assert all(same[name] for name in same if name not in fields), part


@pytest.mark.parametrize("scenario", SCENARIOS, ids=str)
def test_rules_are_those_of_the_default_task(scenario: Scenario):
    """Only parameters of the layout differ, beside the classes' names."""
    default = task_content(Task(scenario), "thesis")
    assert scenario.variety is not None
    layouts = {"num_places", "last_spot", "radius", "xs", "ys"}
    for number in range(FIRST, FIRST + 20):
        changed = drawn(scenario, number).parameters
        assert changed.keys() <= layouts & default.parameters.keys()
        overlaid = default.overlaid(Content(parameters=changed))
        assert len(overlaid.parameters) == len(default.parameters)
        if scenario.id == "dodge_projectiles":
            assert len(changed["xs"]) == len(changed["ys"]) == len(default.parameters["classes"])  # pyright: ignore


# ------------------------------------------------------------------------------------------------- the same everywhere


def test_the_first_maps_are_those_that_runs_were_trained_on():
    """If they change, say so in the changelog: a score over the number of training maps would not compare."""
    found = {
        one.id: [map_source(Task(one, maps=TRAIN), "thesis", FIRST + n).map_magic for n in (0, 1)] for one in SCENARIOS
    }
    assert found == {
        "defend_the_center": [608885887, 1853042810],
        "dodge_projectiles": [1650083044, 2047865654],
        "health_gathering": [2019063825, 1640217535],
        "seek_and_kill": [1532806442, 1122951589],
    }


@pytest.mark.parametrize("profile", ["thesis", "levdoom"])
@pytest.mark.parametrize("scenario", SCENARIOS, ids=str)
def test_the_script_of_a_drawn_map_is_what_the_compiler_makes_of_it(scenario: Scenario, profile):
    """Although its numbers are written into a script that was compiled for another map."""
    for maps in (TRAIN, MapSet("varied")):
        task = Task(scenario, maps=maps)
        compiled = compile_task(task, profile)
        for seed in range(30):
            wad, _ = compiled.map_of(seed)
            source = map_source(task, profile, maps.number_of(seed))
            assert wad is not None
            behavior = read_maps(read_wad(wad))["MAP01"]["BEHAVIOR"]
            assert behavior == compile_acs(source.script, actor_classes=declared_actors(source.decorate))


def test_evaluation_episode_n_draws_the_same_map_for_every_player():
    task = parse_task("defend_the_center/procedural-test")
    assert task.maps is not None
    seeds = [episode_seed(task.id, n) for n in range(100)]
    assert len({task.maps.number_of(seed) for seed in seeds}) == 100
    assert [task.maps.number_of(seed) for seed in seeds] == [seed % 1_000_000 for seed in seeds]


# ------------------------------------------------------------------------------------------------------------ the games


@pytest.mark.engine
@pytest.mark.parametrize("scenario", SCENARIOS, ids=str)
def test_every_map_plays_and_is_the_right_one(scenario: Scenario):
    """The environment compares the running map's magic number with the one of the episode's map."""
    with closing(DoomEnv(Task(scenario, maps=MapSet("test", 6)))) as env:
        frames = []
        for seed in (*range(6), 2):
            observation, info = env.reset(options={"episode_seed": seed})
            assert isinstance(observation, np.ndarray)
            frames.append(observation.tobytes())
            for _ in range(4):
                env.step(0)
            assert info["upper_bound"] == scenario.upper_bound()
            spawned = env._variables["SPAWNED"]
            assert spawned >= {"seek_and_kill": 20, "health_gathering": 16, "defend_the_center": 5}.get(scenario.id, 1)
        assert len(set(frames)) == 6
        assert frames[-1] == frames[2]
        assert env._engine is not None
        log = env._engine.log.read_text(errors="replace")
        assert bad_lines(log) == []


@pytest.mark.engine
def test_every_imp_stands_in_its_row():
    with closing(DoomEnv("dodge_projectiles/procedural-test-4", buffers=("labels",))) as env:
        for seed in range(4):
            env.reset(options={"episode_seed": seed})
            imps = [label for label in env.labels() if label.object_category == "Monster"]
            assert len(imps) == 10, seed


@pytest.mark.engine
def test_enemies_and_the_agent_stand_where_the_layout_says():
    with closing(DoomEnv("seek_and_kill/procedural-test-3", buffers=("labels",))) as env:
        for seed in range(3):
            room = whole_map(env.task.scenario, seed, MapSet("test"))
            spots = {tid: (t["x"], t["y"]) for t in room.things if (tid := int(t.get("id", 0))) >= 10}
            places = {place for tid, place in spots.items() if tid >= FIRST_PLACE}
            assert len(spots) - 20 <= NUM_PLACES
            _, info = env.reset(options={"episode_seed": seed})
            agent = (info["variables"]["POSITION_X"], info["variables"]["POSITION_Y"])
            assert agent in {place for tid, place in spots.items() if tid < FIRST_PLACE}
            seen = [label for label in env.labels() if label.object_category == "Monster"]
            assert all((one.object_position_x, one.object_position_y) in places for one in seen)


@pytest.mark.engine
@pytest.mark.parametrize(("scenario", "least"), [("seek_and_kill", 6.0), ("defend_the_center", 700.0)])
def test_a_scripted_player_plays_them(scenario: str, least: float):
    with closing(DoomEnv(f"{scenario}/procedural-test", player_env("scripted", EnvConfig()))) as env:
        scores = [play_episode(env, ScriptedPlayer(), number)["score"] for number in range(4)]
    assert np.mean(scores) >= least
    assert max(scores) <= env._upper_bound
