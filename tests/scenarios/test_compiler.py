"""From task to WAD file: content, script text, reproducible bytes, the cache, where things stand."""

import dataclasses
import hashlib
import os
import re
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from math import hypot
from multiprocessing import get_context
from pathlib import Path

import pytest

from gvz.core.errors import AcsError, ResourceError, TaskError, WadError
from gvz.scenarios import compiler
from gvz.scenarios.base import Attribute, Content, Task, Textures, Thing, Uniform, Value
from gvz.scenarios.compiler import (
    _compiled_by_form,
    acs_value,
    build_wad,
    compile_task,
    map_source,
    task_content,
)
from gvz.tasks import named_tasks, parse_task, scenario_named
from gvz.wad.acs import compile_acs
from gvz.wad.lumps import read_maps, read_wad
from gvz.wad.udmf import UdmfMap, parse_textmap

TEXTURES = {  # thesis, appendix B
    "mossy_bricks": ("A-MOSBRI", "FLOOR4_6", "CEIL5_1"),
    "stone_wall": ("FLAT5_7", "FLOOR1_6", "CEIL3_3"),
    "slime": ("A-CAMO3", "SLIME04", "GRASS2"),
    "lava": ("AQCONC14", "LAVA1", "CEIL1_1"),
    "water": ("AQSECT09", "FWATER1", "AQF052"),
    "blue": ("FIREBLU2", "FLAT14", "CEIL4_3"),
    "red": ("FIREWALL", "CRACKLE4", "DORED"),
    "flames": ("SWATER1", "RROCK02", "CAVERN1"),
    "city": ("SKY2", "ROCKRED1", "CEIL4_1"),
    "supreme": ("STONE2", "NUKAGE1", "CEIL4_1"),
    "defend_the_center": ("TANROCK2", "FLOOR0_5", "CEIL4_1"),
    "health_gathering": ("GSTONE1", "NUKAGE1", "CEIL4_1"),
    "seek_and_kill": ("ICKWALL3", "AQF051", "FLAT19"),
    "dodge_projectiles": ("BRICK12", "CRATOP1", "CRATOP1"),
}


pytestmark = pytest.mark.usefixtures("cache")


def compiled_map(task_id: str) -> UdmfMap:
    lumps = read_wad(compile_task(parse_task(task_id)).wad_path.read_bytes())
    return parse_textmap(read_maps(lumps)["MAP01"]["TEXTMAP"].decode())


@pytest.mark.parametrize("task_id", [task.id for task in named_tasks()])
def test_every_surface_has_the_textures_of_the_thesis(task_id: str):
    task = parse_task(task_id)
    room = compiled_map(task_id)
    names = [TEXTURES[name] for name in task.attributes if name in TEXTURES and name != "supreme"]
    wanted = names or [TEXTURES["supreme" if "supreme" in task.attributes else task.scenario.id]]
    found = {
        (side["texturemiddle"], sector["texturefloor"], sector["textureceiling"])
        for side in room.sidedefs
        if "texturemiddle" in side
        for sector in room.sectors
    }
    assert found == set(wanted)


@pytest.mark.parametrize("task_id", [task.id for task in named_tasks()])
def test_nothing_stands_in_a_wall_or_in_the_way_of_a_start(task_id: str):
    room = compiled_map(task_id)
    corners = [(v["x"], v["y"]) for v in room.vertices]
    walls = [(corners[line["v1"]], corners[line["v2"]]) for line in room.linedefs]
    starts = [(t["x"], t["y"]) for t in room.things if t["type"] in (1, 9001)]
    solid = [(t["x"], t["y"]) for t in room.things if t["type"] not in (1, 9001)]
    for place in (*starts, *solid):
        assert min(distance(place, wall) for wall in walls) >= 32
    for place in solid:
        assert min(hypot(place[0] - x, place[1] - y) for x, y in starts) >= 90


def distance(point: tuple[float, float], wall: tuple[tuple[float, float], tuple[float, float]]) -> float:
    (x, y), ((x1, y1), (x2, y2)) = point, wall
    dx, dy = x2 - x1, y2 - y1
    along = max(0.0, min(1.0, ((x - x1) * dx + (y - y1) * dy) / (dx * dx + dy * dy)))
    return hypot(x - x1 - along * dx, y - y1 - along * dy)


def test_attributes_join_things_and_overlay_the_rest():
    one = Content(things={"a": (Thing(1, 0, 0),)}, parameters={"p": 1, "q": 2}, agent={"Speed": 1.0})
    other = Content(things={"a": (Thing(2, 0, 0),), "b": ()}, parameters={"q": 3}, base_wad="a")
    both = one.joined(other)
    assert both.things == {"a": (Thing(1, 0, 0), Thing(2, 0, 0)), "b": ()}
    assert both.parameters == {"p": 1, "q": 3}
    assert both.agent == {"Speed": 1.0}
    assert both.base_wad == "a"
    assert one.overlaid(other).things["a"] == (Thing(2, 0, 0),)


def test_profiles_differ_where_the_author_departed_from_his_thesis():
    task = parse_task("defend_the_center/fast_enemies")
    thesis, levdoom = task_content(task, "thesis"), task_content(task, "levdoom")
    assert (thesis.entity["Speed"], levdoom.entity["Speed"]) == (20.0, 15.0)
    assert (thesis.parameters["respawn_delay"], levdoom.parameters["respawn_delay"]) == (90, 150)
    assert compile_task(task).wad_path != compile_task(task, "levdoom").wad_path


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (20, "20"),
        (20.0, "20.0"),
        (218.99999999999997, "219.0"),
        (-1e-9, "-0.0"),
        (0.3, "0.3"),
        (129.33333333333334, "129.333333"),
        (-0.5, "-0.5"),
        ("STYLE_Fuzzy", "STYLE_Fuzzy"),
        (Uniform(0.3, 3.0), "Random(0.3, 3.0)"),
        (("Demon", "LostSoul"), '{"Demon", "LostSoul"}'),
        ((84.0, 492.0), "{84.0, 492.0}"),
    ],
)
def test_values_are_written_as_acs(value, text: str):
    assert acs_value(value) == text


def test_the_magic_number_is_positive_and_each_maps_own():
    sources = [map_source(task, profile) for task in named_tasks() for profile in ("thesis", "levdoom")]
    for source in sources:
        assert 0 < source.map_magic < 2**31
        assert f"map_magic = {source.map_magic};" in source.script
    texts = {(s.textmap, s.script, s.decorate) for s in sources}
    assert len({source.map_magic for source in sources}) == len(texts)
    assert len({map_source(task, "thesis").map_magic for task in named_tasks()}) == 76


def test_the_same_task_gives_the_same_bytes_in_every_process(cache: Path):
    code = (
        "from gvz.tasks import parse_task; from gvz.scenarios.compiler import compile_task; "
        "print(compile_task(parse_task('health_gathering/complete')).wad_path)"
    )
    paths = set()
    for seed in ("1", "2"):
        env = {**os.environ, "PYTHONHASHSEED": seed}
        done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
        paths.add(done.stdout.strip())
    paths.add(str(compile_task(parse_task("health_gathering/complete")).wad_path))
    assert len(paths) == 1
    assert [path.name for path in cache.iterdir()] == [Path(paths.pop()).name]


def test_a_cached_file_is_named_by_the_hash_of_its_bytes_and_not_written_again():
    task = parse_task("seek_and_kill/red")
    path = compile_task(task).wad_path
    assert path.stem == hashlib.sha256(path.read_bytes()).hexdigest()
    written = path.stat().st_mtime_ns
    assert compile_task(task).wad_path == path
    assert path.stat().st_mtime_ns == written


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o002, 0o664), (0o077, 0o600)])
def test_a_cached_file_may_be_read_by_all_whom_the_umask_allows(umask: int, mode: int):
    before = os.umask(umask)
    try:
        path = compile_task(parse_task("seek_and_kill/red")).wad_path
    finally:
        os.umask(before)
    assert path.stat().st_mode & 0o777 == mode


@pytest.mark.parametrize("damage", [b"", b"PWAD", bytes(5000)])
def test_a_damaged_cached_file_is_built_again(damage: bytes):
    task = parse_task("seek_and_kill/red")
    path = compile_task(task).wad_path
    whole = path.read_bytes()
    path.write_bytes(damage)
    assert compile_task(task).wad_path.read_bytes() == whole


def _compile(task_id: str) -> tuple[str, str]:
    path = compile_task(parse_task(task_id)).wad_path
    return path.stem, hashlib.sha256(path.read_bytes()).hexdigest()


def test_many_processes_can_compile_at_once(cache: Path):
    tasks = [task.id for task in named_tasks("seek_and_kill", level=1)]
    with ProcessPoolExecutor(3, mp_context=get_context("spawn")) as pool:
        results = list(pool.map(_compile, tasks * 3))
    assert all(name == digest for name, digest in results)
    assert sorted(path.stem for path in cache.iterdir()) == sorted({name for name, _ in results})


def test_without_the_variable_the_users_cache_directory_is_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("GVZ_CACHE_DIR")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    assert compile_task(parse_task("seek_and_kill/red")).wad_path.parent == tmp_path / "home" / "gvizdoom"


def test_a_map_is_found_when_the_program_has_gone_to_another_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("GVZ_CACHE_DIR", "maps")
    monkeypatch.chdir(tmp_path)
    wad = compile_task(parse_task("seek_and_kill/red")).wad_path
    monkeypatch.chdir("/")
    assert wad.exists()


def test_a_cache_that_cannot_be_written_is_an_error_with_the_way_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("GVZ_CACHE_DIR", str(tmp_path / "file" / "below"))
    with pytest.raises(ResourceError, match=r"map cache .*file/below: .*set GVZ_CACHE_DIR to a directory"):
        compile_task(parse_task("seek_and_kill/red"))


def with_attribute(content: Content) -> Task:
    scenario = scenario_named("defend_the_center")
    new = Attribute(name="new", groups=("novelty",), content=content)
    return Task(dataclasses.replace(scenario, attributes=(*scenario.attributes, new)), ("new",))


WAD = "defend_the_center.wad"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (
            Content(things={"defend_the_centre.wad": (Thing(26, 0, 0),)}),
            r"things on defend_the_centre.wad \(did you mean 'defend_the_center.wad'\?\), want a base map of the scen",
        ),
        (Content(things={WAD: (Thing(26, 0, 0), Thing(26, 2000, 0))}), "x=2000, .* want a place inside the map defend"),
        (Content(things={WAD: (Thing(5555, 0, 0),)}), "type=5555, .* want the editor number of an actor class"),
        (
            Content(actors={"Foo": "ACTOR Foo\n{\n States\n {\n Spawn:\n  BOM1 A -1\n }\n}"}),
            "unknown sprite BOM1, frame A",
        ),
        (
            Content(actors={"Foo": "ACTOR Foo\n{\n States {\n Spawn: Idle: BOM1 A -1\n Stop\n }\n}"}),
            "unknown sprite BOM1, frame A",
        ),
    ],
)
def test_things_and_sprites_that_are_not_there_are_refused(content: Content, message: str):
    with pytest.raises(TaskError, match=f"task defend_the_center/new: .*{message}"):
        compile_task(with_attribute(content))


@pytest.mark.parametrize(
    "text",
    [
        "script 1 OPEN { Delay(-300.0 + 96.5 * 1234567); }",
        "int far = 2 * 300.0; script 1 OPEN { Delay(far); }",
        "int far = - 300.0; script 1 OPEN { Delay(far); }",
        "int far = 300.0 > 200; script 1 OPEN { Delay(far); }",
        "#define FAR 300.0\n# Define HALF FAR / 2\nscript 1 OPEN { Delay(FAR + HALF); }",
        "script 1 OPEN { Switch (Random(0, 1)) { case 900.0: Delay(1); break; case 300.0: Delay(2); break; } }",
        'script 1 OPEN { Log(s:"at 96.5"); Delay(96.5); }',
        "script 1 OPEN { Delay(96.5); } // at 96.5",
    ],
)
def test_a_script_of_a_drawn_map_has_the_bytes_that_the_compiler_gives_it(text: str):
    """Also where the compiler has calculated with its numbers, or sorted them."""
    script = f'#include "zcommon.acs"\n{text}'
    assert _compiled_by_form(script, "") == compile_acs(script)


def test_scripts_of_drawn_maps_that_differ_in_numbers_are_compiled_once(monkeypatch: pytest.MonkeyPatch):
    forms = "script 1 OPEN { Delay(96.5); Delay(4 * 1000000); }", "script 1 OPEN { Delay(7.25); Delay(4 * 2000000); }"
    want = [compile_acs(script) for script in forms]
    assert _compiled_by_form(forms[0], "") == want[0]
    monkeypatch.setattr(compiler, "compile_acs", None)
    assert _compiled_by_form(forms[1], "") == want[1]


def test_a_number_of_a_drawn_map_that_is_too_large_is_refused():
    with pytest.raises(AcsError, match=r"got the number 40000\.0, want at most 32767"):
        _compiled_by_form("script 1 OPEN { Delay(40000.0); }", "")


def test_things_of_another_map_alone_are_refused():
    """The map of `supreme` would have none of them, and the task would be the level of two attributes."""
    hall = scenario_named("health_gathering")
    places: dict[str, tuple[Thing, ...]] = {"health_gathering.wad": (Thing(35, 300, 300),)}
    for extra in ({}, {"health_gathering_supreme.wad": ()}):
        candle = Attribute(name="candle", groups=("candles",), content=Content(things={**places, **extra}))
        task = Task(dataclasses.replace(hall, attributes=(*hall.attributes, candle)), ("candle", "supreme"))
        if extra:
            compile_task(task)
            continue
        with pytest.raises(TaskError, match=r"task .*/candle\+supreme: candle has things on .* want places on health_"):
            compile_task(task)


def test_things_of_profile_levdoom_alone_do_not_bind_a_task_of_the_thesis():
    hall, places = scenario_named("health_gathering"), {"health_gathering.wad": (Thing(35, 300, 300),)}
    candle = Attribute(name="candle", groups=("candles",), content=Content(), levdoom=Content(things=places))
    task = Task(dataclasses.replace(hall, attributes=(*hall.attributes, candle)), ("candle", "supreme"))
    compile_task(task)
    with pytest.raises(TaskError, match=r"candle has things on health_gathering\.wad alone"):
        compile_task(task, "levdoom")


def test_an_integer_radius_is_refused():
    centre = scenario_named("defend_the_center")
    content = centre.content.overlaid(Content(parameters={"radius": 735}))
    with pytest.raises(AcsError, match=r"argument 2 of FixedMul: got the integer 735, want .* such as 735\.0"):
        compile_task(Task(dataclasses.replace(centre, content=content)))


@pytest.mark.parametrize(
    "parameters",
    [
        {"radius": 735},  # a hundredth of a unit
        {"radius": Uniform(700, 735)},
        {"radius": Uniform(700, 735.0)},
        {"respawn_delay": 45.0},  # a day
        {"respawn_delay": Uniform(45.0, 90.0)},
        {"num_enemies": 5.0},  # 327,680 enemies
    ],
)
def test_a_number_of_another_kind_than_the_scenarios_own_is_refused(parameters: dict[str, Value]):
    ((name, value),) = parameters.items()
    message = re.escape(f"task defend_the_center/new: got {name}={value!r}, and ")
    with pytest.raises(TaskError, match=f"{message}.* in the scenario; want both with a point, or neither"):
        compile_task(with_attribute(Content(parameters=parameters)))


@pytest.mark.parametrize(
    "parameters", [{"radius": Uniform(0, 735.0)}, {"respawn_delay": 0}, {"respawn_delay": "9 * 5"}]
)
def test_zero_and_text_are_of_either_kind(parameters: dict[str, Value]):
    compile_task(with_attribute(Content(parameters=parameters)))


def test_a_size_between_integers_is_refused():
    """They are no fixed-point numbers: enemies would be drawn a 65,536th as large."""
    with pytest.raises(AcsError, match=r"argument 3 of SetActorProperty: got the integer 1, want .* such as 1\.0"):
        compile_task(with_attribute(Content(entity={"ScaleX": Uniform(1, 3)})))


def test_an_unknown_texture_is_refused():
    task = with_attribute(Content(textures=Textures("TANROCK2", "LAVVA1", "CEIL4_1")))
    with pytest.raises(WadError, match=r"task defend_the_center/new: sector 0 texturefloor: .*'LAVVA1'.*'LAVA1'"):
        compile_task(task)
    half = dataclasses.replace(task, severities=(("new", 0.5),))
    with pytest.raises(WadError, match=r"task defend_the_center/new=0\.5: texture X\w+: .*'LAVVA1'.*'LAVA1'"):
        compile_task(half)


def test_case_does_not_matter_in_names_of_textures():
    lower, upper = (
        map_source(dataclasses.replace(with_attribute(Content(textures=names)), severities=(("new", 0.5),)), "thesis")
        for names in (Textures("firewall", "lava1", "ceil4_1"), Textures("FIREWALL", "LAVA1", "CEIL4_1"))
    )
    assert lower == upper


def test_a_parameter_that_the_script_does_not_name_is_refused():
    with pytest.raises(TaskError, match=r"task defend_the_center/new: .*set but not used: \['respwan_delay'\]"):
        compile_task(with_attribute(Content(parameters={"respwan_delay": 3})))


def test_a_dollar_that_begins_no_name_is_refused():
    centre = scenario_named("defend_the_center")
    task = Task(dataclasses.replace(centre, script=f"{centre.script}// 5$ a shot\n"))
    with pytest.raises(TaskError, match=r"task defend_the_center/default: the script has a '\$' .*; write '\$\$' for"):
        compile_task(task)
    compile_task(Task(dataclasses.replace(centre, script=f"{centre.script}// 5$$ a shot\n")))


def test_an_unknown_class_is_refused():
    with pytest.raises(AcsError, match="Demno"):
        compile_task(with_attribute(Content(parameters={"classes": ("Demno",)})))


def test_a_task_with_one_changed_number_has_another_wad():
    task = parse_task("defend_the_center/default")
    changed = dataclasses.replace(
        task.scenario,
        content=task.scenario.content.overlaid(Content(parameters={"respawn_delay": 91})),
    )
    assert build_wad(map_source(Task(changed), "thesis")) != build_wad(map_source(task, "thesis"))
