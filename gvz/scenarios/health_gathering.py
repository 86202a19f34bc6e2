"""Health Gathering: staying alive on an acid floor.

Ability tested: finding health kits, avoiding poison, walking round obstacles.
Actions: MOVE_FORWARD, TURN_LEFT, TURN_RIGHT.
Observation: the screen with HUD, no weapon; variable HEALTH.
Reward (eq. 3.4): 0.01 - [death] - [poison picked up] + [health rose].
Start: one of 9 places at a random angle (levdoom: the centre, facing east); on the map of `supreme` one of its 12
    places. The floor takes 8 of 100 health every 32 tics. 16 kits lie on the floor; one is added at once and
    every 30 tics.
Termination: the agent dies. Truncation: after 2100 tics.
Metric: frames alive, at most the time-out.
Attributes: thesis B.2, below. `complete` takes water for its textures. Tasks: thesis Table A.2.
"""

import random
from dataclasses import replace

from gvz.scenarios.base import Attribute, Content, Period, Scenario, Textures, Uniform, Variety, words
from gvz.scenarios.layout import Layout, draw_rooms, furnished, vary
from gvz.scenarios.parts import RESIZED, SHORT_AGENT, definition, rendered, retextured, starts_at, things_at
from gvz.scenarios.rewards import Pace, Reward, Rose, death, living

WAD = "health_gathering.wad"
SUPREME_WAD = "health_gathering_supreme.wad"

SCRIPT = """\
#include "zcommon.acs"

global int 2:num_spawned;
global int 3:kits_taken;
global int 4:poisons_taken;
global int 60:map_magic;

str kits[2] = {$even_kit, $odd_kit};
int next_tid = 1000;

// Tries to put something at a random place of the map. Returns its tid, or 0 if every try was blocked.
function int SpawnSomewhere(str kind)
{
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
        if (Spawn(kind, x, y, 20.0, next_tid) != 0)
        {
            next_tid++;
            return next_tid - 1;
        }
    }
    return 0;
}

function int SpawnKit(void)
{
    int tid = SpawnSomewhere(kits[num_spawned % 2]);
    if (tid == 0)
        return 0;
    num_spawned++;
    $entity_properties
    SetThingSpecial(tid, ACS_ExecuteAlways, 3);
    return 1;
}

function int SpawnPoison(void)
{
    int tid = SpawnSomewhere("Poison");
    if (tid == 0)
        return 0;
    SetThingSpecial(tid, ACS_ExecuteAlways, 4);
    return 1;
}

script 1 OPEN
{
    num_spawned = 0;
    kits_taken = 0;
    poisons_taken = 0;
    map_magic = $map_magic;
    for (int i = 0; i < $num_kits; i++)
    {
        while (SpawnKit() == 0)
            Delay(1);
    }
    while (1)
    {
        while (SpawnKit() == 0)
            Delay(1);
        Delay($kit_delay);
    }
}

script 2 ENTER
{
    ClearInventory();
    int spot = Random($first_spot, $last_spot);
    SetActorPosition(0, GetActorX(spot), GetActorY(spot), 0.0, 0);
    SetActorAngle(0, $start_angle);
    $agent_properties
}

// A kit was taken.
script 3 (void)
{
    kits_taken++;
}

// A vial was taken, by the activator.
script 4 (void)
{
    poisons_taken++;
    Thing_Damage(0, 30, MOD_SUICIDE);
}

script 5 OPEN
{
    for (int i = 0; i < $num_poisons; i++)
    {
        while (SpawnPoison() == 0)
            Delay(1);
    }
    while ($poison_delay > 0)
    {
        Delay($first_poison_delay);
        while (SpawnPoison() == 0)
            Delay(1);
        Delay($poison_delay - $first_poison_delay);
    }
}
"""


def _health(name: str, sprite: str, amount: int) -> dict[str, str]:
    """A DECORATE class that heals `amount`; an agent in full health takes it, too."""
    properties = "+INVENTORY.ALWAYSPICKUP", f"Inventory.Amount {amount}", "Inventory.MaxAmount 100"
    return {name: definition(f"{name} : Health", *properties, spawn=sprite)}


def _poison(amount: int) -> dict[str, str]:
    return _health("Poison", "BON1 ABCDCB 6\n    Loop", amount)


STARTS = (
    *((608, 608), (480, 160), (576, 1088), (160, 640), (1120, 512)),
    *((192, 1088), (896, 1120), (480, 480), (864, 224)),
)
"""our choice, as the thesis only says "several"; at least 130 units from each other and from every obstacle"""

COLUMNS = {
    WAD: {
        30: ((928, 864), (288, 608), (352, 1056), (992, 352), (672, 96), (96, 480)),
        32: ((352, 352), (160, 928), (736, 288), (1056, 736), (352, 864), (736, 992), (1056, 1056)),
        36: ((864, 544), (544, 800), (160, 224), (992, 160)),
    },
    SUPREME_WAD: {  # the same numbers; five are LevDoom's, the others ours: no passage is narrower than 64 units
        30: ((544, 1120), (1632, 224), (416, 1632), (1056, 1568), (1248, 928), (1696, 1696)),
        32: ((224, 288), (1408, 1120), (864, 1280), (352, 1472), (1312, 352), (640, 96), (1696, 1216)),
        36: ((1056, 672), (864, 1504), (672, 672), (1504, 768)),
    },
}
"""base map -> editor number (green column, red column, heart column) -> places"""
OBSTACLES = Attribute(
    name="obstacles",
    groups=("decorations",),
    content=Content(things={wad: things_at(places) for wad, places in COLUMNS.items()}),
)


def draw_hall(rng: random.Random, strength: float) -> Layout:
    """One to nine rooms with wide doors, and pillars in them, of about the default room's size together."""
    rooms = draw_rooms(
        rng,
        size=round(vary(rng, strength, 19, 17, 22)),
        across=round(vary(rng, strength, 1, 0.51, 3.49)) or 1,
        shrink=rng.uniform(0, 0.5 * strength),
        loops=vary(rng, strength, 1.0, 0.2, 1.0),
        corridor=(3, 3),
    )
    return furnished(rng, strength, rooms, most_pillars=12, pillar_width=(32, 160), num_starts=9)


SCENARIO = Scenario(
    id="health_gathering",
    title="Health Gathering",
    suite="core",
    script=SCRIPT,
    content=Content(
        base_wad=WAD,
        textures=Textures("GSTONE1", "NUKAGE1", "CEIL4_1"),
        things={WAD: starts_at(STARTS, 10)},
        parameters={
            "even_kit": '"Medikit"',
            "odd_kit": '"Medikit"',
            "map_size": 1216.0,
            "num_places": 0,
            "num_kits": 16,
            "kit_delay": 30,
            "num_poisons": 0,
            "poison_delay": 0,
            "first_poison_delay": 0,
            "first_spot": 10,
            "last_spot": 18,
            "start_angle": Uniform(0.0, 1.0),
        },
        actors=_poison(0),
    ),
    levdoom=Content(
        things={WAD: starts_at([(608, 608)], 10)},
        parameters={"last_spot": 10, "start_angle": 0.0},
        actors=_poison(1),
    ),
    variety=Variety(
        entities=("Medikit",), entity_parameters=("even_kit", "odd_kit"), max_decorations=16, draw_layout=draw_hall
    ),
    attributes=(
        Attribute(  # first, because textures and stimpacks change what it sets
            name="supreme",
            groups=("map",),
            content=Content(
                base_wad=SUPREME_WAD,
                textures=Textures("STONE2", "NUKAGE1", "CEIL4_1"),
                parameters={
                    "even_kit": '"CustomMedikit"',
                    "odd_kit": '"CustomMedikit"',
                    "map_size": 1856.0,
                    "num_kits": 30,
                    "kit_delay": 25,
                    "last_spot": 21,
                    "start_angle": Uniform(0.0, 1.0),
                },
                actors=_health("CustomMedikit", "MEDI A -1\n    Stop", 20),
            ),
        ),
        OBSTACLES,
        retextured("slime", "A-CAMO3", "SLIME04", "GRASS2"),
        retextured("lava", "AQCONC14", "LAVA1", "CEIL1_1"),
        retextured("water", "AQSECT09", "FWATER1", "AQF052"),
        Attribute(
            name="stimpacks",
            groups=("entity_type",),
            content=Content(parameters={"odd_kit": '"Stimpack"'}),
            levdoom=Content(parameters={"even_kit": '"Stimpack"'}),
        ),
        Attribute(name="resized_kits", groups=("entity_size",), aliases=("resized",), content=RESIZED),
        rendered("shaded_kits", "STYLE_Shaded", "shaded"),
        replace(SHORT_AGENT, levdoom=Content(agent={"ViewHeight": 0.0})),
        Attribute(
            name="poison",
            groups=("poison",),
            content=Content(
                parameters={"num_poisons": 2, "poison_delay": Period(30), "first_poison_delay": Period(30)}
            ),
            levdoom=Content(parameters={"poison_delay": Period(60), "first_poison_delay": 0}),
        ),
    ),
    complete=words("obstacles water supreme stimpacks resized_kits shaded_kits short_agent poison"),
    levdoom_tasks={
        "stimpacks": Content(
            parameters={"even_kit": '"Stimpack25"', "odd_kit": '"Stimpack25"'},
            actors=_health("Stimpack25", "STIM A -1\n    Stop", 25),
        ),
        "poison+stimpacks": Content(
            parameters={"even_kit": '"Stimpack20"', "odd_kit": '"Stimpack20"'},
            actors=_health("Stimpack20", "STIM A -1\n    Stop", 20),
        ),
        "poison+supreme": Content(parameters={"poison_delay": 50}),
        "complete": Content(
            things={
                SUPREME_WAD: things_at(
                    {30: ((544, 1120), (1632, 224)), 36: ((1056, 672), (864, 1504)), 32: ((224, 288),)}
                )
            },
            parameters={"even_kit": '"CustomStimpack"', "odd_kit": '"CustomStimpack"', "poison_delay": 50},
            actors=_health("CustomStimpack", "MEDI A -1\n    Stop", 20),
        ),
    },
    tasks=words(
        """
        default
        obstacles slime lava water stimpacks supreme resized_kits short_agent poison shaded_kits
        slime+obstacles shaded+stimpacks supreme+poison resized_kits+lava short_agent+water
        resized+shaded_kits stimpacks+poison
        lava+supreme+short_agent obstacles+slime+stimpacks poison+resized+shaded_kits
        complete
        """
    ),
    splits={
        "train1": words("default"),
        "train4": words("default lava obstacles stimpacks"),
        "train8": words("default obstacles slime lava stimpacks supreme poison shaded_kits"),
        "test": words(
            "slime+obstacles shaded+stimpacks supreme+poison lava+supreme+short_agent "
            "obstacles+slime+stimpacks poison+resized+shaded_kits complete"
        ),
    },
    buttons=("MOVE_FORWARD", "TURN_LEFT", "TURN_RIGHT"),
    game_variables=("HEALTH",),
    metric="frames_alive",
    render_weapon=False,
    timeouts={"thesis": 2100, "levdoom": 2100},
    upper_bounds={"thesis": 2100, "levdoom": 2100},
    rewards={
        "living": Reward(event=living, weight=0.01, levdoom=-0.01),
        "death": Reward(event=death, weight=-1.0, levdoom=0.0, paces=(Pace(times=1),)),
        # The fourth vial kills an agent that takes no kit in between. A new vial comes every 30 tics.
        "poison_taken": Reward(
            event=Rose("POISONS_TAKEN"),
            weight=-1.0,
            levdoom=0.0,
            paces=(Pace(times=4), Pace(tics=30, needs="health_gained")),
        ),
        # Two kits lie together; stimpacks heal from near death to full health; then one kit each time the floor hurts.
        "health_gained": Reward(
            event=Rose("HEALTH"),
            weight=1.0,
            levdoom=1.0,
            paces=(Pace(tics=4, times=2), Pace(tics=16, times=6), Pace(tics=32)),
        ),
    },
)
