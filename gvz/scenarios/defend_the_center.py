"""Defend the Center: the agent turns and shoots in the middle of a round room.

Ability tested: aiming, and seeing which enemy is nearest. The agent stands in the middle and cannot walk.
Actions: ATTACK, TURN_LEFT, TURN_RIGHT.
Observation: the screen with weapon and HUD; variables KILLCOUNT, AMMO2, HEALTH.
Reward (eq. 3.3): [kill] - [death] - 0.1 [ammo fell] - 0.2 [health fell].
Start: the centre of the room, a pistol and 26 bullets; 5 enemies of 1 health stand at the wall, 72 degrees apart.
    90 tics after its death an enemy returns at its place (levdoom: at a random one).
Termination: the agent dies. Truncation: after 1100 tics (levdoom: 2100).
Metric: frames alive, at most the time-out.
Attributes: thesis B.1, below. `complete` takes mossy_bricks for its textures. Tasks: thesis Table A.1.
"""

import math
import random
from dataclasses import replace
from functools import partial

from gvz.scenarios.base import Attribute, Chance, Content, Scenario, Textures, Uniform, Variety, words
from gvz.scenarios.layout import WAY, Layout, Place, draw_pillar, ring, vary
from gvz.scenarios.parts import COUNTED_MARINE, RESIZED_ENEMIES, rendered, retextured, things_at
from gvz.scenarios.rewards import Fell, Pace, Reward, Rose, death

WAD = "defend_the_center.wad"

SCRIPT = """\
#include "zcommon.acs"

global int 1:player_kills;
global int 2:num_spawned;
global int 60:map_magic;

str classes[$num_classes] = $classes;
int next_tid = 100;

// An enemy at the wall, facing the centre; angle in turns. Returns 0 if something stands in the way.
function int SpawnEnemy(int kind, int angle)
{
    int tid = next_tid;
    int x = FixedMul(Cos(angle), $radius);
    int y = FixedMul(Sin(angle), $radius);
    if (Spawn(classes[kind], x, y, 0.0, tid, (angle / 256 + 128) % 256) == 0)
        return 0;
    next_tid++;
    num_spawned++;
    SetActorProperty(tid, APROP_Health, 1);
    $entity_properties
    SetThingSpecial(tid, ACS_ExecuteAlways, 3, 0, tid, kind, angle);
    return 1;
}

script 1 OPEN
{
    player_kills = 0;
    num_spawned = 0;
    map_magic = $map_magic;
    for (int i = 0; i < $num_enemies; i++)
    {
        SpawnEnemy(i % $num_classes, i * 1.0 / $num_enemies);
        Delay($spawn_delay);
    }
}

script 2 ENTER
{
    ClearInventory();
    GiveInventory("Pistol", 1);
    SetWeapon("Pistol");
    GiveInventory("ClipBox", 6);
    $agent_properties
}

// An enemy died; the killer is the activator.
script 3 (int tid, int kind, int angle)
{
    if (PlayerNumber() >= 0)
        player_kills++;
    Thing_Remove(tid);
    Delay($respawn_delay);
    angle = $respawn_angle;
    while (SpawnEnemy(kind, angle) == 0)
        Delay(1);
}
"""

SLOW_RESPAWN = Content(parameters={"respawn_delay": 150})

GORE = {
    26: ((-352, 160), (-96, 608), (480, 352), (96, -224), (-544, -352)),  # a twitching man on a stick
    28: ((288, 160), (352, -544), (640, 32), (-288, -288), (-608, 352)),  # skulls on a stick
    29: ((224, 416), (480, -224), (-128, -608), (-352, 416), (-608, -128)),  # candles and skulls
}
"""editor number -> places"""


def near_agent_or_enemies(x: float, y: float, ring: float = 735.0) -> bool:
    """Whether a place is close to the agent or to the ring of this radius on which enemies appear."""
    return not 200 <= math.hypot(x, y) <= ring - 115


def draw_arena(rng: random.Random, strength: float) -> Layout:
    """A room of 4 to 18 corners round the agent, with up to six pillars that hide at most two of the five enemies.

    Enemies appear 555 to 850 units from the agent, instead of 735. The wall is as far behind them as in the default.
    """
    radius = 5 * round(vary(rng, strength, 735, 555, 850) / 5)
    num_corners, turn = round(vary(rng, strength, 18, 4, 18)), rng.random()
    corners = []
    for n in range(num_corners):
        angle = math.tau * (turn - (n + strength * rng.uniform(-0.15, 0.15)) / num_corners)
        length = 1 + strength * rng.uniform(0, 0.25)
        corners.append((length * math.cos(angle), length * math.sin(angle)))
    sides = zip(corners, corners[1:] + corners[:1], strict=True)
    scale = (radius + 68) / min(abs(x1 * y2 - x2 * y1) / math.dist((x1, y1), (x2, y2)) for (x1, y1), (x2, y2) in sides)
    places = tuple(_polar(radius, n / 5) for n in range(5))
    pillars: list[tuple[Place, float]] = []
    for _ in range(rng.randint(0, round(6 * strength))):
        place, size = _polar(rng.uniform(240, radius - 180), rng.random()), rng.uniform(20, 56)
        if all(math.dist(place, other) >= size + other_size + 2 * WAY for other, other_size in pillars):
            pillars.append((place, size))
    while sum(_is_hidden(place, pillars) for place in places) > 2:
        pillars.pop()
    return Layout(
        walls=ring([(scale * x, scale * y) for x, y in corners]) + sum((draw_pillar(rng, *one) for one in pillars), ()),
        starts=((0.0, 0.0),),
        height=round(vary(rng, strength, 300, 128, 400)),
        parameters={"radius": float(radius)},
        places=places,
        radius=30.0,
        keep_clear=partial(near_agent_or_enemies, ring=radius),
    )


def _polar(length: float, turns: float) -> Place:
    return length * math.cos(math.tau * turns), length * math.sin(math.tau * turns)


def _is_hidden(place: Place, pillars: list[tuple[Place, float]]) -> bool:
    """Whether a pillar stands between the centre and a place."""
    (x, y), length = place, math.hypot(*place)
    return any(px * x + py * y > 0 and abs(px * y - py * x) / length < size for (px, py), size in pillars)


SCENARIO = Scenario(
    id="defend_the_center",
    title="Defend the Center",
    suite="core",
    script=SCRIPT,
    content=Content(
        base_wad=WAD,
        textures=Textures("TANROCK2", "FLOOR0_5", "CEIL4_1"),
        parameters={
            "classes": ("MarineChainsawVzd", "Demon"),
            "num_enemies": 5,
            "radius": 735.0,
            "spawn_delay": 0,
            "respawn_delay": 90,
            "respawn_angle": "angle",
        },
        actors=COUNTED_MARINE,
    ),
    levdoom=Content(parameters={"respawn_angle": Uniform(0.0, 1.0)}),
    variety=Variety(
        entities=("MarineChainsawVzd", "Demon"),
        entity_parameters=("classes",),
        max_decorations=10,
        keep_clear=near_agent_or_enemies,
        draw_layout=draw_arena,
    ),
    attributes=(
        Attribute(name="gore", groups=("decorations",), content=Content(things={WAD: things_at(GORE)})),
        retextured("mossy_bricks", "A-MOSBRI", "FLOOR4_6", "CEIL5_1"),
        retextured("stone_wall", "FLAT5_7", "FLOOR1_6", "CEIL3_3"),
        replace(rendered("fuzzy_enemies", "STYLE_Fuzzy", "fuzzy"), levdoom=SLOW_RESPAWN),
        replace(RESIZED_ENEMIES, levdoom=SLOW_RESPAWN),
        Attribute(
            name="fast_enemies",
            groups=("entity_speed",),
            aliases=("fast",),
            content=Content(entity={"Speed": 20.0}, agent={"DamageFactor": 0.3}),
            levdoom=Content(entity={"Speed": 15.0}, parameters={"respawn_delay": 150}),
        ),
        Attribute(
            name="flying_enemies",
            groups=("entity_type",),
            aliases=("flying",),
            # the damage factor of fast_enemies balances the speed of walking enemies; lost souls have their own speed
            content=Content(parameters={"classes": ("LostSoul",), "spawn_delay": 10}, agent={"DamageFactor": 1.0}),
            levdoom=Content(parameters={"respawn_delay": 90}),
        ),
    ),
    complete=("gore", "mossy_bricks", "fuzzy_enemies", "resized_enemies", "fast_enemies", "flying_enemies"),
    levdoom_tasks={
        "gore+mossy_bricks": Content(agent={"DamageFactor": 0.7}),
        "fuzzy_enemies+resized_enemies": Content(agent={"DamageFactor": 0.7}),
        "flying_enemies+stone_wall": Content(agent={"DamageFactor": 0.7}),
        "flying_enemies+mossy_bricks+resized_enemies": Content(agent={"DamageFactor": 0.85}),
        "fuzzy_enemies+gore+stone_wall": Content(agent={"DamageFactor": 0.85}),
        "fast_enemies+gore+resized_enemies": Content(agent={"DamageFactor": 0.85}),
        "complete": Content(
            textures=Textures("RROCK02", "FWATER1", "AQF062"),
            # its map has six, each two of a kind at one place, where the second marine never appears
            parameters={"classes": ("MarineChainsawVzd", "Demon", "LostSoul", "Demon", "LostSoul")},
            entity={"Speed": 20.0, "RenderStyle": Chance("STYLE_Fuzzy", 0.5)},
            agent={"DamageFactor": 1.0},
        ),
    },
    tasks=words(
        """
        default
        gore mossy_bricks stone_wall fuzzy_enemies resized_enemies fast_enemies flying_enemies
        fast+flying gore+mossy_bricks resized+fuzzy stone_wall+flying fast+fuzzy resized+gore
        resized+flying+mossy_bricks gore+stone_wall+fuzzy fast+resized+gore
        complete
        """
    ),
    splits={
        "train1": words("default"),
        "train4": words("default gore stone_wall fast_enemies"),
        "train8": words(
            "default gore mossy_bricks stone_wall fuzzy_enemies resized_enemies fast_enemies flying_enemies"
        ),
        "test": words(
            "gore+mossy_bricks resized+fuzzy stone_wall+flying resized+flying+mossy_bricks "
            "gore+stone_wall+fuzzy fast+resized+gore complete"
        ),
    },
    buttons=("ATTACK", "TURN_LEFT", "TURN_RIGHT"),
    game_variables=("KILLCOUNT", "AMMO2", "HEALTH"),
    metric="frames_alive",
    render_weapon=True,
    timeouts={"thesis": 1100, "levdoom": 2100},
    upper_bounds={"thesis": 1100, "levdoom": 2100},
    rewards={
        # A kill costs a bullet. Five enemies return 90 tics after their deaths: one in 18 tics.
        "kill": Reward(
            event=Rose("KILLCOUNT"),
            weight=1.0,
            levdoom=1.0,
            paces=(Pace(tics=6, times=2, needs="ammo_spent"), Pace(tics=20, times=24, needs="ammo_spent")),
        ),
        "player_kill": Reward(
            event=Rose("PLAYER_KILLS"),
            weight=0.0,
            levdoom=0.0,
            paces=(Pace(tics=6, times=2), Pace(tics=20, times=24)),
        ),
        "death": Reward(event=death, weight=-1.0, levdoom=0.0, paces=(Pace(times=1),)),
        # A held ATTACK button fires every 14 tics. With decisions of four tics this is sometimes less.
        "ammo_spent": Reward(event=Fell("AMMO2"), weight=-0.1, levdoom=-0.01, paces=(Pace(tics=13, times=26),)),
        # Five enemies strike; the damage factor of fast_enemies weakens each blow.
        "health_lost": Reward(
            event=Fell("HEALTH"), weight=-0.2, levdoom=-0.01, paces=(Pace(tics=2, times=4), Pace(tics=5, times=32))
        ),
    },
)
