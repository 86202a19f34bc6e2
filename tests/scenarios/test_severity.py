"""Graded attributes: ids, what an engine shows at a severity, and how often whole attributes are in force."""

import dataclasses

import numpy as np
import pytest

import gvz
from gvz.core.errors import TaskError, WadError
from gvz.evaluation.gallery import task_frame
from gvz.evaluation.play import episode_seed
from gvz.scenarios.base import Attribute, Chance, Content, Period, Task, Toward, Uniform
from gvz.scenarios.compiler import compile_task, map_source, task_content
from gvz.scenarios.severity import graded, in_force, is_whole
from gvz.tasks import all_scenarios, parse_task, scenarios
from gvz.wad.lumps import read_maps, read_wad
from gvz.wad.textures import blended, used_textures
from gvz.wad.udmf import parse_textmap
from tests.scenarios.conftest import bad_lines

GRADED = tuple((f"{name}/complete=0.5", "thesis") for name in ("defend_the_center", "dodge_projectiles"))
GRADED += (("defend_the_center/fast=0.5+fuzzy=0.5+resized=0.5+gore=0.4", "thesis"),)
GRADED += (("defend_the_center/fast=0.25", "levdoom"),)
GRADED += (("health_gathering/short_agent=0.5+poison=0.5+slime=0.5", "thesis"),)
GRADED += (("health_gathering/supreme+shaded_kits=0.7", "thesis"),)
SHADED = 66
"""the engine's number of STYLE_Shaded"""
RESIZED_AT_HALF = (0.65, 2.0)
"""halfway from 1 to 0.3, and from 1 to 3"""


@pytest.mark.parametrize(
    ("text", "name", "level"),
    [
        ("defend_the_center/fast=0.5", "fast_enemies=0.5", 1),
        ("defend_the_center/gore=1+fast=0.250", "fast_enemies=0.25+gore", 2),
        ("defend_the_center/gore=0+fast=0.25", "fast_enemies=0.25", 1),
        ("defend_the_center/gore=0", "default", 0),
        ("seek_and_kill/complete=0.5", "complete=0.5", 4),
        ("seek_and_kill/complete=1", "complete", 4),
        ("seek_and_kill/complete=0", "default", 0),
        ("dodge_projectiles/mancubus=0.5", "mancubus=0.5", 1),
    ],
)
def test_an_id_with_severities_has_one_canonical_form(text, name, level):
    task = parse_task(text)
    assert (task.name, task.level) == (name, level)
    assert parse_task(task.id) == task


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("defend_the_center/gore=1.5", r"gore=1.5, want a severity from 0 \(as without it\) to 1"),
        ("defend_the_center/gore=0.1234", "at most three decimals"),
        ("defend_the_center/gore=half", "got 'gore=half', want '<attribute>=<severity>'"),
        ("defend_the_center/gore=", "got 'gore=', want"),
        ("defend_the_center/gore=-1", "got 'gore=-1', want"),
        ("defend_the_center/gor=0.5", "unknown attribute 'gor' .*did you mean 'gore'"),
        ("defend_the_center/stone_wall=0.5+mossy_bricks=0.5", "are both of group textures"),
        ("defend_the_center/default=0.5", "'default' has no attribute to grade"),
        ("defend_the_center/complete=0.5+gore", "'complete' is a task and no attribute"),
    ],
)
def test_a_wrong_severity_is_an_error_that_says_what_is_possible(text, message):
    with pytest.raises(TaskError, match=message):
        parse_task(text)


def test_a_severity_of_an_attribute_that_the_task_does_not_have_is_an_error():
    scenario = scenarios()["defend_the_center"]
    with pytest.raises(TaskError, match=r"got fast_enemies=0\.5, want fast_enemies among the attributes"):
        Task(scenario, ("gore",), severities=(("fast", 0.5),))
    assert Task(scenario, severities=(("fast", 0),)) == Task(scenario), "0 is as without it"
    for one in (Task(scenario, ("gore",)), Task(scenario, ("gore", "fast"), severities=(("gore", 0.5), ("fast", 0)))):
        assert dataclasses.replace(one, severities=one.severities) == one


@pytest.mark.parametrize("scenario", all_scenarios().values(), ids=lambda scenario: scenario.id)
def test_no_two_maps_of_a_task_need_different_classes_of_one_name(scenario):
    """The task's file holds the classes of all maps of its episodes."""
    for profile in ("thesis", "levdoom"):
        for attribute in scenario.attributes:
            task = parse_task(f"{scenario.id}/{attribute.name}")
            with_it, without = (
                task_content(one, profile).actors for one in (task, parse_task(f"{scenario.id}/default"))
            )
            assert all(with_it[name] == text for name, text in without.items())


@pytest.mark.parametrize("scenario", scenarios().values(), ids=lambda scenario: scenario.id)
def test_a_graded_name_has_no_exception_of_profile_levdoom(scenario):
    plain = dataclasses.replace(scenario, levdoom_tasks={})
    for name in scenario.levdoom_tasks:
        whole = parse_task(f"{scenario.id}/{name}")
        graded = Task(scenario, whole.attributes, severities=tuple((one, 0.999) for one in whole.attributes))
        for task in (whole, graded):
            without = dataclasses.replace(task, scenario=plain)
            is_plain = task_content(task, "levdoom") == task_content(without, "levdoom")
            assert is_plain == bool(task.severities), task.id


@pytest.mark.parametrize(
    ("text", "whole"),
    [
        ("health_gathering/stimpacks=0.5", "health_gathering/stimpacks"),
        ("dodge_projectiles/arachnotron=0.5+city", "dodge_projectiles/arachnotron+city"),
        ("health_gathering/poison+stimpacks+supreme=0.5", "health_gathering/poison+stimpacks"),
    ],
)
def test_no_episode_of_a_graded_name_has_an_exception_of_profile_levdoom(text, whole):
    """In each of these some episodes play no attribute but those of a name with an exception."""
    graded = compile_task(parse_task(text), "levdoom")
    without = dataclasses.replace(graded.task, scenario=dataclasses.replace(graded.task.scenario, levdoom_tasks={}))
    plain = compile_task(without, "levdoom")
    assert [graded.map_of(seed)[1] for seed in range(12)] == [plain.map_of(seed)[1] for seed in range(12)]
    assert graded.map_magic == plain.map_magic
    assert task_content(parse_task(whole), "levdoom") != task_content(
        dataclasses.replace(parse_task(whole), scenario=without.scenario), "levdoom"
    )


def test_a_blend_lies_where_both_textures_lie():
    """A wall of 64x128 and a flat of 64x64: the wall once, made of its own patches, and the flat twice."""
    patches = {"WALL": [("TOP", 0, 0), ("BOTTOM", 0, 64)]}
    entries = blended("XWALL", "WALL", "FLAT", 0.25, {"WALL": (64, 128), "FLAT": (64, 64)}, patches)
    assert entries.splitlines() == [
        'Texture "UWALL", 64, 128',
        "{",
        'Patch "TOP", 0, 0',
        'Patch "BOTTOM", 0, 64',
        "}",
        'Texture "XWALL", 64, 128',
        "{",
        'Patch "UWALL", 0, 0 ',
        'Patch "FLAT", 0, 0 { Style Translucent Alpha 0.25 }',
        'Patch "FLAT", 0, 64 { Style Translucent Alpha 0.25 }',
        "}",
    ]


def test_a_texture_of_a_blend_is_repeated_over_its_width_too():
    entries = blended("XWALL", "FLAT", "WIDE", 0.5, {"FLAT": (64, 64), "WIDE": (256, 128)}, {}).splitlines()
    assert entries[0] == 'Texture "XWALL", 256, 128'
    places = {(x, y) for x in (0, 64, 128, 192) for y in (0, 64)}
    assert {line for line in entries if "FLAT" in line} == {f'Patch "FLAT", {x}, {y} ' for x, y in places}


@pytest.mark.parametrize(("name", "opacity"), [("XWALL", 50.0), ("XWALL", -0.1), ("XWALLXWALL", 0.5), ("xwall", 0.5)])
def test_a_blend_that_the_engine_would_show_otherwise_is_refused(name: str, opacity: float):
    with pytest.raises(WadError, match=f"texture {name}: got a blend with opacity {opacity:g}, want a name of 1 to 8"):
        blended(name, "WALL", "WALL", opacity, {"WALL": (64, 128)}, {})


def test_a_file_has_the_blends_of_all_maps_that_its_episodes_play():
    """The engine would show a checkerboard and go on."""
    compiled = compile_task(parse_task("health_gathering/supreme=0.5+slime=0.5"))
    lumps = {lump.name: lump.data.decode("latin-1") for lump in read_wad(compiled.wad_path.read_bytes())}
    walls = set[str]()
    for seed in range(12):
        wad, _ = compiled.map_of(seed)
        assert wad is not None
        room = parse_textmap(read_maps(read_wad(wad))["MAP01"]["TEXTMAP"].decode("latin-1"))
        used = used_textures(room).keys()
        assert all(f'Texture "{name}"' in lumps["TEXTURES"] for name in used)
        walls |= {str(side["texturemiddle"]) for side in room.sidedefs if "texturemiddle" in side}
    assert len(walls) == 2


@pytest.mark.parametrize(
    ("change", "whole"),
    [
        (Content(parameters={"delay": 3}, entity={"RenderStyle": "STYLE_Add"}), False),
        (Content(parameters={"classes": ("Demon",)}), True),
        (Content(parameters={"kit": '"Stimpack"'}), True),
        (Content(parameters={"moves": True}), True),
        (Content(base_wad="basic.wad"), True),
        (Content(actors={"Big": "ACTOR Big : Demon\n{\n}\n"}), True),
        (Content(entity={"RenderStyle": Chance("STYLE_Add", 0.5)}), True),
        (Content(agent={"ViewHeight": Toward(60.0, 0.5)}), True),
    ],
)
def test_another_map_other_classes_or_parts_of_properties_have_nothing_in_between(change: Content, whole: bool):
    assert is_whole(change) == whole


def test_things_are_spread_and_numbers_go_part_of_the_way():
    def content(text):
        return task_content(parse_task(f"health_gathering/{text}"), "thesis")

    starts = content("default").things["health_gathering.wad"]
    columns = content("obstacles").things["health_gathering.wad"][len(starts) :]
    assert content("obstacles=0.5").things["health_gathering.wad"] == (*starts, *columns[1::2])
    assert len(content("obstacles=0.1").things["health_gathering.wad"]) == len(starts) + len(columns) // 10
    default, whole = content("default").parameters, content("poison").parameters
    half = content("poison=0.5").parameters
    assert (default["num_poisons"], half["num_poisons"], whole["num_poisons"]) == (0, 1, 2)
    before = Content(parameters={"enemies": 10, "radius": 100.0, "angle": Uniform(0.0, 0.5), "delay": 20})
    whole = {"enemies": 30, "radius": Uniform(60.0, 140.0), "angle": 1.0, "delay": Period(40)}
    change = Content(parameters=whole, entity={"Speed": 20.0})
    quarter = graded(before, change, 0.25)
    assert quarter.parameters == {
        "enemies": 15, "radius": Uniform(90.0, 110.0), "angle": Uniform(0.25, 0.625), "delay": 25
    }  # fmt: skip
    assert [type(value) for value in quarter.parameters.values()] == [int, Uniform, Uniform, int], "as ACS has them"
    assert quarter.entity == {"Speed": Toward(20.0, 0.25)}


def test_a_share_of_the_things_has_a_style_or_flag_and_the_others_keep_the_scenarios():
    centre = scenarios()["defend_the_center"]
    ghosts = dataclasses.replace(centre, content=centre.content.overlaid(Content(entity={"RenderStyle": "STYLE_Add"})))
    script = map_source(Task(ghosts, ("fuzzy",), severities=(("fuzzy", 0.5),)), "thesis").script
    assert (
        "SetActorProperty(tid, APROP_RenderStyle, STYLE_Add); "
        "if (Random(0.0, 1.0) < 0.5) SetActorProperty(tid, APROP_RenderStyle, STYLE_Fuzzy);"
    ) in script
    safe = Attribute(name="safe", groups=("safety",), content=Content(agent={"Invulnerable": True}))
    task = Task(dataclasses.replace(centre, attributes=(safe,), complete=("safe",), levdoom_tasks={}), ("safe",))
    assert "SetActorProperty(0, APROP_Invulnerable, True);" in map_source(task, "thesis").script
    half = map_source(dataclasses.replace(task, severities=(("safe", 0.5),)), "thesis").script
    assert "if (Random(0.0, 1.0) < 0.5) SetActorProperty(0, APROP_Invulnerable, True);" in half
    safe_content = centre.content.overlaid(Content(agent={"Invulnerable": True}))
    unsafe = dataclasses.replace(safe, content=Content(agent={"Invulnerable": False}))
    scenario = dataclasses.replace(task.scenario, content=safe_content, attributes=(unsafe,))
    assert (
        "SetActorProperty(0, APROP_Invulnerable, True); "
        "if (Random(0.0, 1.0) < 0.5) SetActorProperty(0, APROP_Invulnerable, False);"
    ) in map_source(Task(scenario, ("safe",), severities=(("safe", 0.5),)), "thesis").script


@pytest.mark.parametrize(("profile", "whole", "first"), [("thesis", 30, 1), ("levdoom", 60, 0)])
def test_a_weaker_poison_comes_more_rarely(profile, whole, first):
    for task in ("poison", "complete"):
        for severity in (0.05, 0.1, 0.5, 0.99):
            parameters = task_content(parse_task(f"health_gathering/{task}={severity}"), profile).parameters
            assert parameters["poison_delay"] == round(whole / severity)
            assert parameters["first_poison_delay"] == first * parameters["poison_delay"]
    assert task_content(parse_task("health_gathering/poison"), profile).parameters["poison_delay"] == whole


def test_a_whole_attribute_is_in_force_in_its_share_of_the_episodes():
    """Of 4,000 evaluation seeds; the standard error is 0.7 points. What is in force at 0.3 is so at 0.6."""
    seeds = [episode_seed("seek_and_kill/default", n) for n in range(4000)]
    low, high = ({s for s in seeds if in_force(severity, "mixed_enemies", s)} for severity in (0.3, 0.6))
    assert low < high
    assert len(low) / 4000 == pytest.approx(0.3, abs=0.03)
    assert len(high) / 4000 == pytest.approx(0.6, abs=0.03)
    other = {s for s in seeds if in_force(0.6, "supreme", s)}
    assert len(low & other) / 4000 == pytest.approx(0.3 * 0.6, abs=0.03), "of two attributes, each for itself"
    compiled = compile_task(parse_task("seek_and_kill/mixed=0.3"))
    magic = {name: map_source(parse_task(f"seek_and_kill/{name}"), "thesis").map_magic for name in ("default", "mixed")}
    for seed in seeds[:20]:
        played = compiled.map_of(seed)[1]
        # the file has a class more than that of default, which is a part of what the number is made of
        assert (played == magic["mixed"]) == (seed in low)
        assert played in magic.values()


@pytest.mark.engine
@pytest.mark.parametrize("job", GRADED, ids="-".join)
def test_games_at_a_severity_are_what_they_say(measured, job):
    found = measured(GRADED, job)
    assert found["magic_right"]
    assert bad_lines(found["log"]) == []
    if "fast" in job[0]:  # 8 and 10 of the classes, 20 (levdoom: 15) of the attribute
        speeds, damage = ((9.75, 11.25), 0.825) if job[1] == "levdoom" else ((14.0, 15.0), 0.65)
        assert {entity["speed"] for entity in found["entities"]} <= set(speeds)
        assert found["agent"]["damage_factor"] == pytest.approx(damage, abs=1e-4)  # on the way from 1 to 0.3
    if "resized" in job[0]:
        low, high = RESIZED_AT_HALF
        scales = [entity[name] for entity in found["entities"] for name in ("scale_x", "scale_y")]
        assert all(low - 1e-4 <= scale <= high + 1e-4 for scale in scales)
        assert len(set(scales)) == len(scales)
    if "shaded_kits" in job[0]:  # of 30 kits, the standard error is 8 points
        shaded = [entity["render_style"] for entity in found["entities"]].count(SHADED)
        assert 0.4 <= shaded / len(found["entities"]) <= 0.95
    if "short_agent" in job[0]:  # 41 of the class, 0 to 100 of the attribute
        assert 20.5 <= found["agent"]["view_height"] <= 70.5


@pytest.mark.engine
def test_textures_at_a_severity_are_between_those_of_both_tasks():
    names = ("default", "stone_wall=0.25", "stone_wall=0.5", "stone_wall=0.75", "stone_wall")
    frames = [task_frame(parse_task(f"defend_the_center/{name}"))[:90].astype(float) for name in names]
    from_default, to_whole = (
        [float(np.abs(frame.mean(axis=(0, 1)) - frames[end].mean(axis=(0, 1))).sum()) for frame in frames]
        for end in (0, -1)
    )
    assert from_default == sorted(from_default)
    assert to_whole == sorted(to_whole, reverse=True)


@pytest.mark.engine
@pytest.mark.parametrize("task", ["seek_and_kill/blue", "health_gathering/slime"])
def test_a_texture_at_nearly_the_whole_severity_is_nearly_that_of_the_task(task):
    """That of `blue` has the name of a patch that is another picture; that of `slime` has patches over each other."""
    whole, nearly = (task_frame(parse_task(name))[:90].astype(float) for name in (task, f"{task}=0.999"))
    assert np.abs(whole - nearly).mean() < 4


@pytest.mark.engine
def test_an_environment_plays_both_maps_of_a_graded_attribute():
    with gvz.make("health_gathering/supreme=0.5+slime=0.5") as env:
        for seed in range(6):  # the environment compares the map's number with the one that it should play
            env.reset(options={"episode_seed": seed})
            env.step(0)
        assert env.unwrapped.task.name == "slime=0.5+supreme=0.5"
    assert 0 < sum(in_force(0.5, "supreme", seed) for seed in range(6)) < 6
