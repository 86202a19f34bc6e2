"""Profile levdoom against the author's own maps: the WADs of the package levdoom 1.0.3, read where it is installed.

What an author's map says is taken from its TEXTMAP by our parser, and from its SCRIPTS by regular expressions.
"""

import importlib.util
import re
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from gvz.scenarios.base import Chance, Uniform
from gvz.scenarios.compiler import map_source, task_content
from gvz.tasks import named_tasks, parse_task
from gvz.wad.lumps import MAP_NAME, read_maps, read_wad
from gvz.wad.stock import engine_directory
from gvz.wad.udmf import UdmfMap, parse_textmap

MISSING = (
    "defend_the_center/fast_enemies+fuzzy_enemies",
    "defend_the_center/gore+resized_enemies",
    "health_gathering/short_agent+water",
    "health_gathering/resized_kits+shaded_kits",
)
"""tasks of the thesis that its author never made a map for"""

FILES = {
    "fast_enemies+flying_enemies": "fast_flying_enemies",
    "fuzzy_enemies+resized_enemies": "resized_fuzzy_enemies",
    "flying_enemies+stone_wall": "stone_wall_flying_enemies",
    "flying_enemies+mossy_bricks+resized_enemies": "resized_flying_enemies_mossy_bricks",
    "fuzzy_enemies+gore+stone_wall": "gore_stone_wall_fuzzy_enemies",
    "fast_enemies+gore+resized_enemies": "fast_resized_enemies_gore",
    "barons+flaming_skulls": "barons_flaming_skulls",
    "arachnotron+city": "city_arachnotron",
    "obstacles+slime": "slime_obstacles",
    "shaded_kits+stimpacks": "shaded_stimpacks",
    "poison+supreme": "supreme_poison",
    "lava+resized_kits": "resized_kits_lava",
    "poison+stimpacks": "stimpacks_poison",
    "lava+short_agent+supreme": "lava_supreme_short_agent",
    "poison+resized_kits+shaded_kits": "poison_resized_shaded_kits",
    "mixed_enemies+red": "red_mixed_enemies",
    "blue+invulnerable": "invulnerable_blue",
    "red+resized_enemies": "resized_enemies_red",
    "obstacles+shadows": "shadows_obstacles",
    "blue+mixed_enemies+resized_enemies": "blue_mixed_resized_enemies",
    "invulnerable+obstacles+red": "red_obstacles_invulnerable",
    "invulnerable+resized_enemies+shadows": "resized_shadows_invulnerable",
}
"""task -> file, where the file is not just the task's name with underscores"""

COUNTING_MARINE = "its MarineChainsaw does not count as a kill; ours is a child of it that does"
DEAD_CODE = "its damage factor stands behind an endless loop and is never set"
DIFFERENCES = {
    **{
        ("defend_the_center/complete", key): "its second marine never appears: the first stands at its place"
        for key in ("classes", "num_enemies")
    },
    ("dodge_projectiles/complete", "things"): "one skull stands 32 units off its place in flaming_skulls",
    ("health_gathering/resized_kits", "entity"): "it also shades the kit that is not there yet: no effect",
    ("health_gathering/complete", "things"): "its sixth obstacle stands where an agent starts; ours leaves it out",
    ("seek_and_kill/complete", "wall"): "one of its 117 walls is FIREBLU2",
    ("seek_and_kill/complete", "agent"): DEAD_CODE,
    ("seek_and_kill/complete", "classes"): COUNTING_MARINE,
    **{
        (f"seek_and_kill/{task}", key): reason
        for task in ("mixed_enemies", "mixed_enemies+red", "blue+mixed_enemies+resized_enemies")
        for key, reason in (("agent", DEAD_CODE), ("classes", COUNTING_MARINE))
    },
}
"""(task, what) -> why ours is not the author's"""

FULL_DAMAGE = ("DamageFactor", 1.0)
"""the engine's own value: setting it is not setting it"""

SHARED = [task.id for task in named_tasks() if task.id not in MISSING]


def authors_wad(task_id: str) -> Path:
    scenario, _, name = task_id.partition("/")
    spec = importlib.util.find_spec("levdoom")
    assert spec is not None
    assert spec.submodule_search_locations
    folder = scenario.replace("seek_and_kill", "seek_and_slay")
    file = FILES.get(name, name.replace("+", "_"))
    return Path(spec.submodule_search_locations[0]) / "envs" / folder / "maps" / f"{file}.wad"


def describe_map(drawn: UdmfMap, base: UdmfMap) -> dict[str, Any]:
    def things(one: UdmfMap) -> Counter:
        return Counter((t["type"], t["x"], t["y"]) for t in one.things if t["type"] != 9001)

    return {
        "wall": {side["texturemiddle"] for side in drawn.sidedefs if "texturemiddle" in side},
        "floor": {sector["texturefloor"] for sector in drawn.sectors},
        "ceiling": {sector["textureceiling"] for sector in drawn.sectors},
        "things": things(drawn) - things(base),
    }


class Script:
    """What one of the author's scripts says."""

    def __init__(self, text: str):
        self.text = re.sub(r"//[^\n]*", "", text)
        self.names = dict(re.findall(r"int (\w+) = ([\d.]+);", self.text))
        self.names |= dict(re.findall(r"^\s*(height) = ([^;]+);", self.text, re.M))

    def value(self, text: str) -> Any:
        """A number, (low, high) of a random one, or the text itself."""
        text = self.names.get(text.strip(), text.strip())
        if text in self.names:
            return self.value(text)
        if drawn := re.fullmatch(r"random\((.+), (.+)\)", text, re.I):
            return Uniform(self.value(drawn[1]), self.value(drawn[2]))
        return float(text) if re.fullmatch(r"[\d.]+", text) else text.upper()

    def number(self, pattern: str) -> float:
        """The first group of the only match of `pattern`, as a number."""
        found = set(re.findall(pattern, self.text, re.I))
        assert len(found) == 1, (pattern, found)
        return self.value(found.pop())

    def properties(self, *, agent: bool) -> dict[str, Any]:
        calls = re.findall(r"SetActorProperty\((\w+), APROP_(\w+), (.+?)\);", self.text)
        return {name: self.value(value) for tid, name, value in calls if (tid == "0") == agent}

    def classes(self) -> tuple[str, ...]:
        array = re.search(r"str \w+\[\d+\] = \{([^}]*)\}", self.text)
        return tuple(re.findall(r'"(\w+)"', array[1] if array else ""))


def author_says(scenario: str, script: Script, decorate: str) -> dict[str, Any]:
    says = {"entity": script.properties(agent=False), "agent": script.properties(agent=True)}
    if scenario == "defend_the_center":
        calls = len(re.findall(r"^\s*SpawnTarget\(\d", script.text, re.M))
        loop = re.search(r"i < (n_monsters \* 2|5)", script.text)
        says |= {
            "classes": script.classes(),
            "num_enemies": {"5": 5, "n_monsters * 2": 6}[loop[1]] if loop else calls,
            "radius": script.value("r"),
            "respawn_delay": float(re.findall(r"delay\((\d\d+)\)", script.text)[-1]),
            "spawn_delay": 10.0 if loop and "delay(10)" in script.text else 0.0,
            "bullets": script.number(r'"ClipBox", (\d+)'),
            "fuzzy_share": 0.5 if "if (random(0.0, 1.0) > 0.5)" in script.text else 1,
        }
    elif scenario == "health_gathering":
        kits = set(re.findall(r'Spawn\("(\w+)"', script.text)) - {"Poison"}
        assert len(kits) == 1
        kit = kits.pop()
        amount = re.search(rf"ACTOR {kit} .*?Inventory.Amount (\d+)", decorate, re.S)
        stock = {"Medikit": 25, "Stimpack": 10}
        poison = "SpawnPoison" in script.text
        delay = script.value("spawn_delay")
        says |= {
            "heals": {int(amount[1]) if amount else stock[kit]},
            "num_kits": script.number(r"int start_(?:medikits|stimpacks)_quantity = (\d+)"),
            "kit_delay": delay,
            "map_size": script.value("wall_size"),
            "num_poisons": script.value("start_poison_quantity") if poison else 0,
            "poison_delay": 2 * delay if poison else 0,
        }
    elif scenario == "seek_and_kill":
        says |= {
            "classes": script.classes() or ("Demon",),
            "num_per_class": script.value("start_monsters_quantity"),
            "first_delay": script.value("spawn_delay") if re.search(r"while ?\(1\) ?{\s*delay", script.text) else 0,
            "spawn_delay": script.value("spawn_delay"),
            "map_size": script.value("map_size"),
            "last_spot": script.number(r"target_id = random\(10, ?(\d+)\)"),
            "bullets": script.number(r'"Clip", (\d+)'),
        }
    else:
        kind = re.search(r'Spawn\("(\w+)", (\w+), (\w+)', script.text)
        assert kind
        count = re.search(r"int n_\w+ = (\d+)", script.text)
        number = int(count[1]) if count else 1
        ends = re.findall(r"int \w+_y(?:_min|_max)? = ([\d.]+)", script.text)
        first, last = float(ends[0]), float(ends[-1])
        ys = [first + i * (last - first) / max(number - 1, 1) for i in range(number)]
        says["enemies"] = [(kind[1], script.value(kind[2]), round(y, 3)) for y in ys]
    return says


def ours(task_id: str) -> dict[str, Any]:
    content = task_content(parse_task(task_id), "levdoom")
    said: dict[str, Any] = {**content.parameters}
    style = content.entity.get("RenderStyle")
    said["fuzzy_share"] = style.share if isinstance(style, Chance) else 1
    entity = {name: value.value if isinstance(value, Chance) else value for name, value in content.entity.items()}
    said["entity"] = {k: v.upper() if isinstance(v, str) else v for k, v in entity.items()}
    said["agent"] = {name: value for name, value in content.agent.items() if (name, value) != FULL_DAMAGE}
    script = parse_task(task_id).scenario.script
    if bullets := re.search(r'"(?:ClipBox|Clip)", (\d+)', script):
        said["bullets"] = int(bullets[1])
        said["entity"]["Health"] = 1
    if task_id.startswith("dodge"):
        ys = [round(y, 3) for y in said["ys"]]
        said["enemies"] = list(zip(said["classes"], said["xs"], ys, strict=True))
    if task_id.startswith("health"):
        amounts = {"Medikit": 25, "Stimpack": 10}
        for name, text in content.actors.items():
            amounts[name] = int(re.findall(r"Inventory.Amount (\d+)", text)[0])
        said["heals"] = {amounts[said[kit].strip('"')] for kit in ("even_kit", "odd_kit")}
    return said


@pytest.mark.parametrize("task_id", SHARED)
def test_profile_levdoom_agrees_with_the_authors_map(task_id: str):
    task = parse_task(task_id)
    lumps = read_wad(authors_wad(task_id).read_bytes())
    theirs = read_maps(lumps)[MAP_NAME]
    decorate = b"".join(lump.data for lump in lumps if lump.name == "DECORATE").decode("latin-1")
    content = task_content(task, "levdoom")
    assert content.base_wad
    base_wad = (engine_directory() / "scenarios" / content.base_wad).read_bytes()
    base = parse_textmap(read_maps(read_wad(base_wad))[MAP_NAME]["TEXTMAP"].decode())

    want = describe_map(parse_textmap(theirs["TEXTMAP"].decode("latin-1")), base)
    want |= author_says(task.scenario.id, Script(theirs["SCRIPTS"].decode("latin-1")), decorate)
    got = describe_map(parse_textmap(map_source(task, "levdoom").textmap), base) | ours(task_id)
    differing = {key for key, value in want.items() if got[key] != value}
    assert differing == {key for task, key in DIFFERENCES if task == task_id}, {
        key: (got[key], want[key]) for key in differing
    }


def test_the_author_made_no_map_for_the_four_missing_tasks():
    assert [authors_wad(task_id).exists() for task_id in MISSING] == [False] * 4
    assert len(SHARED) == 72
