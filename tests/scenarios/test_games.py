"""Proof that a map is what it says: what a running engine shows, against the thesis's appendix B.

The tables here are written from the thesis and from LevDoom's maps, not from the scenarios' data.
"""

import cmath
import random
from collections import Counter
from contextlib import closing

import pytest

from gvz.engine.engine import Engine, EngineConfig
from gvz.env import DoomEnv
from gvz.scenarios.base import BOOKKEEPING
from gvz.scenarios.compiler import compile_task
from gvz.tasks import named_tasks, parse_task, scenarios
from tests.episodes import idle_to_the_end
from tests.scenarios.conftest import bad_lines
from tests.score_tables import WORDS, words_of

pytestmark = pytest.mark.engine


THESIS = tuple((task.id, "thesis") for task in named_tasks())
LEVDOOM = tuple((task.id, "levdoom") for task in named_tasks())
LEVDOOM_SAMPLE = (
    ("defend_the_center/fast_enemies", "levdoom"),
    ("defend_the_center/flying_enemies+stone_wall", "levdoom"),
    ("defend_the_center/complete", "levdoom"),
    ("dodge_projectiles/revenants", "levdoom"),
    ("dodge_projectiles/complete", "levdoom"),
    ("health_gathering/stimpacks", "levdoom"),
    ("health_gathering/complete", "levdoom"),
    ("seek_and_kill/default", "levdoom"),
    ("seek_and_kill/complete", "levdoom"),
)


def unnamed_sets(per_scenario: int) -> tuple[tuple[str, str], ...]:
    """Random sets of attributes that the thesis gives no name."""
    rng = random.Random(7)
    named = {task.id for task in named_tasks()}
    found = []
    for scenario in scenarios().values():
        while sum(task.startswith(scenario.id) for task, _ in found) < per_scenario:
            chosen: list[str] = []
            taken: set[str] = set()
            for attribute in rng.sample(scenario.attributes, k=len(scenario.attributes)):
                if rng.random() < 0.6 and not taken.intersection(attribute.groups):
                    chosen.append(attribute.name)
                    taken.update(attribute.groups)
            task = parse_task(f"{scenario.id}/{'+'.join(chosen) or 'default'}")
            if task.id not in named:
                found.append((task.id, "thesis"))
    return tuple(found)


FAST = (*THESIS, *LEVDOOM_SAMPLE, *unnamed_sets(3))
SLOW = tuple(job for job in LEVDOOM if job not in LEVDOOM_SAMPLE)


def jobs_of(scenario: str):
    """Each job of a scenario, with the batch it is played in."""
    fast = tuple(job for job in FAST if job[0].startswith(scenario))
    slow = tuple(job for job in SLOW if job[0].startswith(scenario))
    return [
        *(pytest.param(fast, job, id="-".join(job)) for job in fast),
        *(pytest.param(slow, job, id="-".join(job), marks=pytest.mark.slow) for job in slow),
    ]


def attributes(job: tuple[str, str]) -> set[str]:
    return set(parse_task(job[0]).attributes)


def check_common(found: dict, decorations: dict[str, int]):
    """Right map, silent log, the decorations and nothing else that only stands about."""
    assert found["magic_right"]
    assert bad_lines(found["log"]) == []
    objects = Counter(name for name, _, _ in found["start_objects"])
    known = ("LiveStick", "HeadsOnAStick", "HeadCandles", "FloatingSkull", "TallGreenColumn", "TallRedColumn")
    known = (*known, "HeartColumn", "BlueTorch", "GreenTorch", "RedTorch")
    assert {name: objects[name] for name in known if objects[name]} == decorations


def near(value: float) -> object:
    return pytest.approx(value, abs=1e-4)


def check_entities(entities: list[dict[str, float]], *, resized: bool, style: float | None, speed: float | None):
    for name in ("scale_x", "scale_y"):
        scales = [entity[name] for entity in entities]
        if resized:
            assert all(0.3 - 1e-4 <= scale <= 3.0 for scale in scales)
            assert len(set(scales)) == len(scales)
        else:
            assert set(scales) == {1.0}
    if resized:
        assert all(entity["scale_x"] != entity["scale_y"] for entity in entities)
    if style is None:
        assert {entity["render_style"] for entity in entities} <= {1, 3}  # a LostSoul's own is 3
    else:
        assert {entity["render_style"] for entity in entities} == {style}
    if speed is not None:
        assert {entity["speed"] for entity in entities} == {speed}


@pytest.mark.parametrize(("batch", "job"), jobs_of("defend_the_center"))
def test_defend_the_center_is_what_it_says(measured, batch, job):
    found, has, levdoom = measured(batch, job), attributes(job), job[1] == "levdoom"
    complete = levdoom and job[0].endswith("/complete")
    gore = {"LiveStick": 5, "HeadsOnAStick": 5, "HeadCandles": 5}
    check_common(found, gore if "gore" in has else {})
    names = Counter(name for name, _, _ in found["start_objects"])
    if "flying_enemies" in has:
        assert found["spawned"] == [[tic, number] for number, tic in enumerate((1, 11, 21, 31, 41), 1)]
        assert names["MarineChainsawVzd" if complete else "LostSoul"] == 1
    else:
        assert found["spawned"] == [[1, 5]]
        assert names["MarineChainsawVzd"] == 3
        assert names["Demon"] == 2
    fast = (20.0 if complete or not levdoom else 15.0) if "fast_enemies" in has else None
    fuzzy = [entity for entity in found["entities"] if entity["render_style"] == 2]
    assert ("fuzzy_enemies" in has) == bool(fuzzy)
    if complete:  # LevDoom's: each is fuzzy with probability 1/2
        others = [entity for entity in found["entities"] if entity not in fuzzy]
        check_entities(others, resized=True, style=None, speed=fast)
    else:
        fuzzy = found["entities"]
    check_entities(fuzzy, resized="resized_enemies" in has, style=2 if "fuzzy_enemies" in has else None, speed=fast)
    if fast is None:
        assert {entity["speed"] for entity in found["entities"]} <= {8.0, 10.0}
    assert {entity["health"] for entity in found["entities"]} == {1}
    factors = {
        "defend_the_center/fast_enemies": 0.3,
        "defend_the_center/gore+mossy_bricks": 0.7,
        "defend_the_center/fuzzy_enemies+resized_enemies": 0.7,
        "defend_the_center/flying_enemies+stone_wall": 0.7,
        "defend_the_center/flying_enemies+mossy_bricks+resized_enemies": 0.85,
        "defend_the_center/fuzzy_enemies+gore+stone_wall": 0.85,
        "defend_the_center/fast_enemies+gore+resized_enemies": 0.85,
        "defend_the_center/fast_enemies+fuzzy_enemies": 0.3,  # no such map of LevDoom's: as fast_enemies
    }
    walking_fast = "fast_enemies" in has and "flying_enemies" not in has
    factor = factors.get(job[0], 1.0) if levdoom else 0.3 if walking_fast else 1.0
    assert found["agent"]["damage_factor"] == near(factor)
    assert found["agent"]["view_height"] == 41
    assert found["start_variables"]["AMMO2"] == 26
    assert {(start["POSITION_X"], start["POSITION_Y"]) for start in found["starts"]} == {(0, 0)}

    deaths = found["deaths"]
    assert deaths["player_kills"] == 1  # of the two, one fell to another enemy
    assert deaths["kill_count"] == 2
    slow_respawn = has & {"fuzzy_enemies", "resized_enemies", "fast_enemies"} and "flying_enemies" not in has
    delay = 150 if levdoom and slow_respawn else 90
    for i, back in enumerate(deaths["back"]):
        assert back["tics"] == pytest.approx(delay + 1, abs=1)
        place = complex(*back["place"])
        assert abs(place) == pytest.approx(735, abs=25)
        distance = abs(place - 735 * cmath.exp(2j * cmath.pi * i / 5))
        assert distance > 25 if levdoom else distance < 25
        if fast is not None:
            assert back["speed"] == fast


ROWS = {  # class, count, x, first and last y, damage factor of the agent
    "mancubus": ("Fatso", 2, 76, 114, 462, 0.5),
    "barons": ("BaronOfHell", 5, 96, 100, 460, 0.4),
    "cacodemons": ("Cacodemon", 5, 96, 100, 480, 0.5),
    "revenants": ("Revenant", 3, 96, 84, 492, 0.3),
    "arachnotron": ("Arachnotron", 1, 56, 288, 288, 0.3),
    "imps": ("DoomImp", 10, 96, 84, 492, 0.7),
}
LEVDOOM_FACTORS = {
    "revenants": 0.2,
    "arachnotron": 0.2,
    "arachnotron+city": 0.4,
    "resized_agent+revenants": 0.5,
    "mancubus+resized_agent": 0.7,
    "flames+flaming_skulls+mancubus": 0.7,
}


@pytest.mark.parametrize(("batch", "job"), jobs_of("dodge_projectiles"))
def test_dodge_projectiles_is_what_it_says(measured, batch, job):
    found, has, levdoom = measured(batch, job), attributes(job), job[1] == "levdoom"
    check_common(found, {"FloatingSkull": 7} if "flaming_skulls" in has else {})
    if "revenants_and_arachnotron" in has:
        wanted = [("Revenant", 96, y) for y in (84, 356, 492)] + [("Arachnotron", 56, 220)]
        factor = 0.3
        if levdoom:
            wanted, factor = [("Arachnotron", 56, y) for y in (140, 290, 440)], 0.5
    else:
        kind, count, x, first, last, factor = ROWS[next(iter(has & ROWS.keys()), "imps")]
        wanted = [(kind, x, first + i * (last - first) / max(count - 1, 1)) for i in range(count)]
        if levdoom:
            factor = LEVDOOM_FACTORS.get(job[0].partition("/")[2], factor)
    kinds = {kind for kind, _, _ in wanted}
    enemies = sorted(tuple(o) for o in found["start_objects"] if o[0] in kinds)
    assert enemies == [(k, pytest.approx(x), pytest.approx(y, abs=0.01)) for k, x, y in sorted(wanted)]
    assert found["start_variables"]["SPAWNED"] == len(wanted)
    check_entities(found["entities"], resized=False, style=None, speed=0.0)
    assert found["agent"]["damage_factor"] == near(factor)
    assert found["start_variables"]["AMMO2"] == 0
    heights = [start["view_height"] for start in found["starts"]]
    if "resized_agent" in has:
        assert min(heights) < 20
        assert 80 < max(heights) <= 100
    else:
        assert set(heights) == {41}
    strip = found["strip"]
    assert -512 + 16 <= strip["min_x"] <= strip["max_x"] <= -448 - 16
    assert strip["min_y"] == pytest.approx(64 + 16, abs=1)
    assert strip["max_y"] == pytest.approx(512 - 16, abs=1)
    assert strip["health"] < 100


HG_SPOTS = {(608, 608), (480, 160), (576, 1088), (160, 640), (1120, 512)}
HG_SPOTS |= {(192, 1088), (896, 1120), (480, 480), (864, 224)}
SUPREME_SPOTS = {(96, 1120), (256, 1600), (928, 1664), (960, 1152), (1696, 1504), (1344, 1184)}
SUPREME_SPOTS |= {(1664, 832), (864, 288), (1760, 448), (1472, 96), (128, 96), (512, 480)}


def check_starts(found: dict, spots: set[tuple[int, int]]):
    places = {(start["POSITION_X"], start["POSITION_Y"]) for start in found["starts"]}
    assert places <= spots
    assert len(places) >= 0.6 * len(spots)  # of 40 uniform draws; chance of fewer below 1e-4


@pytest.mark.parametrize(("batch", "job"), jobs_of("health_gathering"))
def test_health_gathering_is_what_it_says(measured, batch, job):
    found, has, levdoom = measured(batch, job), attributes(job), job[1] == "levdoom"
    complete = levdoom and job[0].endswith("/complete")
    columns = {"TallGreenColumn": 6, "TallRedColumn": 7, "HeartColumn": 4}
    if complete:
        columns = {"TallGreenColumn": 2, "TallRedColumn": 1, "HeartColumn": 2}
    check_common(found, columns if "obstacles" in has else {})

    first, delay = (30, 25) if "supreme" in has else (16, 30)
    assert found["spawned"] == [[1, first + 1], [1 + delay, first + 2], [1 + 2 * delay, first + 3]]
    kit = ("CustomMedikit", 20) if "supreme" in has else ("Medikit", 25)
    kits = {kit}
    if "stimpacks" in has:
        kits = {kit, ("Stimpack", 10)}
        if levdoom:
            special = {"stimpacks": ("Stimpack25", 25), "poison+stimpacks": ("Stimpack20", 20)}
            special["complete"] = ("CustomStimpack", 20)
            kits = {special.get(job[0].partition("/")[2], ("Stimpack", 10))}
    names = Counter(name for name, _, _ in found["start_objects"])
    counts = [names[name] for name, _ in kits]
    assert sum(counts) == first + 1
    assert max(counts) - min(counts) <= 1
    alone = [item for item in found["items"] if item["KITS_TAKEN"] + item["POISONS_TAKEN"] == 1]
    assert {item["change"] for item in alone if item["KITS_TAKEN"]} == {amount for _, amount in kits}
    vials = {item["change"] for item in alone if item["POISONS_TAKEN"]}
    if "poison" in has:
        assert vials == {-29 if levdoom else -30}
        period = (50 if "supreme" in has else 60) if levdoom else 30
        tics = [1, *range(1 + period, 150, period)] if levdoom else [1, *range(31, 150, 30)]
        number = 3 if levdoom else 2
        assert found["poisons"] == [[tic, number + i] for i, tic in enumerate(tics)]
    else:
        assert vials == set()
        assert found["poisons"] == []

    vials_first = (3 if levdoom else 2) if "poison" in has else 0
    style = 66 if "shaded_kits" in has else None
    check_entities(found["entities"][vials_first:], resized="resized_kits" in has, style=style, speed=None)
    assert found["health"] == [[1, 92], [33, 84], [65, 76]]
    assert found["start_variables"]["AMMO2"] == 0
    heights = [start["view_height"] for start in found["starts"]]
    if "short_agent" not in has:
        assert set(heights) == {41}
    elif levdoom:
        assert set(heights) == {0}
    else:
        assert min(heights) < 20
        assert 80 < max(heights) <= 100
    if "supreme" in has:
        check_starts(found, SUPREME_SPOTS)
    elif levdoom:
        check_starts(found, {(608, 608)})
        assert {start["ANGLE"] for start in found["starts"]} == {0}
    else:
        check_starts(found, HG_SPOTS)


MORE_SPOTS = {(640, 1728), (384, 1088), (1152, 1600), (1216, 1024)}
MORE_SPOTS |= {(1184, 352), (640, 192), (64, 864), (352, 656)}
MIXED = ("Zombieman", "MarineChainsawVzd", "DoomImp", "Cacodemon", "LostSoul")
STRONG = ("Arachnotron", "Fatso", "PainElemental", "Archvile", "Revenant")


@pytest.mark.parametrize(("batch", "job"), jobs_of("seek_and_kill"))
def test_seek_and_kill_is_what_it_says(measured, batch, job):
    found, has, levdoom = measured(batch, job), attributes(job), job[1] == "levdoom"
    torches = {"BlueTorch": 9, "GreenTorch": 8, "RedTorch": 8}
    check_common(found, torches if "obstacles" in has else {})
    kinds, each, delay = ("Demon",), 20, 30
    if has & {"mixed_enemies", "invulnerable"}:
        kinds, each, delay = (MIXED if "mixed_enemies" in has else STRONG), 3, 180
    if levdoom and job[0].endswith("/complete"):
        kinds = (*MIXED[:4], "BornSoul", *STRONG)
    first = len(kinds) * each + (levdoom and len(kinds) == 1)  # LevDoom's maps add the next demon at once
    assert found["spawned"] == [[tic, first + len(kinds) * i] for i, tic in enumerate(range(1, 400, delay))]
    names = Counter(name for name, _, _ in found["start_objects"])
    assert {kind: names[kind] for kind in kinds} == dict.fromkeys(kinds, first // len(kinds))

    style = 68 if "shadows" in has else None
    check_entities(found["entities"], resized="resized_enemies" in has, style=style, speed=0.0)
    assert {entity["health"] for entity in found["entities"]} == {1}
    assert found["agent"]["invulnerable"] == ("invulnerable" in has)
    assert found["agent"]["damage_factor"] == 1
    assert found["agent"]["health"] == 100
    assert found["start_variables"]["AMMO2"] == 200
    assert found["deaths"]["player_kills"] == 1
    assert found["deaths"]["kill_count"] == 2
    assert found.get("soul_kills", [1, 0]) == [1, 0]
    check_starts(found, SUPREME_SPOTS if levdoom else SUPREME_SPOTS | MORE_SPOTS)
    assert len({start["ANGLE"] for start in found["starts"]}) > 30


def kills(task_id: str, buttons: list[float], tics: int, seed: int) -> tuple[float, float]:
    """KILLCOUNT and PLAYER_KILLS after so many tics with these buttons held."""
    task = parse_task(task_id)
    wad = compile_task(task).wad_path
    engine = Engine(EngineConfig(wad=wad, buttons=task.scenario.buttons, variables=(), width=160, height=120))
    try:
        engine.new_episode(seed)
        for _ in range(tics // 4):
            if engine.step(buttons, 4) is None:
                break
        return engine.variable("KILLCOUNT"), engine.variable(BOOKKEEPING["PLAYER_KILLS"])
    finally:
        engine.close()


def test_what_the_agent_shoots_is_its_kill():
    all_kills, own = kills("defend_the_center/default", [1, 1, 0], 1100, seed=1)
    assert all_kills == own >= 2


def test_what_enemies_do_to_each_other_is_not():
    both = [kills("seek_and_kill/invulnerable", [0] * 5, 1200, seed) for seed in range(3)]
    assert sum(all_kills for all_kills, _ in both) >= 3
    assert [own for _, own in both] == [0, 0, 0]


def test_the_pages_say_how_many_shots_an_episode_of_seek_and_kill_has_time_for():
    with closing(DoomEnv("seek_and_kill/default")) as env:
        _, info = env.reset(seed=1)
        assert env.task.scenario.buttons[0] == "ATTACK"
        *_, truncated, last = idle_to_the_end(env, action=0)[-1]
    assert truncated
    shots = info["variables"]["AMMO2"] - last["variables"]["AMMO2"]
    assert f"an episode has time for {shots:.0f} shots" in WORDS
    assert f"A held ATTACK fires {shots:.0f} times in an episode" in words_of("docs/benchmark/differences.md")
