"""Seek and Kill: the agent searches and shoots enemies in a maze.

Ability tested: exploring, recognizing enemies, aiming.
Actions: ATTACK, SPEED, MOVE_FORWARD, TURN_LEFT, TURN_RIGHT.
Observation: the screen with weapon and HUD; variables KILLCOUNT, AMMO2, HEALTH, POSITION_X, POSITION_Y.
Reward (eq. 3.5): [kill] - [death] - 0.1 [ammo fell] - 0.01 - 0.3 [health fell] + 0.005 |l_t - l_{t-5}|.
    Differs: the equation penalizes rising health, and squares the distance that the text calls linear.
Start: one of 20 places (levdoom: 12) at a random angle, a pistol and 200 bullets. 20 Demons of 1 health stand in
    the maze and cannot walk; one more comes every 30 tics.
Termination: the agent dies. Truncation: after 1200 tics (levdoom: 1250).
Metric: kills (KILLCOUNT, which also counts enemies that enemies killed); a score is at most 20.
Attributes: thesis B.3, below. `complete` takes red and mixed_enemies: shadows are easier to see in front of red than
    of blue (results/reference/contrast.json). Tasks: thesis Table A.3.
Known: about one enemy in a hundred appears in the walled-off notch at the map's north side, out of reach. The same
    happens to kits of health_gathering/supreme, and in the author's maps.
"""

import random

from gvz.scenarios.base import Attribute, Content, Scenario, Textures, Variety, words
from gvz.scenarios.layout import Layout, draw_rooms, furnished, vary
from gvz.scenarios.parts import COUNTED_MARINE, RESIZED_ENEMIES, rendered, retextured, starts_at, things_at
from gvz.scenarios.rewards import HISTORY_STEPS, Fell, Pace, Reward, Rose, death, living, moved
from gvz.wad.udmf import UdmfMap

WAD = "health_gathering_supreme.wad"

SCRIPT = """\
#include "zcommon.acs"

global int 1:player_kills;
global int 2:num_spawned;
global int 60:map_magic;

str classes[$num_classes] = $classes;
int next_tid = 1000;

// Tries to put an enemy at a random place of the map. Returns 0 if every try was blocked.
function int SpawnEnemy(int kind)
{
    int tid = next_tid;
    for (int tries = 0; tries < 100; tries++)
    {
        int x = Random(1.0, $map_size - 1.0);
        int y = Random(1.0, $map_size - 1.0);
        if ($num_places > 0)
        {
            int place = Random(100, 99 + $num_places);
            x = GetActorX(place);
            y = GetActorY(place);
        }
        if (Spawn(classes[kind], x, y, 0.0, tid) != 0)
        {
            next_tid++;
            num_spawned++;
            SetActorProperty(tid, APROP_Health, 1);
            $entity_properties
            SetThingSpecial(tid, ACS_ExecuteAlways, 3, 0, tid);
            return 1;
        }
    }
    return 0;
}

script 1 OPEN
{
    player_kills = 0;
    num_spawned = 0;
    map_magic = $map_magic;
    int kind;
    for (int i = 0; i < $num_per_class; i++)
    {
        for (kind = 0; kind < $num_classes; kind++)
        {
            while (SpawnEnemy(kind) == 0)
                Delay(1);
        }
    }
    Delay($first_delay);
    while (1)
    {
        for (kind = 0; kind < $num_classes; kind++)
        {
            while (SpawnEnemy(kind) == 0)
                Delay(1);
        }
        Delay($spawn_delay);
    }
}

script 2 ENTER
{
    ClearInventory();
    GiveInventory("Pistol", 1);
    SetWeapon("Pistol");
    GiveInventory("Clip", 200);
    int spot = Random(10, $last_spot);
    while (SetActorPosition(0, GetActorX(spot), GetActorY(spot), 0.0, 0) == 0)
        spot = Random(10, $last_spot); // an enemy stands on it
    SetActorAngle(0, Random(0.0, 1.0));
    $agent_properties
}

// An enemy died; the killer is the activator.
script 3 (int tid)
{
    if (PlayerNumber() >= 0)
        player_kills++;
    Thing_Remove(tid);
}

// An enemy's enemy died that no script spawned.
script 4 (void)
{
    if (PlayerNumber() >= 0)
        player_kills++;
}
"""


def _born_soul(health: int) -> dict[str, str]:
    """The lost soul that a Pain Elemental spits out: its death counts like that of any other enemy."""
    definition = f"""\
ACTOR BornSoul : LostSoul replaces LostSoul
{{
  Health {health}
  States
  {{
  Spawn:
    SKUL A 0
    SKUL A 0 A_SetSpecial(226, 4)
    Goto Super::Spawn
  }}
}}
"""
    return {"BornSoul": definition}


SPOTS = ((640, 1728), (384, 1088), (1152, 1600), (1216, 1024), (1184, 352), (640, 192), (64, 864), (352, 656))
"""our choice: eight starts beside the base map's twelve; at least 130 units from those and from every obstacle"""

TORCHES = {
    44: (
        *((800, 1632), (608, 1184), (32, 672), (544, 32), (1120, 160), (992, 672)),
        *((96, 1696), (1568, 1632), (1600, 320)),
    ),
    45: (
        *((480, 1376), (288, 864), (1440, 1248), (1344, 416), (224, 1056), (1056, 992)),
        *((512, 608), (1760, 96)),
    ),
    46: (
        *((1248, 1504), (1760, 1184), (1504, 928), (1184, 736), (224, 480), (864, 96)),
        *((864, 1376), (672, 928)),
    ),
}
"""editor number (blue, green, red torch) -> places"""

MIXED = ("ZombieMan", "MarineChainsawVzd", "DoomImp", "Cacodemon", "LostSoul")
STRONG = ("Arachnotron", "Fatso", "PainElemental", "Archvile", "Revenant")

KILLS = (Pace(tics=4, times=3), Pace(tics=12, times=3), Pace(tics=36))
"""First the enemies near each other die, then as many as come: five in 180 tics. Most of them kill each other."""


def drain_acid(maze: UdmfMap) -> None:
    """Makes the floor harmless."""
    for sector in maze.sectors:
        del sector["special"]


def draw_maze(rng: random.Random, strength: float) -> Layout:
    """A maze of rooms and corridors: 2 to 5 rooms on each side of a square, of 3 tiles to all of their cell."""
    rooms = draw_rooms(
        rng,
        size=round(vary(rng, strength, 27, 22, 32)),
        across=round(vary(rng, strength, 4, 1.51, 5.49)),
        shrink=rng.uniform(0, strength),
        loops=vary(rng, strength, 0.7, 0.1, 1.0),
        corridor=(2, 3),
    )
    return furnished(rng, strength, rooms, most_pillars=8, pillar_width=(40, 144), num_starts=20)


SCENARIO = Scenario(
    id="seek_and_kill",
    title="Seek and Kill",
    suite="core",
    script=SCRIPT,
    draw_map=drain_acid,
    content=Content(
        base_wad=WAD,
        textures=Textures("ICKWALL3", "AQF051", "FLAT19"),
        things={WAD: starts_at(SPOTS, 22)},
        parameters={
            "classes": ("Demon",),
            "num_per_class": 20,
            "first_delay": 30,
            "spawn_delay": 30,
            "map_size": 1856.0,
            "num_places": 0,
            "last_spot": 29,
        },
        entity={"Speed": 0.0},
    ),
    levdoom=Content(things={WAD: ()}, parameters={"first_delay": 0, "last_spot": 21}),
    variety=Variety(entities=("Demon",), entity_parameters=("classes",), max_decorations=24, draw_layout=draw_maze),
    attributes=(
        retextured("blue", "FIREBLU2", "FLAT14", "CEIL4_3"),
        retextured("red", "FIREWALL", "CRACKLE4", "DORED"),
        Attribute(name="obstacles", groups=("decorations",), content=Content(things={WAD: things_at(TORCHES)})),
        RESIZED_ENEMIES,
        rendered("shadows", "STYLE_Shadow"),
        Attribute(
            name="mixed_enemies",
            groups=("entity_type",),
            aliases=("mixed",),
            content=Content(
                parameters={"classes": MIXED, "num_per_class": 3, "first_delay": 180, "spawn_delay": 180},
                actors=COUNTED_MARINE,
            ),
        ),
        Attribute(
            name="invulnerable",
            groups=("entity_type",),
            content=Content(
                parameters={"classes": STRONG, "num_per_class": 3, "first_delay": 180, "spawn_delay": 180},
                agent={"Invulnerable": "TRUE"},
                actors=_born_soul(1),
            ),
            levdoom=Content(actors=_born_soul(100)),
        ),
    ),
    complete=("red", "obstacles", "resized_enemies", "shadows", "mixed_enemies"),
    levdoom_tasks={
        "complete": Content(
            textures=Textures("ICKWALL3", "FLAT14", "CEIL4_3"),
            parameters={"classes": MIXED + STRONG},
            actors=_born_soul(100),
        ),
    },
    tasks=words(
        """
        default
        blue red obstacles resized_enemies shadows mixed_enemies invulnerable
        blue+shadows obstacles+resized red+mixed invulnerable+blue resized+red shadows+obstacles
        blue+mixed+resized red+obstacles+invulnerable resized+shadows+invulnerable
        complete
        """
    ),
    splits={
        "train1": words("default"),
        "train4": words("default red obstacles mixed_enemies"),
        "train8": words("default blue red obstacles resized_enemies shadows mixed_enemies invulnerable"),
        "test": words(
            "blue+shadows obstacles+resized red+mixed blue+mixed+resized red+obstacles+invulnerable "
            "resized+shadows+invulnerable complete"
        ),
    },
    buttons=("ATTACK", "SPEED", "MOVE_FORWARD", "TURN_LEFT", "TURN_RIGHT"),
    combination_buttons=("ATTACK", "MOVE_FORWARD", "TURN_LEFT", "TURN_RIGHT"),  # LevDoom's 12 sets: no SPEED
    game_variables=("KILLCOUNT", "AMMO2", "HEALTH", "POSITION_X", "POSITION_Y"),
    metric="kills",
    render_weapon=True,
    timeouts={"thesis": 1200, "levdoom": 1250},
    upper_bounds={"thesis": 20, "levdoom": 20},
    rewards={
        "kill": Reward(event=Rose("KILLCOUNT"), weight=1.0, levdoom=1.0, paces=KILLS),
        "player_kill": Reward(event=Rose("PLAYER_KILLS"), weight=0.0, levdoom=0.0, paces=KILLS),
        "death": Reward(event=death, weight=-1.0, levdoom=0.0, paces=(Pace(times=1),)),
        # A held ATTACK button fires every 14 tics. With decisions of four tics this is sometimes less.
        "ammo_spent": Reward(event=Fell("AMMO2"), weight=-0.1, levdoom=0.0, paces=(Pace(tics=13, times=200),)),
        "living": Reward(event=living, weight=-0.01, levdoom=0.0),
        "health_lost": Reward(
            event=Fell("HEALTH"), weight=-0.3, levdoom=0.0, paces=(Pace(tics=3, times=5), Pace(tics=16, times=10))
        ),
        # Map units a tic, each counted by five decisions: 22 while blows push the agent, 25 / 3 along a passage, and
        # half of that over a long walk between walls.
        "moved": Reward(
            event=moved,
            weight=0.005,
            levdoom=0.001,
            paces=(
                Pace(times=12, amount=HISTORY_STEPS * 22),
                Pace(times=100, amount=HISTORY_STEPS * 25 / 3),
                Pace(amount=HISTORY_STEPS * 25 / 6),
            ),
            adds_up=True,
        ),
    },
)
