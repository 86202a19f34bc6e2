"""Golden test of the ACS compiler: recompiled SCRIPTS equal the BEHAVIOR that ACC wrote, byte for byte.

The pairs are those of the installed packages vizdoom and levdoom; they are read where they lie, never copied.
"""

import importlib.util
from dataclasses import dataclass
from pathlib import Path

import pytest

from gvz.wad.acs import compile_acs
from gvz.wad.decorate import declared_actors
from gvz.wad.lumps import read_maps, read_wad

EXCLUDED = "deathmatch.wad"
"""its SCRIPTS is cut off: 46 bytes without any script, beside a BEHAVIOR of 680 bytes"""

VIZDOOM_SCENARIOS = {
    *("basic", "basic_audio", "basic_notifications", "cig", "cig_with_unknown", "deadly_corridor"),
    *("defend_the_center", "defend_the_line", "health_gathering", "health_gathering_supreme"),
    *("multi_deathmatch", "multi_duel", "my_way_home", "predict_position", "rocket_basic", "simpler_basic"),
    "take_cover",
}
NUM_LEVDOOM_MAPS = 75
"""of 76 files one, seek_and_slay/maps/resized_shadows_red.wad, is empty"""


@dataclass(frozen=True)
class Pair:
    """Source and object file of one map, and the actor classes its WAD declares."""

    file: Path
    map_name: str
    scripts: bytes
    behavior: bytes
    actors: list[str]

    def __str__(self) -> str:
        return f"{self.file.parent.parent.name}/{self.file.stem}-{self.map_name}"


def pairs_in(package: str, folder: str) -> list[Pair]:
    spec = importlib.util.find_spec(package)
    if spec is None:
        return []  # the tests that count the pairs fail
    pairs = []
    for file in sorted(Path(spec.submodule_search_locations[0], folder).rglob("*.wad")):
        if not file.stat().st_size:
            continue
        lumps = read_wad(file.read_bytes())
        texts = [lump.data.decode("latin-1") for lump in lumps if lump.name == "DECORATE"]
        actors = [name for text in texts for name in declared_actors(text)]
        pairs += [
            Pair(file, name, level["SCRIPTS"], level["BEHAVIOR"], actors) for name, level in read_maps(lumps).items()
        ]
    return pairs


VIZDOOM = pairs_in("vizdoom", "scenarios")
LEVDOOM = pairs_in("levdoom", "envs")


@pytest.mark.parametrize("pair", [p for p in (*VIZDOOM, *LEVDOOM) if p.file.name != EXCLUDED], ids=str)
def test_compiling_equals_what_acc_wrote(pair: Pair):
    assert compile_acs(pair.scripts.decode("latin-1"), actor_classes=pair.actors) == pair.behavior


def test_every_scenario_of_vizdoom_but_the_truncated_one_is_compared():
    compared = {pair.file.stem for pair in VIZDOOM} - {Path(EXCLUDED).stem}
    assert compared >= VIZDOOM_SCENARIOS
    assert len([p for p in VIZDOOM if p.file.name == "cig_with_unknown.wad"]) == 5  # every map of a WAD


def test_the_excluded_source_really_is_truncated():
    (pair,) = [p for p in VIZDOOM if p.file.name == EXCLUDED]
    assert b"script" not in pair.scripts.lower()
    assert b"SPTR" in pair.behavior


def test_every_map_of_levdoom_is_compared():
    assert len(LEVDOOM) == NUM_LEVDOOM_MAPS, (
        "the development dependency levdoom is missing or another version; "
        "run `uv pip install --no-deps levdoom==1.0.3`"
    )
