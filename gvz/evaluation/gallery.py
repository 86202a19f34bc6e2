"""Pictures of the tasks: a contact sheet of each scenario, and the scripted agents at play as a moving picture.

All frames of one map have the same episode seed, the same place and direction of view, and the same moment.
"""

from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gvz.core.env_config import EnvConfig
from gvz.engine.engine import Engine, EngineConfig
from gvz.engine.probe import ensure_loads
from gvz.env import TICS_PER_SECOND, DoomEnv
from gvz.evaluation.play import episode_seed
from gvz.evaluation.players import ScriptedPlayer, player_env
from gvz.scenarios.base import Scenario, Task
from gvz.scenarios.compiler import compile_task, task_content
from gvz.tasks import named_tasks, parse_task

FRAME_WIDTH, FRAME_HEIGHT = 256, 144
CAPTION_HEIGHT = 16
COLUMNS = 4
_BACKGROUND = (24, 24, 24)
_LEVEL_COLOURS = ((235, 235, 235), (140, 220, 140), (230, 220, 110), (240, 165, 80), (240, 100, 90))


@dataclass(frozen=True, slots=True)
class Pose:
    """Where the agent stands and looks: map units, and degrees counterclockwise from east."""

    x: float
    y: float
    angle: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Moment:
    """What the frames of a map have in common."""

    seed: int = 1
    """of the episode"""
    tics: int = 35
    """since its start, of idling"""
    pose: Pose | None = None
    """None: as the episode starts"""


# Found by a search over seeds, poses and tics for frames that show what every attribute of the map's tasks changes;
# tests/evaluation/test_gallery.py says what has to be in sight.
MOMENTS: Mapping[tuple[str, str], Moment] = {
    ("defend_the_center", "defend_the_center.wad"): Moment(seed=4, tics=100, pose=Pose(0, 0, 40)),
    ("dodge_projectiles", "defend_the_line.wad"): Moment(seed=8, tics=80, pose=Pose(-480, 160, 0)),
    ("health_gathering", "health_gathering.wad"): Moment(seed=7, tics=20, pose=Pose(672, 608, 30)),
    ("health_gathering", "health_gathering_supreme.wad"): Moment(seed=196, tics=20, pose=Pose(1376, 928, 240)),
    ("seek_and_kill", "health_gathering_supreme.wad"): Moment(seed=5, tics=2, pose=Pose(700, 1100, 180)),
}
"""(scenario, base map) -> moment"""

MOVING: Mapping[str, tuple[int, tuple[str, ...]]] = {
    "defend_the_center": (32, ("default", "stone_wall", "gore+mossy_bricks", "fast+resized+gore", "complete")),
    "health_gathering": (12, ("default", "lava", "slime+obstacles", "poison+resized+shaded_kits", "complete")),
    "seek_and_kill": (2, ("default", "red", "obstacles+resized", "blue+mixed+resized", "complete")),
    "dodge_projectiles": (24, ("default", "flames", "barons+flaming_skulls", "city+arachnotron", "complete")),
}
"""scenario -> (first decision that is shown, a task of each level): what the moving picture shows"""


def task_frame(task: Task) -> np.ndarray:
    """What the agent sees in a task at its map's moment: uint8[FRAME_HEIGHT, FRAME_WIDTH, 3]."""
    return task_sight(task)[0]


def task_sight(task: Task, moment: Moment | None = None) -> tuple[np.ndarray, dict[str, int]]:
    """What the agent sees in a task at a moment, by default that of the task's map.

    Returns: the screen, uint8[FRAME_HEIGHT, FRAME_WIDTH, 3]; and the pixels that each class of things takes of it.

    Raises:
        EngineError: the engine failed.
    """
    base_wad = task_content(task, "thesis").base_wad
    assert base_wad is not None, "every task has a map"
    moment = MOMENTS[task.scenario.id, base_wad] if moment is None else moment
    compiled = compile_task(task)
    ensure_loads(compiled.wad_path, compiled.map_name)
    engine = Engine(
        EngineConfig(
            wad=compiled.wad_path,
            map_name=compiled.map_name,
            buttons=("TURN_LEFT_RIGHT_DELTA",),
            variables=("ANGLE",),
            width=FRAME_WIDTH,
            height=FRAME_HEIGHT,
            render_weapon=task.scenario.render_weapon,
            labels=True,
            start_tic=10,
        )
    )
    try:
        engine.new_episode(moment.seed)
        engine.advance([0], moment.tics)
        if (pose := moment.pose) is not None:
            engine.command(f"warp {pose.x:g} {pose.y:g}")
            engine.advance([engine.variables()[0] - pose.angle], 1)
            engine.advance([0], 1)
        state = engine.state()
        assert state is not None, "the agent lives"
        assert state.labels is not None
        pixels = dict.fromkeys((label.object_name for label in state.labels), 0)
        for label in state.labels:
            pixels[label.object_name] += int(np.count_nonzero(state.labels_buffer == label.value))
        return engine.screen.copy(), pixels
    finally:
        engine.close()


def contact_sheet(scenario: Scenario) -> Image.Image:
    """A labelled frame of each named task of a scenario, level by level."""
    tasks = sorted(named_tasks(scenario.id), key=lambda task: task.level)
    return tiled([(task_frame(task), f"{task.level}  {task.name}", task.level) for task in tasks], COLUMNS)


def tiled(cells: Sequence[tuple[np.ndarray, str, int]], columns: int) -> Image.Image:
    """Frames in rows, each with its caption below.

    Args:
        cells: (uint8[FRAME_HEIGHT, FRAME_WIDTH, 3], caption, level: the caption's colour).
        columns: cells in a row.
    """
    width, height = FRAME_WIDTH + 2, FRAME_HEIGHT + CAPTION_HEIGHT + 2
    sheet = Image.new("RGB", (columns * width, -(-len(cells) // columns) * height), _BACKGROUND)
    draw = ImageDraw.Draw(sheet)
    for n, (frame, caption, level) in enumerate(cells):
        x, y = n % columns * width, n // columns * height
        sheet.paste(Image.fromarray(frame), (x, y))
        size = next(s for s in range(12, 0, -1) if ImageFont.load_default(s).getlength(caption) < FRAME_WIDTH - 8)
        draw.text((x + 4, y + FRAME_HEIGHT), caption, _LEVEL_COLOURS[level], ImageFont.load_default(size))
    return sheet


def write_contact_sheet(scenario: Scenario, directory: Path) -> Path:
    """Writes `gallery_<scenario>.png` and returns its path."""
    file = directory / f"gallery_{scenario.id}.png"
    # the game has 256 colours: as a palette, the same picture is a third of the size
    contact_sheet(scenario).quantize(256, dither=Image.Dither.NONE).save(file, optimize=True)
    return file


def scripted_frames(task: Task, episode: int, first: int, count: int) -> list[np.ndarray]:
    """The screen at decisions `first` .. `first + count - 1` of the scripted agent's evaluation episode.

    Returns: uint8[FRAME_HEIGHT, FRAME_WIDTH, 3] each; fewer if the episode ends before.
    """
    config = replace(player_env("scripted", EnvConfig()), render_width=FRAME_WIDTH, render_height=FRAME_HEIGHT)
    player, seed, frames = ScriptedPlayer(), episode_seed(task.id, episode), []
    with closing(DoomEnv(task, config, render_mode="rgb_array")) as env:
        observation, info = env.reset(options={"episode_seed": seed})
        player.begin(env, observation, info, seed)
        for decision in range(first + count):
            observation, _, terminated, truncated, info = env.step(np.int64(player.act()))
            player.observe(observation, info)
            screen = env.render()
            if decision >= first and screen is not None:
                frames.append(screen)
            if terminated or truncated:
                break
    return frames


def write_moving_picture(file: Path, level_decisions: int = 10) -> Path:
    """Writes the scripted agents of all scenarios side by side, level after level, as an animated WebP.

    Args:
        file: where to.
        level_decisions: decisions shown of each level, in real time.
    """
    columns: list[list[tuple[np.ndarray, str, int]]] = []
    for scenario_id, (first, names) in MOVING.items():
        column = []
        for level, name in enumerate(names):
            task = parse_task(f"{scenario_id}/{name}")
            frames = scripted_frames(task, 0, first, level_decisions)
            column += [(frame, f"{task.scenario.title}, level {level}: {name}", level) for frame in frames]
        columns.append(column)
    pictures = [tiled(cells, 2) for cells in zip(*columns, strict=True)]
    frame_ms = 1000 * EnvConfig().frame_skip // TICS_PER_SECOND
    pictures[0].save(file, save_all=True, append_images=pictures[1:], duration=frame_ms, loop=0, quality=50, method=6)
    return file
