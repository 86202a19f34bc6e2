"""Find the Key: the agent takes the key, then leaves through the portal, again and again.

Ability tested: recognizing two kinds of things, and doing one after the other: what to look for depends on what the
    agent has done, which only the status bar shows.
Actions: MOVE_FORWARD, TURN_LEFT, TURN_RIGHT.
Observation: the screen with HUD, which shows a key that the agent has; no weapon; variables HEALTH, POSITION_X,
    POSITION_Y.
Reward: [left] + 0.5 [key taken] - 0.5 [decoy taken] - 0.01 - [death].
Start: a random place of a room, and a random angle. 8 keys and 3 portals lie at other random places of 25, at least
    200 units (in x and y together) from the agent. With the first key that the agent takes, the others vanish. An agent
    without a key can stand in a portal, and nothing happens. With a key it has left: it stands at another random place,
    the key is gone, and keys and portals are put again.
Termination: the agent dies, which only decoys can cause. Truncation: after 2100 tics.
Metric: how often the agent left; a score is at most 25. An agent that knows all places, and never has to turn, leaves
    28 times on average (a simulation).
Attributes: below. Those that no other scenario has: decoys are four keys of other colours and kinds that take 35 of 100
    health; glowing things are drawn with additive light, which keeps their colours; `maze` is the map of Seek and
    Kill, with 20 places. Profile levdoom is the same, since LevDoom has no such scenario.
Source: thesis 6.2.1, its first idea for a scenario. Differs: portals take the place of the locked room; the score
    counts what is done in a fixed time, where the thesis would measure the time that doing it once takes, so that an
    agent that never gets there has a score, too; in `procedural` alone the walls differ from episode to episode.
"""

import dataclasses
import random

from gvz.scenarios.base import Attribute, Content, Scenario, Textures, Uniform, Variety, words
from gvz.scenarios.health_gathering import OBSTACLES, draw_hall
from gvz.scenarios.layout import Layout
from gvz.scenarios.parts import ACS_APART, ACS_NEAR, SHORT_AGENT, definition, rendered, retextured, starts_at
from gvz.scenarios.rewards import Pace, Reward, Rose, death, living
from gvz.scenarios.seek_and_kill import SPOTS as MAZE_SPOTS
from gvz.scenarios.seek_and_kill import drain_acid

WAD = "health_gathering.wad"
MAZE_WAD = "health_gathering_supreme.wad"

SCRIPT = (
    """\
#include "zcommon.acs"

global int 2:num_spawned;
global int 3:keys_taken;
global int 4:decoys_taken;
global int 5:times_left;
global int 60:map_magic;

str decoys[$num_decoys] = $decoys;
int taken[40];
int has_key = 0;

"""
    + ACS_APART
    + "\n"
    + ACS_NEAR
    + """\

// Tries to put something at a random place that is not near the agent. Returns 0 if every try was blocked.
function int Put(str kind, int tid)
{
    Thing_Remove(tid);
    for (int tries = 0; tries < 100; tries++)
    {
        int spot = Random($first_spot, $last_spot);
        int x = Near(GetActorX(spot));
        int y = Near(GetActorY(spot));
        if (taken[spot] == 0 && Apart(x, GetActorX(0)) + Apart(y, GetActorY(0)) > 200.0)
        {
            if (Spawn(kind, x, y, 0.0, tid) != 0)
            {
                taken[spot] = 1;
                $entity_properties
                num_spawned++;
                return 1;
            }
        }
    }
    return 0;
}

// Whether the agent stands in a portal.
function int InPortal(void)
{
    for (int i = 0; i < 3; i++)
    {
        if (Apart(GetActorX(0), GetActorX(100 + i)) < 48.0 && Apart(GetActorY(0), GetActorY(100 + i)) < 48.0)
            return 1;
    }
    return 0;
}

script 1 OPEN
{
    num_spawned = 0;
    keys_taken = 0;
    decoys_taken = 0;
    times_left = 0;
    map_magic = $map_magic;
}

script 2 ENTER
{
    ClearInventory();
    $agent_properties
    while (1)
    {
        int spot = Random($first_spot, $last_spot);
        while (SetActorPosition(0, Near(GetActorX(spot)), Near(GetActorY(spot)), 0.0, 0) == 0)
            spot = Random($first_spot, $last_spot);
        SetActorAngle(0, Random(0.0, 1.0));
        int i;
        for (i = 0; i < 40; i++)
            taken[i] = 0;
        for (i = 0; i < 3; i++)
        {
            while (Put("Portal", 100 + i) == 0)
                Delay(1);
        }
        for (i = 0; i < 8; i++)
        {
            while (Put($key, 110 + i) == 0)
                Delay(1);
            SetThingSpecial(110 + i, ACS_ExecuteAlways, 3);
        }
        for (i = 0; i < $decoys_at_once; i++)
        {
            while (Put(decoys[i], 120 + i) == 0)
                Delay(1);
            SetThingSpecial(120 + i, ACS_ExecuteAlways, 4);
        }
        while (has_key == 0 || InPortal() == 0)
            Delay(1);
        times_left++;
        has_key = 0;
        TakeInventory($key, 1);
        TakeInventory($shown_key, 1);
        for (i = 0; i < $decoys_at_once; i++)
            TakeInventory(decoys[i], 1);
    }
}

// A key was taken; the others vanish.
script 3 (void)
{
    has_key = 1;
    GiveInventory($shown_key, 1);  // the status bar has no place for the tinted keys of drawn maps
    keys_taken++;
    for (int i = 0; i < 8; i++)
        Thing_Remove(110 + i);
}

// A decoy was taken, by the activator.
script 4 (void)
{
    decoys_taken++;
    Thing_Damage(0, 35, MOD_SUICIDE);
}
"""
)

PORTAL = {"Portal": definition("Portal", "Radius 20", "Height 56", spawn="IFOG ABCDEDCB 6 Bright\n    Loop")}

RESIZED_THINGS = Content(entity={"ScaleX": Uniform(1.0, 5.0), "ScaleY": Uniform(1.0, 5.0)})
"""0.4 to 2 times as wide and as high as in the default task; smaller keys could not be told apart"""

SOON = (Pace(tics=20, times=2), Pace(tics=60))

ROOM_SPOTS = tuple((x, y) for y in range(128, 1217, 240) for x in range(128, 1217, 240))
"""five rows of five places"""
MAZE = Attribute(
    name="maze",
    groups=("map",),
    content=Content(
        base_wad=MAZE_WAD,
        things={MAZE_WAD: starts_at(MAZE_SPOTS, 22)},
        parameters={"last_spot": 29, "scatter": 16.0},
    ),
)


def draw_rooms_of_spots(rng: random.Random, strength: float) -> Layout:
    """The rooms and pillars of Health Gathering, with 25 places for the agent, keys and portals."""
    hall = draw_hall(rng, strength)
    spots = tuple(dict.fromkeys((*hall.starts, *hall.places)))[: len(ROOM_SPOTS)]
    parameters = {"last_spot": 9 + len(spots), "scatter": 16.0}
    return dataclasses.replace(hall, starts=spots, places=(), marked=False, parameters=parameters)


SCENARIO = Scenario(
    id="find_the_key",
    title="Find the Key",
    script=SCRIPT,
    draw_map=drain_acid,
    content=Content(
        base_wad=WAD,
        textures=Textures("TANROCK2", "FLOOR0_5", "CEIL4_1"),
        things={WAD: starts_at(ROOM_SPOTS, 10)},
        parameters={
            "key": '"BlueCard"',
            "shown_key": '"BlueCard"',
            "decoys": ("RedCard", "YellowCard", "RedSkull", "YellowSkull"),
            "decoys_at_once": 0,
            "first_spot": 10,
            "last_spot": 34,
            "scatter": 96.0,
        },
        entity={"ScaleX": 2.5, "ScaleY": 2.5},  # as they are, keys are too small to be seen across the room
        actors=PORTAL,
    ),
    variety=Variety(
        entities=("BlueCard",), entity_parameters=("key",), max_decorations=16, draw_layout=draw_rooms_of_spots
    ),
    attributes=(
        MAZE,
        OBSTACLES,
        retextured("moss", "A-MOSBRI", "FLOOR4_6", "CEIL5_1"),
        retextured("metal", "AQSECT09", "FLAT19", "AQF052"),
        retextured("bricks", "BRICK12", "CRATOP1", "CRATOP1"),
        Attribute(
            name="skulls",
            groups=("entity_type",),
            content=Content(parameters={"key": '"BlueSkull"', "shown_key": '"BlueSkull"'}),
        ),
        Attribute(name="resized_things", groups=("entity_size",), aliases=("resized",), content=RESIZED_THINGS),
        rendered("glowing_things", "STYLE_Add", "glowing"),
        SHORT_AGENT,
        Attribute(
            name="decoys",
            groups=("decoys",),
            content=Content(parameters={"decoys_at_once": 4}),
            not_drawn=("RenderStyle", "Translation"),  # in one colour, keys and decoys look the same
        ),
    ),
    complete=words("maze obstacles metal skulls resized_things glowing_things short_agent decoys"),
    tasks=words(
        """
        default
        obstacles moss metal bricks skulls maze resized_things short_agent decoys glowing_things
        moss+obstacles glowing+skulls maze+decoys resized+bricks short_agent+metal
        resized+glowing skulls+decoys
        bricks+maze+short_agent obstacles+moss+skulls decoys+resized+glowing
        complete
        """
    ),
    splits={
        "train1": words("default"),
        "train4": words("default bricks obstacles skulls"),
        "train8": words("default obstacles moss bricks skulls maze decoys glowing_things"),
        "test": words(
            "moss+obstacles glowing+skulls maze+decoys bricks+maze+short_agent obstacles+moss+skulls "
            "decoys+resized+glowing complete"
        ),
    },
    buttons=("MOVE_FORWARD", "TURN_LEFT", "TURN_RIGHT"),
    game_variables=("HEALTH", "POSITION_X", "POSITION_Y"),
    metric="goals",
    render_weapon=False,
    timeouts={"thesis": 2100, "levdoom": 2100},
    upper_bounds={"thesis": 25, "levdoom": 25},
    rewards={
        # Key and portal may lie on the agent's way; on average an agent that knows all places needs 75 tics.
        "left": Reward(event=Rose("GOALS"), weight=1.0, levdoom=1.0, paces=SOON),
        "key_taken": Reward(event=Rose("KITS_TAKEN"), weight=0.5, levdoom=0.5, paces=SOON),
        # The third decoy kills.
        "decoy_taken": Reward(event=Rose("POISONS_TAKEN"), weight=-0.5, levdoom=-0.5, paces=(Pace(tics=4, times=3),)),
        "living": Reward(event=living, weight=-0.01, levdoom=-0.01),
        "death": Reward(event=death, weight=-1.0, levdoom=-1.0, paces=(Pace(times=1),)),
    },
)
