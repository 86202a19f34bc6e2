"""Rockets: the agent shoots enemies that come in squads, and must not hit itself.

Ability tested: shooting at where an enemy will be, as a rocket takes time to fly; hitting several at once; keeping the
    distance that a rocket needs, as it hurts everything near where it bursts, the agent, too.
Actions: ATTACK, MOVE_FORWARD, MOVE_BACKWARD, TURN_LEFT, TURN_RIGHT.
Observation: the screen with weapon and HUD; variables KILLCOUNT, AMMO5 (rockets), HEALTH, POSITION_X, POSITION_Y.
Reward: number of kills - 0.05 [rockets fell] - 0.2 [health fell] - [death]. One rocket can kill several, so kills are
    counted.
Start: a random place of a room, a random angle, 30 rockets, 100 health. A squad of 3 Demons of 1 health comes every 70
    tics, at a random place as far from the agent as there is after some tries; 15 squads in all. They know where the
    agent is, walk to it and bite. The agent walks faster than they do.
Termination: the agent dies. Truncation: after 1100 tics.
Metric: kills (KILLCOUNT); a score is at most 45, the enemies that come. There are two rockets for each squad, and one
    that bursts in its middle kills all three. Some 60 tics are left when the last has come.
Attributes: below. The one that no other scenario has: barrels burst like rockets, and not again. Profile levdoom is the
    same, since LevDoom has no such scenario.
Source: thesis 6.2.1, its third idea for a scenario. Differs: the agent can walk, and enemies are not bound to the other
    end of the room but come, so that it matters how near a rocket bursts; they come in squads and in a fixed number.
Known: enemies that die together with the agent, or by each other, count for KILLCOUNT but not for PLAYER_KILLS. Only
    barrels let enemies kill each other: fireballs and charging souls burst them, too.
"""

from gvz.scenarios.base import Attribute, Content, Scenario, Textures, Variety, words
from gvz.scenarios.find_the_key import ROOM_SPOTS, draw_rooms_of_spots
from gvz.scenarios.health_gathering import COLUMNS
from gvz.scenarios.parts import (
    ACS_APART,
    ACS_NEAR,
    GLOWING_ENEMIES,
    RESIZED_ENEMIES,
    SHORT_AGENT,
    retextured,
    starts_at,
    things_at,
)
from gvz.scenarios.rewards import Fell, Gained, Pace, Reward, death
from gvz.scenarios.seek_and_kill import drain_acid

WAD = "health_gathering.wad"
NUM_SQUADS, SQUAD_SIZE = 15, 3

KILLS = (Pace(tics=70, times=1, amount=7), Pace(tics=70, times=13, amount=SQUAD_SIZE))
"""First those that have gathered die at once, then the squads as they come."""

BARRELS = {2035: tuple(place for places in COLUMNS[WAD].values() for place in places)}
"""editor number of an exploding barrel -> places, where `obstacles` has columns"""

SCRIPT = (
    """\
#include "zcommon.acs"

global int 1:player_kills;
global int 2:num_spawned;
global int 60:map_magic;

"""
    + ACS_APART
    + "\n"
    + ACS_NEAR
    + """\

// An enemy that knows where the agent is. Returns 0 if something stands in the way.
function int SpawnEnemy(int x, int y)
{
    int tid = 100 + num_spawned;
    if (Spawn($enemy, x, y, 0.0, tid) == 0)
        return 0;
    num_spawned++;
    SetActorProperty(tid, APROP_Health, 1);
    $entity_properties
    SetThingSpecial(tid, ACS_ExecuteAlways, 3, 0, tid);
    Thing_Hate(tid, 0);
    return 1;
}

script 1 OPEN
{
    player_kills = 0;
    num_spawned = 0;
    map_magic = $map_magic;
}

script 2 ENTER
{
    ClearInventory();
    GiveInventory("RocketLauncher", 1);
    GiveInventory("RocketAmmo", 28);
    SetWeapon("RocketLauncher");
    $agent_properties
    int spot = Random(10, $last_spot);
    while (SetActorPosition(0, Near(GetActorX(spot)), Near(GetActorY(spot)), 0.0, 0) == 0)
        spot = Random(10, $last_spot);
    SetActorAngle(0, Random(0.0, 1.0));
    for (int squad = 0; squad < $num_squads; squad++)
    {
        // Of random places, the first that is far away; what is far enough shrinks from try to try.
        int x;
        int y;
        int here = num_spawned;
        for (int far = 900.0; num_spawned == here; far -= 10.0)
        {
            spot = Random(10, $last_spot);
            x = Near(GetActorX(spot));
            y = Near(GetActorY(spot));
            if (Apart(x, GetActorX(0)) + Apart(y, GetActorY(0)) >= far)
                SpawnEnemy(x, y);
        }
        for (int i = 1; i < $squad_size; i++)
        {
            Delay(15);
            while (SpawnEnemy(x + Random(-48.0, 48.0), y + Random(-48.0, 48.0)) == 0)
                Delay(1);
        }
        Delay(40);
    }
}

// An enemy died; the killer is the activator.
script 3 (int tid)
{
    if (PlayerNumber() >= 0)
        player_kills++;
    Thing_Remove(tid);
}
"""
)

PEACEFUL_SOUL = {"PeacefulSoul": 'ACTOR PeacefulSoul : LostSoul\n{\n  DamageFactor "Melee", 0\n}\n'}
"""class name -> definition: a lost soul that others cannot hurt; they would kill each other when they charge"""

SCENARIO = Scenario(
    id="rockets",
    title="Rockets",
    script=SCRIPT,
    draw_map=drain_acid,
    content=Content(
        base_wad=WAD,
        textures=Textures("STONE2", "NUKAGE1", "CEIL4_1"),
        things={WAD: starts_at(ROOM_SPOTS, 10)},
        parameters={
            "enemy": '"Demon"',
            "num_squads": NUM_SQUADS,
            "squad_size": SQUAD_SIZE,
            "last_spot": 34,
            "scatter": 96.0,
        },
    ),
    variety=Variety(
        entities=("Demon",), entity_parameters=("enemy",), max_decorations=16, draw_layout=draw_rooms_of_spots
    ),
    attributes=(
        retextured("blue", "FIREBLU2", "FLAT14", "CEIL4_3"),
        retextured("slime", "A-CAMO3", "SLIME04", "GRASS2"),
        retextured("stone_wall", "FLAT5_7", "FLOOR1_6", "CEIL3_3"),
        Attribute(name="obstacles", groups=("decorations",), content=Content(things={WAD: things_at(COLUMNS[WAD])})),
        Attribute(name="barrels", groups=("decorations",), content=Content(things={WAD: things_at(BARRELS)})),
        Attribute(name="hell_knights", groups=("entity_type",), content=Content(parameters={"enemy": '"HellKnight"'})),
        Attribute(
            name="flying_enemies",
            groups=("entity_type",),
            aliases=("flying",),
            content=Content(parameters={"enemy": '"PeacefulSoul"'}, actors=PEACEFUL_SOUL),
        ),
        RESIZED_ENEMIES,
        GLOWING_ENEMIES,
        Attribute(
            name="fast_enemies",
            groups=("entity_speed",),
            aliases=("fast",),
            content=Content(entity={"Speed": 15.0}),
        ),
        SHORT_AGENT,
    ),
    complete=words("slime barrels hell_knights resized_enemies glowing_enemies fast_enemies short_agent"),
    tasks=words(
        """
        default
        blue stone_wall obstacles barrels hell_knights flying_enemies resized_enemies glowing_enemies fast_enemies
        blue+barrels fast+flying resized+hell_knights slime+obstacles short_agent+blue
        stone_wall+fast+obstacles obstacles+flying+resized slime+hell_knights+glowing
        complete
        """
    ),
    splits={
        "train1": words("default"),
        "train4": words("default blue barrels hell_knights"),
        "train8": words("default blue stone_wall obstacles barrels hell_knights resized_enemies fast_enemies"),
        "test": words(
            "blue+barrels fast+flying resized+hell_knights stone_wall+fast+obstacles obstacles+flying+resized "
            "slime+hell_knights+glowing complete"
        ),
    },
    buttons=("ATTACK", "MOVE_FORWARD", "MOVE_BACKWARD", "TURN_LEFT", "TURN_RIGHT"),
    game_variables=("KILLCOUNT", "AMMO5", "HEALTH", "POSITION_X", "POSITION_Y"),
    metric="kills",
    render_weapon=True,
    timeouts={"thesis": 1100, "levdoom": 1100},
    upper_bounds={"thesis": NUM_SQUADS * SQUAD_SIZE, "levdoom": NUM_SQUADS * SQUAD_SIZE},
    rewards={
        "kill": Reward(event=Gained("KILLCOUNT"), weight=1.0, levdoom=1.0, paces=KILLS),
        "player_kill": Reward(event=Gained("PLAYER_KILLS"), weight=0.0, levdoom=0.0, paces=KILLS),
        "death": Reward(event=death, weight=-1.0, levdoom=-1.0, paces=(Pace(times=1),)),
        # A held ATTACK button fires every 20 tics.
        "ammo_spent": Reward(event=Fell("AMMO5"), weight=-0.05, levdoom=-0.05, paces=(Pace(tics=19, times=30),)),
        # Several enemies bite at once; a bite takes 4 to 40 of 100 health.
        "health_lost": Reward(
            event=Fell("HEALTH"), weight=-0.2, levdoom=-0.2, paces=(Pace(tics=4, times=4), Pace(tics=10, times=6))
        ),
    },
)
