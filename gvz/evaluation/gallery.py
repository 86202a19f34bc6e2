"""Pictures of the tasks: a contact sheet of each scenario, and a moving picture of agents at play.

All frames of one map have the same episode seed, the same place and direction of view, and the same moment.
"""

import itertools
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gvz.core.env_config import EnvConfig
from gvz.core.files import written_whole
from gvz.core.libraries import require_learner
from gvz.engine.engine import Engine, EngineConfig
from gvz.engine.probe import ensure_loads
from gvz.env import TICS_PER_SECOND
from gvz.evaluation.choice import EpisodeChoice
from gvz.evaluation.episode_log import simple_player
from gvz.evaluation.panel import LEVEL_COLOURS
from gvz.evaluation.play import Episode, PlayerSpec
from gvz.evaluation.playback import perform
from gvz.evaluation.scenarios.base import Moment, Moving, stated
from gvz.evaluation.zoo import PREFIX, zoo_names
from gvz.scenarios.base import Scenario, Task
from gvz.scenarios.compiler import CompiledTask, compile_task, map_source, task_content
from gvz.scenarios.layout import FIRST_PLACE, MAP_SPOT
from gvz.scenarios.map_set import NUMBERS, MapSet
from gvz.segmentation import segmented_frame, segmenter_of
from gvz.tasks import named_tasks, parse_task, scenarios
from gvz.wad.udmf import UdmfMap, parse_textmap

FRAME_WIDTH, FRAME_HEIGHT = 256, 144
CAPTION_HEIGHT = 16
COLUMNS = 4
NUM_VARIED, NUM_PROCEDURAL = 24, 48
"""maps that the sheets of `varied` and `procedural-train` show"""
SEVERITIES = (0.25, 0.5, 0.75, 1.0)
"""that the sheet of attributes shows"""
PLAN_SIZE = 72
"""pixels of the side of a map's plan"""
LEVEL_DECISIONS = 10
"""decisions that the moving picture shows of each level, in real time"""
_BACKGROUND = (24, 24, 24)


def task_frame(task: Task) -> np.ndarray:
    """What the agent sees in a task at its map's moment: uint8[FRAME_HEIGHT, FRAME_WIDTH, 3].

    Raises:
        EngineError: the engine failed.
    """
    with closing(_engine(compiled := compile_task(task))) as engine:
        return _frame(engine, _moment(task), compiled.map_of(0)[0])


def _moment(task: Task) -> Moment:
    base_wad = task_content(task, "thesis").base_wad
    assert base_wad is not None, "every task has a map"
    moments: Mapping[str, Moment] = stated(task.scenario.id, "MOMENTS") or {}
    return moments.get(base_wad, Moment())


def _engine(compiled: CompiledTask) -> Engine:
    ensure_loads(compiled.wad_path)
    return Engine(
        EngineConfig(
            wad=compiled.wad_path,
            buttons=("TURN_LEFT_RIGHT_DELTA",),
            variables=("ANGLE",),
            width=FRAME_WIDTH,
            height=FRAME_HEIGHT,
            render_weapon=compiled.task.scenario.render_weapon,
            start_tic=10,
        )
    )


def _frame(engine: Engine, moment: Moment, map_wad: bytes | None) -> np.ndarray:
    """The screen at the moment: uint8[FRAME_HEIGHT, FRAME_WIDTH, 3]."""
    engine.new_episode(moment.seed, map_wad)
    engine.advance([0], moment.tics)
    if (pose := moment.pose) is not None:
        engine.command(f"warp {pose.x:g} {pose.y:g}")
        engine.advance([engine.variables()[0] - pose.angle], 1)
        engine.advance([0], 1)
    return engine.screen.copy()


def contact_sheet(scenario: Scenario) -> Image.Image:
    """A labelled frame of each named task of a scenario, level by level."""
    tasks = sorted(named_tasks(scenario.id), key=lambda task: task.level)
    return tiled([(task_frame(task), f"{task.level}  {task.name}", task.level) for task in tasks], COLUMNS)


def varied_sheet(scenario: Scenario) -> Image.Image:
    """A frame of each of the first maps of a scenario's `varied` task."""
    task = Task(scenario, maps=MapSet("varied", NUM_VARIED))
    compiled, moment = compile_task(task), _moment(task)
    with closing(_engine(compiled)) as engine:
        frames = [_frame(engine, moment, compiled.map_of(n)[0]) for n in range(NUM_VARIED)]
    return tiled([(frame, f"map {n}", 0) for n, frame in enumerate(frames)], COLUMNS)


def procedural_sheet(scenario: Scenario) -> Image.Image:
    """The start of an episode on each of the first maps of `procedural-train`, with a plan of the map."""
    task = Task(scenario, maps=MapSet("train"))
    compiled, cells = compile_task(task), []
    with closing(_engine(compiled)) as engine:
        for n in range(NUM_PROCEDURAL):
            frame = _frame(engine, Moment(seed=n, tics=1), compiled.map_of(n)[0])
            plan = map_plan(parse_textmap(map_source(task, "thesis", NUMBERS["train"][n]).textmap))
            frame[: len(plan), FRAME_WIDTH - plan.shape[1] :] = plan
            cells.append((frame, f"map {NUMBERS['train'][n]}", 0))
    return tiled(cells, COLUMNS)


def map_plan(room: UdmfMap) -> np.ndarray:
    """A map from above, north up: uint8[PLAN_SIZE, PLAN_SIZE, 3]; walls white, starts green, other things yellow."""
    corners = np.array([(vertex["x"], vertex["y"]) for vertex in room.vertices], float)
    low, scale = corners.min(axis=0), (PLAN_SIZE - 5) / np.ptp(corners, axis=0).max()

    def pixel(x: float, y: float) -> tuple[float, float]:
        return 2 + scale * (x - low[0]), PLAN_SIZE - 3 - scale * (y - low[1])

    plan = Image.new("RGB", (PLAN_SIZE, PLAN_SIZE), _BACKGROUND)
    draw = ImageDraw.Draw(plan)
    for line in room.linedefs:
        ends = [pixel(*corners[int(line[end])]) for end in ("v1", "v2")]
        draw.line(ends, fill=(128, 128, 128) if line.get("twosided") else (255, 255, 255))
    for thing in room.things:
        place = int(thing.get("id", 0)) >= FIRST_PLACE
        start = thing["type"] in (1, MAP_SPOT) and not place
        colour = (80, 255, 80) if start else (150, 60, 60) if place else (255, 220, 60)
        draw.point(pixel(float(thing["x"]), float(thing["y"])), fill=colour)
    return np.asarray(plan)


def severity_sheet(scenario: Scenario) -> Image.Image:
    """A frame of each attribute alone, at severities from a quarter to the whole."""
    tasks = [
        Task(scenario, (attribute.name,), severities=((attribute.name, severity),))
        for attribute in scenario.attributes
        for severity in SEVERITIES
    ]
    return tiled([(task_frame(task), task.name, 0) for task in tasks], len(SEVERITIES))


def augmented_sheet(scenario: Scenario) -> Image.Image:
    """The default task's frame under each augmentation of `learner.augment`, as it is, at half and at full strength."""
    require_learner("the sheet of augmentations")
    import jax

    from learner.augment import AUGMENTATIONS, augment

    frame, cells = task_frame(parse_task(f"{scenario.id}/default")), []
    for name in AUGMENTATIONS:
        for draw, strength in enumerate((0.0, 0.5, 1.0, 1.0)):
            (seen,) = augment((name,), jax.random.key(draw), jax.numpy.asarray(frame[None]), 3, strength)
            cells.append((np.asarray(seen), f"{name}, strength {strength:g}", 0))
    return tiled(cells, COLUMNS)


def segmented_sheet(scenario: Scenario) -> Image.Image:
    """Frames of the default task and of the gate tasks, each beside what the scenario's network takes it for."""
    segment, cells = segmenter_of(scenario.id, EnvConfig()), []
    for task in (parse_task(f"{scenario.id}/default"), *named_tasks(scenario.id, split="gate")):
        frame = task_frame(task)
        seen = segmented_frame(segment(frame), FRAME_WIDTH, FRAME_HEIGHT)
        cells += [(frame, task.name, task.level), (seen, f"{task.name}, segmented", task.level)]
    return tiled(cells, COLUMNS)


SHEETS = {
    "gallery": contact_sheet,
    "varied": varied_sheet,
    "procedural": procedural_sheet,
    "severity": severity_sheet,
    "augmented": augmented_sheet,
    "segmented": segmented_sheet,
}


def tiled(cells: Sequence[tuple[np.ndarray, str, int]], columns: int) -> Image.Image:
    """Frames in rows, each with its caption below.

    A cell is (uint8[FRAME_HEIGHT, FRAME_WIDTH, 3], caption, level: the caption's colour).
    """
    width, height = FRAME_WIDTH + 2, FRAME_HEIGHT + CAPTION_HEIGHT + 2
    sheet = Image.new("RGB", (columns * width, -(-len(cells) // columns) * height), _BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    for n, (frame, caption, level) in enumerate(cells):
        x, y = n % columns * width, n // columns * height
        sheet.paste(Image.fromarray(frame), (x, y))
        size = next(s for s in range(12, 0, -1) if ImageFont.load_default(s).getlength(caption) < FRAME_WIDTH - 8)
        draw.text((x + 4, y + FRAME_HEIGHT), caption, LEVEL_COLOURS[level], ImageFont.load_default(size))
    return sheet


def write_contact_sheet(scenario: Scenario, directory: Path, kind: str = "gallery") -> Path:
    """Writes `<kind>_<scenario>.png`, a sheet of `SHEETS`, and returns its path."""
    file, sheet = directory / f"{kind}_{scenario.id}.png", SHEETS[kind](scenario)
    # the game has 256 colours: as a palette, the same picture is a third of the size
    picture = sheet.quantize(256, dither=Image.Dither.NONE)
    with written_whole(file) as writing:
        picture.save(writing, optimize=True)
    return file


def moving_frames(player_spec: PlayerSpec, task: Task, first: int, count: int) -> list[np.ndarray]:
    """The screen at decisions `first` .. `first + count - 1` of the player's evaluation episode 0.

    Returns: uint8[FRAME_HEIGHT, FRAME_WIDTH, 3] each; fewer if the episode ends before.
    """
    with closing(perform(player_spec, Episode(task.id, 0))) as moments:
        screens = (moment.screen for moment in moments if moment.decided)
        shown = itertools.islice(screens, first + 1, first + 1 + count)
        return [cv2.resize(screen, (FRAME_WIDTH, FRAME_HEIGHT), interpolation=cv2.INTER_AREA) for screen in shown]


def moving_player(scenario: Scenario) -> PlayerSpec:
    """Who plays in the moving picture: the policy of the zoo that has the scenario's name, or else its script."""
    if scenario.id not in zoo_names():
        return simple_player("scripted", EnvConfig())
    return EpisodeChoice(run_dir=Path(f"{PREFIX}{scenario.id}")).resolve()[0]


def write_moving_picture(file: Path) -> Path:
    """Writes the players of the core scenarios side by side, level after level, as an animated WebP."""
    columns: list[list[tuple[np.ndarray, str, int]]] = []
    for scenario in scenarios().values():
        moving: Moving | None = stated(scenario.id, "MOVING")
        if moving is None:
            continue
        column, player_spec = [], moving_player(scenario)
        for level, name in enumerate(moving.tasks):
            task = parse_task(f"{scenario.id}/{name}")
            frames = moving_frames(player_spec, task, moving.first, LEVEL_DECISIONS)
            column += [(frame, f"{task.scenario.title}, level {level}: {name}", level) for frame in frames]
        columns.append(column)
    pictures = [tiled(cells, 2) for cells in zip(*columns, strict=True)]
    frame_ms = 1000 * EnvConfig().frame_skip // TICS_PER_SECOND
    more = pictures[1:]
    with written_whole(file) as writing:
        pictures[0].save(writing, save_all=True, append_images=more, duration=frame_ms, loop=0, quality=50, method=6)
    return file
