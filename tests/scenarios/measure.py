"""Plays compiled tasks in real engines and writes down what it finds; a process of its own, started by conftest.py.

Reads jobs from standard input, a JSON list of [task id, profile]; writes one JSON object a job to standard output.
A map that the engine does not like ends this process, so a job without an answer is a bad map.

Each map gets a few scripts more that read and change the running game at our command (`puke`).
"""

import dataclasses
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

import vizdoom

from gvz.scenarios.base import BOOKKEEPING
from gvz.scenarios.compiler import build_wad, compile_task, map_source
from gvz.tasks import parse_task
from gvz.wad.lumps import MAP_NAME

PROBE = """
global int 41:health; global int 42:speed; global int 43:render_style; global int 44:scale_x; global int 45:scale_y;
global int 46:damage_factor; global int 47:view_height; global int 48:invulnerable; global int 49:x; global int 50:y;
global int 51:calls;

script 900 (int tid)
{
    health = GetActorProperty(tid, APROP_Health);
    speed = GetActorProperty(tid, APROP_Speed);
    render_style = GetActorProperty(tid, APROP_RenderStyle);
    scale_x = GetActorProperty(tid, APROP_ScaleX);
    scale_y = GetActorProperty(tid, APROP_ScaleY);
    damage_factor = GetActorProperty(tid, APROP_DamageFactor);
    view_height = GetActorProperty(tid, APROP_ViewHeight);
    invulnerable = GetActorProperty(tid, APROP_Invulnerable);
    x = GetActorX(tid);
    y = GetActorY(tid);
    calls++;
}

script 901 (int tid, int killer)
{
    if (killer != 0)
        SetActivator(killer);
    Thing_Damage2(tid, 10000, "None");
}

script 902 (int tid)
{
    SetActorProperty(0, APROP_Health, 50);
    SetActorPosition(0, GetActorX(tid), GetActorY(tid), 0.0, 0);
}

script 903 (void)
{
    SetActorProperty(0, APROP_Invulnerable, TRUE);
}

script 904 (int tid)
{
    Spawn("LostSoul", 640.0, 1728.0, 30.0, tid);
}
"""
PROPERTIES = ("health", "speed", "render_style", "scale_x", "scale_y")
PROPERTIES = (*PROPERTIES, "damage_factor", "view_height", "invulnerable", "x", "y")
"""what script 900 reads, in the order of its variables"""
INTEGERS = ("health", "render_style", "invulnerable")
"""those that are not fixed-point numbers"""
FIRST_TID = {"defend_the_center": 100, "dodge_projectiles": 100, "health_gathering": 1000, "seek_and_kill": 1000}


class Player:
    """One game, stepped a tic at a time."""

    def __init__(self, task_id: str, profile: Any):
        task = parse_task(task_id)
        source = map_source(task, profile)
        assert source.map_magic == compile_task(task, profile).map_magic
        wad = Path(f"{source.map_magic}.wad").resolve()
        wad.write_bytes(build_wad(dataclasses.replace(source, script=source.script + PROBE)))
        self.scenario = task.scenario
        self.log = wad.with_suffix(".log")
        self.game = game = vizdoom.DoomGame()
        game.set_doom_scenario_path(str(wad))
        game.set_doom_map(MAP_NAME)
        game.set_doom_skill(3)
        game.set_screen_resolution(vizdoom.ScreenResolution.RES_160X120)
        game.set_available_buttons([getattr(vizdoom.Button, name) for name in task.scenario.buttons])
        game.set_window_visible(False)
        game.set_objects_info_enabled(True)
        game.set_episode_timeout(0)
        game.set_seed(1)
        game.add_game_args(f"+logfile {self.log}")
        game.init()

    def __getitem__(self, name: str) -> float:
        name = BOOKKEEPING.get(name, name)
        return self.game.get_game_variable(getattr(vizdoom.GameVariable, name))

    def step(self, button: str | None = None, tics: int = 1) -> None:
        self.game.make_action([float(button == name) for name in self.scenario.buttons], tics)

    def command(self, script: int, *arguments: int) -> None:
        self.game.send_game_command(" ".join(map(str, ("puke", script, *arguments))))
        self.step()

    def properties(self, tid: int) -> dict[str, float]:
        """What the engine says of the actor with this tid; 0 is the agent."""
        calls = self["USER51"]
        self.command(900, tid)
        assert self["USER51"] == calls + 1
        values = {name: self[f"USER{41 + i}"] for i, name in enumerate(PROPERTIES)}
        return {name: v if name in INTEGERS else v / 65536 for name, v in values.items()}

    def objects(self, *names: str) -> list[tuple[str, float, float]]:
        """(name, x, y) of everything on the map, or of the things of these names."""
        found = self.game.get_state().objects
        return [(o.name, o.position_x, o.position_y) for o in found if not names or o.name in names]

    def restart(self, seed: int) -> None:
        self.game.set_seed(seed)
        self.game.new_episode()

    def timeline(self, name: str, tics: int) -> list[tuple[int, float]]:
        """(tic, value) wherever the variable changes."""
        changes = [(self.game.get_episode_time(), self[name])]
        if self.scenario.metric == "kills":
            self.command(903)  # or many enemies end the episode too soon
        for _ in range(tics):
            if self[name] != changes[-1][1]:
                changes.append((self.game.get_episode_time(), self[name]))
            self.step()
        return changes


def measure(task_id: str, profile: str) -> dict[str, Any]:
    """Everything the tests want to know of one task."""
    player = Player(task_id, profile)
    scenario, first_tid = player.scenario.id, FIRST_TID[player.scenario.id]
    found: dict[str, Any] = {
        "magic_right": player["MAP_MAGIC"] == compile_task(parse_task(task_id), profile).map_magic,
        "start_objects": player.objects(),
        "start_variables": {name: player[name] for name in ("HEALTH", "AMMO2", "KILLCOUNT", *BOOKKEEPING)},
        "agent": player.properties(0),
    }
    player.restart(1)
    found["spawned"] = player.timeline("SPAWNED", 400 if scenario == "seek_and_kill" else 75)
    player.restart(1)
    if scenario == "defend_the_center":
        while player["SPAWNED"] < found["spawned"][-1][1]:
            player.step()
    count = int(player["SPAWNED"])
    found["entities"] = [player.properties(first_tid + i) for i in range(count)]
    if scenario in ("defend_the_center", "seek_and_kill"):
        found["deaths"] = _deaths(player, first_tid)
    if scenario == "seek_and_kill" and "invulnerable" in task_id:
        found["soul_kills"] = _soul_kills(player)
    if scenario == "health_gathering":
        found["items"] = _items(player)
        player.restart(1)
        found["health"] = player.timeline("HEALTH", 75)
        found["poisons"] = _poisons(player)
    if scenario == "dodge_projectiles":
        found["strip"] = _strip(player)
    found["starts"] = []
    for seed in range(40):
        player.restart(seed)
        start = {name: player[name] for name in ("POSITION_X", "POSITION_Y", "ANGLE")}
        found["starts"].append({**start, "view_height": player.properties(0)["view_height"]})
    player.game.close()
    found["log"] = player.log.read_text(errors="replace")
    return found


def _deaths(player: Player, tid: int) -> dict[str, Any]:
    """Kills two enemies, one as the agent and one as the third enemy, and watches them come back."""
    before, count = player["PLAYER_KILLS"], int(player["SPAWNED"])
    player.command(901, tid, 0)
    killed_at = player.game.get_episode_time()
    player.command(901, tid + 1, tid + 2)
    player.step(tics=2)
    result = {"player_kills": player["PLAYER_KILLS"] - before, "kill_count": player["KILLCOUNT"], "back": []}
    if player.scenario.id == "defend_the_center":
        for i in range(2):
            while player["SPAWNED"] <= count + i:
                player.step()
            tics = player.game.get_episode_time() - killed_at - i
            now = player.properties(tid + count + i)
            result["back"].append({"tics": tics, "place": (now["x"], now["y"]), "speed": now["speed"]})
    return result


def _soul_kills(player: Player) -> list[float]:
    """PLAYER_KILLS brought by the death of a soul that a Pain Elemental might have borne: by the agent, by an enemy."""
    kills = []
    for tid, killer in ((9, 0), (10, FIRST_TID["seek_and_kill"] + 2)):
        before = player["PLAYER_KILLS"]
        player.command(904, tid)
        player.step(tics=3)
        player.command(901, tid, killer)
        player.step(tics=3)
        kills.append(player["PLAYER_KILLS"] - before)
    return kills


def _items(player: Player) -> list[dict[str, float]]:
    """Walks over the first items, at 50 health each time; the floor's blows come every 32 tics, so between them."""
    items = []
    for tid in range(FIRST_TID["health_gathering"], FIRST_TID["health_gathering"] + 12):
        while player.game.get_episode_time() % 32 not in range(2, 20):
            player.step()
        before = {name: player[name] for name in ("KITS_TAKEN", "POISONS_TAKEN")}
        player.command(902, tid)
        for _ in range(4):
            player.step("MOVE_FORWARD")
        taken = {name: player[name] - number for name, number in before.items()}
        items.append({**taken, "change": player["HEALTH"] - 50})
    return items


def _poisons(player: Player) -> list[tuple[int, int]]:
    """(tic, vials on the map) wherever their number changes."""
    player.restart(1)
    changes = [(0, 0)]
    for _ in range(150):
        number = sum(name == "Poison" for name, _, _ in player.objects())
        if number != changes[-1][1]:
            changes.append((player.game.get_episode_time(), number))
        player.step()
    return changes[1:]


def _strip(player: Player) -> dict[str, float]:
    """Walks to both ends under fire; the ends of where the agent was, and its health at last."""
    player.restart(1)
    places = []
    for button, tics in (("MOVE_LEFT", 60), ("MOVE_RIGHT", 120), ("SPEED", 170)):
        for _ in range(tics):
            if not player.game.is_episode_finished():
                player.step(button)
                places.append((player["POSITION_X"], player["POSITION_Y"]))
    xs, ys = zip(*places, strict=True)
    ends = {"min_x": min(xs), "max_x": max(xs), "min_y": min(ys), "max_y": max(ys)}
    return {**ends, "health": player["HEALTH"]}


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as directory:
        os.chdir(directory)
        for job in json.load(sys.stdin):
            print(json.dumps(measure(*job)), flush=True)
