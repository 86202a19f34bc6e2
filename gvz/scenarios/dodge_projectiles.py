"""Dodge Projectiles: enemies shoot at the agent, which can only step aside.

Ability tested: seeing missiles, and stepping aside in time.
Actions: SPEED, MOVE_LEFT, MOVE_RIGHT; the agent faces the enemies and cannot turn.
Observation: the screen with HUD, no weapon; variable HEALTH.
Reward (eq. 3.6): 0.01 - [health fell].
Start: a strip 64 units wide at one end of a room; enemies that never move stand along the other end.
    The enemy type sets the agent's damage factor, so that tasks of one level are about equally hard.
Termination: the agent dies. Truncation: after 2100 tics.
Metric: frames alive, at most the time-out.
Attributes: thesis B.4, below. Revenants count as two attributes (their missiles home), and so does the Arachnotron
    (it fires rapidly). `complete` has both kinds, and city for its textures. Tasks: thesis Table A.4.
Differs: the enemies have their normal health, as in the author's maps; the agent has no weapon.
"""

import random
from dataclasses import replace
from functools import partial

from gvz.scenarios.base import Attribute, Content, Scenario, Textures, Value, Variety, words
from gvz.scenarios.layout import Layout, ring, vary
from gvz.scenarios.parts import SHORT_AGENT, retextured, things_at
from gvz.scenarios.rewards import HISTORY_STEPS, Fell, Pace, Reward, living, moved
from gvz.wad.udmf import UdmfMap

WAD = "defend_the_line.wad"
NUM_IMPS = 10

SCRIPT = """\
#include "zcommon.acs"

global int 2:num_spawned;
global int 60:map_magic;

str classes[$num_classes] = $classes;
int xs[$num_xs] = $xs;
int ys[$num_ys] = $ys;

script 1 OPEN
{
    num_spawned = 0;
    map_magic = $map_magic;
    for (int i = 0; i < $num_classes; i++)
    {
        int tid = 100 + i;
        num_spawned += Spawn(classes[i], xs[i], ys[i], 0.0, tid, 128);
        $entity_properties
    }
}

script 2 ENTER
{
    ClearInventory();
    $agent_properties
}
"""


def draw_cage(room: UdmfMap) -> None:
    """Draws a line from wall to wall that walkers cannot cross, 64 units before the wall behind the agent.

    Missiles fly over it. Without it a hit would push the agent off its strip, and it could walk through the room.
    """
    back, north, south, front = -512.0, 512.0, 64.0, -448.0
    corners = {(back, north), (back, south)}
    assert corners < {(v["x"], v["y"]) for v in room.vertices}, "the base map is the expected room"
    for y in (north, south):
        room.vertices.append({"x": front, "y": y})
        room.sidedefs.append({"sector": 0})
    room.linedefs.append(
        {
            "v1": len(room.vertices) - 2,
            "v2": len(room.vertices) - 1,
            "sidefront": len(room.sidedefs) - 2,
            "sideback": len(room.sidedefs) - 1,
            "twosided": True,
            "blocking": True,
        }
    )


def _row(kind: str, count: int, x: float, first_y: float, last_y: float) -> dict[str, Value]:
    """Script parameters of `count` enemies in a row, at equal distances."""
    gap = (last_y - first_y) / max(count - 1, 1)
    return {
        "classes": (kind,) * count,
        "xs": (x,) * count,
        "ys": tuple(first_y + gap * place for place in range(count)),
    }


def _enemies(
    name: str,
    row: dict[str, Value],
    damage_factor: float,
    levdoom_damage_factor: float,
    trait: str | None = None,
) -> Attribute:
    """An attribute that replaces the imps by a row of other enemies."""
    return Attribute(
        name=name,
        groups=("entity_type",) if trait is None else ("entity_type", trait),
        content=Content(parameters=row, agent={"DamageFactor": damage_factor}),
        levdoom=Content(agent={"DamageFactor": levdoom_damage_factor}),
    )


SKULLS = {42: ((-192, 416), (-224, 320), (-256, 256), (-288, 96), (-288, 480), (-320, 192), (-288, 384))}
"""editor number -> places of floating skulls; missiles pass over them"""


def near_agent_or_enemies(x: float, _y: float, row: float = 96.0) -> bool:
    """Whether a place is close to the agent's strip or to the row in which enemies stand."""
    return not -320 <= x <= row - 80


def draw_room(rng: random.Random, strength: float) -> Layout:
    """A room without cover, 512 to 832 units deep, as wide at the enemies' end as by default or up to 1.4 times.

    The strip is 0.65 to 1.35 times as long as by default. Behind the enemies the wall is straight, or has a corner.
    """
    back, middle = -512.0, 288.0
    row = 16 * round(vary(rng, strength, 96, -32, 288) / 16)
    strip, width = (8 * round(224 * vary(rng, strength, 1, *ends) / 8) for ends in ((0.65, 1.35), (1, 1.4)))
    bulge = strength * max(0.0, rng.uniform(-100, 200))
    left = [(back, middle + strip), (back + 64, middle + strip), (row + 32, middle + width)]
    tip = [(row + 32 + bulge, middle)] if bulge >= 16 else []
    corners = [*left, *tip, *((x, 2 * middle - y) for x, y in reversed(left))]
    last = min(width, strip + (width - strip) * (row - back - 64) / (row - back - 32)) - 36  # off the side walls
    ys = tuple(middle + last * (2 * n / (NUM_IMPS - 1) - 1) for n in range(NUM_IMPS))
    return Layout(
        walls=ring(corners),
        barriers=((left[1], (back + 64, middle - strip)),),
        starts=((back + 32, middle),),
        height=round(vary(rng, strength, 104, 96, 240)),
        parameters={"xs": (float(row),) * NUM_IMPS, "ys": ys},
        places=tuple((row, y) for y in ys),
        keep_clear=partial(near_agent_or_enemies, row=row),
    )


SCENARIO = Scenario(
    id="dodge_projectiles",
    title="Dodge Projectiles",
    suite="core",
    script=SCRIPT,
    draw_map=draw_cage,
    content=Content(
        base_wad=WAD,
        textures=Textures("BRICK12", "CRATOP1", "CRATOP1"),
        parameters=_row("DoomImp", NUM_IMPS, 96.0, 84.0, 492.0),
        entity={"Speed": 0.0},
        agent={"DamageFactor": 0.7},
    ),
    variety=Variety(
        entities=("DoomImp",),
        entity_parameters=("classes",),
        max_decorations=10,
        solid=False,  # what stops missiles would change the game
        keep_clear=near_agent_or_enemies,
        draw_layout=draw_room,
    ),
    attributes=(
        retextured("city", "SKY2", "ROCKRED1", "CEIL4_1"),
        retextured("flames", "SWATER1", "RROCK02", "CAVERN1"),
        Attribute(name="flaming_skulls", groups=("decorations",), content=Content(things={WAD: things_at(SKULLS)})),
        _enemies("mancubus", _row("Fatso", 2, 76.0, 114.0, 462.0), 0.5, 0.5),
        _enemies("barons", _row("BaronOfHell", 5, 96.0, 100.0, 460.0), 0.4, 0.4),
        _enemies("cacodemons", _row("Cacodemon", 5, 96.0, 100.0, 480.0), 0.5, 0.5),
        _enemies("revenants", _row("Revenant", 3, 96.0, 84.0, 492.0), 0.3, 0.2, "homing"),
        _enemies("arachnotron", _row("Arachnotron", 1, 56.0, 288.0, 288.0), 0.3, 0.2, "rapid_fire"),
        Attribute(  # both traits for `complete`; the thesis names no single enemy that has both
            name="revenants_and_arachnotron",
            groups=("entity_type", "homing", "rapid_fire"),
            content=Content(
                parameters={
                    "classes": ("Revenant", "Arachnotron", "Revenant", "Revenant"),
                    "xs": (96.0, 56.0, 96.0, 96.0),
                    "ys": (84.0, 220.0, 356.0, 492.0),
                },
                agent={"DamageFactor": 0.3},
            ),
        ),
        replace(SHORT_AGENT, name="resized_agent"),
    ),
    complete=("city", "flaming_skulls", "revenants_and_arachnotron", "resized_agent"),
    levdoom_tasks={
        "arachnotron+city": Content(agent={"DamageFactor": 0.4}),
        "mancubus+resized_agent": Content(agent={"DamageFactor": 0.7}),
        "resized_agent+revenants": Content(agent={"DamageFactor": 0.5}),
        "flames+flaming_skulls+mancubus": Content(agent={"DamageFactor": 0.7}),
        "complete": Content(parameters=_row("Arachnotron", 3, 56.0, 140.0, 440.0), agent={"DamageFactor": 0.5}),
    },
    tasks=words(
        """
        default
        city flames flaming_skulls mancubus barons cacodemons resized_agent
        revenants city+resized_agent arachnotron barons+flaming_skulls cacodemons+flames
        mancubus+resized_agent
        flames+flaming_skulls+mancubus resized_agent+revenants city+arachnotron
        complete
        """
    ),
    splits={
        "train1": words("default"),
        "train4": words("default flames flaming_skulls barons"),
        "train8": words("default city flames flaming_skulls mancubus barons cacodemons resized_agent"),
        "test": words(
            "revenants city+resized_agent barons+flaming_skulls flames+flaming_skulls+mancubus "
            "resized_agent+revenants city+arachnotron complete"
        ),
    },
    buttons=("SPEED", "MOVE_LEFT", "MOVE_RIGHT"),
    game_variables=("HEALTH",),
    metric="frames_alive",
    render_weapon=False,
    timeouts={"thesis": 2100, "levdoom": 2100},
    upper_bounds={"thesis": 2100, "levdoom": 2100},
    rewards={
        "living": Reward(event=living, weight=0.01, levdoom=0.0),
        # The Arachnotron's hits are the most frequent and the weakest. The agent stands still.
        "health_lost": Reward(
            event=Fell("HEALTH"),
            weight=-1.0,
            levdoom=-0.1,
            paces=(Pace(tics=2, times=3), Pace(tics=10, times=10), Pace(tics=16, times=12)),
            levdoom_paces=(Pace(tics=2, times=4), Pace(tics=10, times=16), Pace(tics=14, times=16)),
        ),
        # No part of eq. 3.6. Map units a tic, each counted by five decisions: sidewards at a run.
        "moved": Reward(event=moved, weight=0.0, levdoom=0.0, paces=(Pace(amount=HISTORY_STEPS * 14),), adds_up=True),
    },
)
