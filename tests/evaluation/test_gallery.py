"""Pictures: one pose and moment a map, captions that fit, and sheets in the docs that are those the code draws."""

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gvz.commands import gallery
from gvz.core.env_config import EnvConfig
from gvz.engine.engine import Engine, EngineConfig
from gvz.evaluation import gallery as pictures
from gvz.evaluation.episode_log import simple_player
from gvz.evaluation.gallery import (
    COLUMNS,
    FRAME_HEIGHT,
    FRAME_WIDTH,
    SHEETS,
    moving_frames,
    task_frame,
    tiled,
    write_contact_sheet,
)
from gvz.evaluation.scenarios.base import stated
from gvz.scenarios.base import Task
from gvz.scenarios.compiler import task_content
from gvz.scenarios.find_ammunition import DECOYS
from gvz.tasks import LEVELS, all_scenarios, named_tasks, parse_task, scenarios
from learner.augment import AUGMENTATIONS
from tests.full_disk import full_disk

IMAGES = Path(__file__).parents[2] / "docs" / "images"

KITS, COLUMNS_AND_TORCHES = "Medikit CustomMedikit", "HeartColumn TallGreenColumn TallRedColumn BlueTorch GreenTorch"
STRONG = "Arachnotron Fatso PainElemental Archvile Revenant"
SHOWN = {
    "gore": (("HeadCandles HeadsOnAStick LiveStick", 100),),
    "flying_enemies": (("LostSoul PeacefulSoul", 60),),
    "obstacles": ((COLUMNS_AND_TORCHES, 100),),
    "stimpacks": (("Stimpack", 80), (KITS, 80)),
    "poison": (("Poison", 40),),
    "mixed_enemies": (("Zombieman MarineChainsawVzd DoomImp Cacodemon LostSoul", 300),),
    "invulnerable": ((STRONG, 300),),
    "flaming_skulls": (("FloatingSkull", 1000),),
    "mancubus": (("Fatso", 100), ("FatShot", 40)),
    "barons": (("BaronOfHell", 100), ("BaronBall", 10)),
    "cacodemons": (("Cacodemon", 200), ("CacodemonBall", 20)),
    "revenants": (("Revenant", 100), ("RevenantTracer", 40)),
    "arachnotron": (("Arachnotron", 50), ("ArachnotronPlasma", 40)),
    "sergeants": (("ShotgunGuy", 200), ("Goal", 300)),
    "flying_guards": (("Cacodemon", 400), ("Goal", 100)),
    "knights": (("HellKnight", 400), ("Goal", 200)),
    "traps": (("Trap", 200),),
    "barrels": (("ExplosiveBarrel", 100),),
    "hell_knights": (("HellKnight", 100),),
    "imps": (("DoomImp", 200),),
    "boxes": (("BulletBox", 100),),
    "wrong_ammunition": ((" ".join(DECOYS), 80),),
    "decoys": (("RedCard YellowCard RedSkull YellowSkull", 20),),
    "skulls": (("BlueSkull", 100), ("Portal", 1000)),
    "revenants_and_arachnotron": (("Revenant", 80), ("Arachnotron", 50), ("RevenantTracer", 40)),
}
"""attribute -> (classes of things, pixels that they take at least of a tile)"""
ENEMIES = {
    "defend_the_center": ("Demon MarineChainsawVzd", 150),
    "health_gathering": (KITS, 150),
    "seek_and_kill": ("Demon", 300),
    "dodge_projectiles": ("DoomImp", 200),
    "find_ammunition": ("Demon", 200),
    "find_the_key": ("BlueCard", 100),
    "guarded_goal": ("DoomImp", 300),
    "rockets": ("Demon", 100),
}
"""what a task shows whose attributes change no kind of thing"""


EVERY = [task for scenario in all_scenarios() for task in named_tasks(scenario)]


def shown(task: Task) -> list[tuple[str, int]]:
    """What a task's tile has to show."""
    if task.id == "health_gathering/complete":  # shaded: a small kit would not be seen
        return [(KITS, 2000), *SHOWN["poison"], *SHOWN["obstacles"]]
    if task.id == "find_the_key/complete":  # no decoy is in sight from where a key, a portal and columns are
        return [*SHOWN["skulls"], *SHOWN["obstacles"]]
    kinds = {a.name for a in task.scenario.attributes if "entity_type" in a.groups}
    things = [] if kinds & set(task.attributes) else [ENEMIES[task.scenario.id]]
    return things + [thing for name in task.attributes for thing in SHOWN.get(name, ())]


def tiles() -> list:
    """Every named task; those of one engine start each that hid something before are not left to the slow lane."""
    found = []
    for task in EVERY:
        hid = {"stimpacks", "arachnotron"} & set(task.attributes) or task.id == "health_gathering/complete"
        found.append(pytest.param(task, id=task.id, marks=() if hid else pytest.mark.slow))
    return found


def test_every_map_has_its_moment():
    maps = {(task.scenario.id, task_content(task, "thesis").base_wad) for task in EVERY}
    assert maps == {(scenario, wad) for scenario in all_scenarios() for wad in stated(scenario, "MOMENTS")}


def test_the_moving_picture_shows_every_level_of_every_scenario():
    for scenario in scenarios():
        assert [parse_task(f"{scenario}/{name}").level for name in stated(scenario, "MOVING").tasks] == list(LEVELS)


def test_a_sheet_holds_every_frame_unchanged_and_its_caption_beside():
    rng = np.random.default_rng(0)
    frames = [rng.integers(256, size=(FRAME_HEIGHT, FRAME_WIDTH, 3), dtype=np.uint8) for _ in range(5)]
    sheet = np.asarray(tiled([(frame, "caption " * 20, 4) for frame in frames], COLUMNS))
    height, width = sheet.shape[0] // 2, sheet.shape[1] // COLUMNS
    for n, frame in enumerate(frames):
        y, x = n // COLUMNS * height, n % COLUMNS * width
        np.testing.assert_array_equal(sheet[y : y + FRAME_HEIGHT, x : x + FRAME_WIDTH], frame)
        caption = sheet[y + FRAME_HEIGHT : y + height, x : x + width].reshape(-1, 3)
        assert len(np.unique(caption, axis=0)) > 2
        assert (sheet[y : y + height, x + FRAME_WIDTH : x + width] == sheet[0, -1]).all()  # a long one is not cut off


@pytest.mark.engine
def test_a_frame_is_the_same_each_time_and_differs_from_task_to_task():
    default, again, gore = (task_frame(parse_task(f"defend_the_center/{n}")) for n in ("default", "default", "gore"))
    np.testing.assert_array_equal(default, again)
    changed = (default != gore).any(axis=-1).mean()
    assert 0.001 < changed < 0.1  # decorations only: walls, floor, HUD are where they were, so the pose is the same


@pytest.mark.engine
@pytest.mark.parametrize("task", tiles())
def test_a_tile_shows_what_the_attributes_change(task, monkeypatch):
    pixels: dict[str, int] = {}

    class WithLabels(Engine):
        def close(self) -> None:
            state = self.state()
            for label in state.labels:
                shown = int(np.count_nonzero(state.labels_buffer == label.value))
                pixels[label.object_name] = pixels.get(label.object_name, 0) + shown
            super().close()

    monkeypatch.setattr(pictures, "EngineConfig", partial(EngineConfig, labels=True))
    monkeypatch.setattr(pictures, "Engine", WithLabels)
    task_frame(task)
    for classes, least in shown(task):
        assert sum(pixels.get(name, 0) for name in classes.split()) >= least, (classes, pixels)


@pytest.mark.engine
def test_moving_frames_are_those_of_an_evaluation_episode():
    task = parse_task("defend_the_center/default")
    player_spec = simple_player("scripted", EnvConfig())
    whole, part = moving_frames(player_spec, task, 0, 12), moving_frames(player_spec, task, 8, 4)
    assert len(whole) == 12
    np.testing.assert_array_equal(whole[8:], part)


@pytest.mark.parametrize(
    ("kind", "scenario", "num_cells"),
    [
        *(("gallery", one, len(named_tasks(one))) for one in all_scenarios()),
        *(("augmented", one, COLUMNS * len(AUGMENTATIONS)) for one in scenarios()),
        *(("segmented", one, 2 * (1 + len(named_tasks(one, split="gate")))) for one in scenarios()),
    ],
)
def test_the_sheets_in_the_docs_show_all_that_they_are_to_show(kind, scenario, num_cells):
    file = IMAGES / f"{kind}_{scenario}.png"
    assert file.stat().st_size < 700_000
    with Image.open(file) as sheet:
        rows = -(-num_cells // COLUMNS)
        assert sheet.height % rows == 0
        assert sheet.height // rows > FRAME_HEIGHT


def test_segmented_sheets_are_drawn_of_the_scenarios_that_have_a_network(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        "gvz.evaluation.gallery.write_contact_sheet", lambda scenario, _, kind: drawn.append((scenario.id, kind))
    )
    assert gallery.COMMAND(out=tmp_path, kind="segmented").run() == 0
    assert drawn == [(name, "segmented") for name in scenarios()]


def test_on_a_full_disk_the_sheet_of_before_stays_whole(tmp_path, monkeypatch):
    noise = Image.fromarray(np.random.default_rng(1).integers(0, 256, (64, 64, 3), np.uint8))
    monkeypatch.setitem(SHEETS, "gallery", lambda _: noise)
    [scenario, *_] = scenarios().values()
    file = write_contact_sheet(scenario, tmp_path)
    before = file.read_bytes()
    with full_disk(100), pytest.raises(OSError, match="File too large"):
        write_contact_sheet(scenario, tmp_path)
    assert [(path, path.read_bytes()) for path in tmp_path.iterdir()] == [(file, before)]


def test_the_sheet_of_severities_in_the_docs_shows_every_attribute():
    attributes = all_scenarios()["defend_the_center"].attributes
    with Image.open(IMAGES / "severity_defend_the_center.png") as sheet:
        assert sheet.height % len(attributes) == 0
        assert sheet.height // len(attributes) > FRAME_HEIGHT


@pytest.mark.slow
@pytest.mark.engine
@pytest.mark.parametrize("scenario", all_scenarios().values(), ids=lambda s: s.id)
def test_the_sheets_in_the_docs_are_those_the_code_draws(scenario, tmp_path):
    with (
        Image.open(write_contact_sheet(scenario, tmp_path)) as drawn,
        Image.open(IMAGES / f"gallery_{scenario.id}.png") as shown,
    ):
        np.testing.assert_array_equal(np.asarray(drawn.convert("RGB")), np.asarray(shown.convert("RGB")))
