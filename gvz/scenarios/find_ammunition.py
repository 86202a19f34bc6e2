"""Find Ammunition: the agent looks for bullets, then shoots enemies with them.

Ability tested: doing what the own state asks for: without bullets the agent has to find clips and keep away from
    enemies, with bullets it has to find enemies and aim. The pistol is in sight exactly while there are bullets.
Actions: ATTACK, MOVE_FORWARD, TURN_LEFT, TURN_RIGHT.
Observation: the screen with weapon and HUD; variables KILLCOUNT, AMMO2, HEALTH, POSITION_X, POSITION_Y.
Reward: [kill] + 0.5 [clip taken] - 0.5 [decoy taken] + 0.01 - [death].
Start: a random place of a room, a random angle, and a pistol without bullets. 12 clips of 2 bullets lie at other random
    places of 25, at least 150 units (in x and y together) from the agent; no more come. 6 demons of 1 health walk
    towards the agent at speed 4 (Doom's: 10). 60 tics after its death one comes back, at least 400 units (in
    x and y together) away. The agent takes a quarter of the damage.
Termination: the agent dies. Truncation: after 1400 tics.
Metric: kills; a score is at most 24, as there are 24 bullets. An agent that knows all places, misses nothing and is
    never hindered kills the last one after 1240 tics on average (a simulation). No enemy hurts another.
Attributes: below. Those that no other scenario has: `boxes` of bullets instead of clips; `wrong_ammunition` is four
    things for other weapons, which take all bullets from the agent. `maze` is the map of Seek and Kill, with 20 places.
    Profile levdoom is the same, since LevDoom has no such scenario.
Source: thesis 6.2.1, its second idea for a scenario. Differs: wrong ammunition is an attribute, not in every task.
"""

from gvz.scenarios.base import Attribute, Content, Scenario, Textures, Variety, words
from gvz.scenarios.find_the_key import MAZE, ROOM_SPOTS, draw_rooms_of_spots
from gvz.scenarios.health_gathering import OBSTACLES
from gvz.scenarios.parts import ACS_APART, ACS_NEAR, GLOWING_ENEMIES, RESIZED_ENEMIES, definition, retextured, starts_at
from gvz.scenarios.rewards import Pace, Reward, Rose, death, living
from gvz.scenarios.seek_and_kill import drain_acid

WAD = "health_gathering.wad"

SCRIPT = (
    """\
#include "zcommon.acs"

global int 1:player_kills;
global int 2:num_spawned;
global int 3:clips_taken;
global int 4:decoys_taken;
global int 60:map_magic;

str classes[$num_classes] = $classes;
str decoys[$num_decoys] = $decoys;
int taken[40];
int next_tid = 1000;

"""
    + ACS_APART
    + "\n"
    + ACS_NEAR
    + """\

// Tries to put something at a random place at least `gap` from the agent, a thing to take at one that has none yet.
// Returns its tid, or 0 if every try was blocked.
function int Put(str kind, int gap, int to_take)
{
    for (int tries = 0; tries < 100; tries++)
    {
        int spot = Random($first_spot, $last_spot);
        int x = Near(GetActorX(spot));
        int y = Near(GetActorY(spot));
        if (taken[spot] * to_take == 0 && Apart(x, GetActorX(1)) + Apart(y, GetActorY(1)) > gap)
        {
            if (Spawn(kind, x, y, 0.0, next_tid, Random(0, 255)) != 0)
            {
                taken[spot] += to_take;
                next_tid++;
                return next_tid - 1;
            }
        }
    }
    return 0;
}

function int PutEnemy(int kind)
{
    int tid = Put(classes[kind], 400.0, 0);
    if (tid == 0)
        return 0;
    num_spawned++;
    SetActorProperty(tid, APROP_Health, 1);
    $entity_properties
    SetThingSpecial(tid, ACS_ExecuteAlways, 3, 0, tid, kind);
    return 1;
}

function int PutItem(str kind, int script_number)
{
    int tid = Put(kind, 150.0, 1);
    if (tid == 0)
        return 0;
    SetThingSpecial(tid, ACS_ExecuteAlways, script_number);
    return 1;
}

script 1 OPEN
{
    player_kills = 0;
    num_spawned = 0;
    clips_taken = 0;
    decoys_taken = 0;
    map_magic = $map_magic;
}

script 2 ENTER
{
    ClearInventory();
    GiveInventory("HiddenPistol", 1);
    SetWeapon("HiddenPistol");
    TakeInventory("Clip", 200);
    Thing_ChangeTID(0, 1);
    $agent_properties
    int spot = Random($first_spot, $last_spot);
    while (SetActorPosition(0, Near(GetActorX(spot)), Near(GetActorY(spot)), 0.0, 0) == 0)
        spot = Random($first_spot, $last_spot);
    SetActorAngle(0, Random(0.0, 1.0));
    int i;
    for (i = 0; i < 6; i++)
    {
        while (PutEnemy(i % $num_classes) == 0)
            Delay(1);
    }
    for (i = 0; i < 12; i++)
    {
        while (PutItem($clip, 4) == 0)
            Delay(1);
    }
    for (i = 0; i < $decoys_put; i++)
    {
        while (PutItem(decoys[i], 5) == 0)
            Delay(1);
    }
}

// An enemy died; the killer is the activator.
script 3 (int tid, int kind)
{
    if (PlayerNumber() >= 0)
        player_kills++;
    Thing_Remove(tid);
    Delay(60);
    while (PutEnemy(kind) == 0)
        Delay(1);
}

// A clip was taken.
script 4 (void)
{
    clips_taken++;
}

// A decoy was taken, by the activator.
script 5 (void)
{
    decoys_taken++;
    TakeInventory("Clip", 200);
}
"""
)

PISTOL = {
    "HiddenPistol": """\
ACTOR HiddenPistol : Pistol
{
  States
  {
  Select:
    TNT1 A 1 A_Raise
    Loop
  Ready:
    PISG A 0 A_JumpIfInventory("Clip", 1, "Loaded")
    TNT1 A 1 A_WeaponReady
    Loop
  Loaded:
    PISG A 1 A_WeaponReady
    Goto Ready
  Fire:
    PISG A 4
    PISG B 6 A_FirePistol
    PISG C 4
    PISG B 5 A_ReFire
    Goto Ready
  }
}
"""
}
"""a pistol that is in sight as long as there are bullets: small frames do not show the status bar's number"""

HARMLESS_TO_IMPS = {
    "ImpFireball": """\
ACTOR ImpFireball : DoomImpBall replaces DoomImpBall
{
  Species DoomImp
  +THRUSPECIES
}
"""
}
"""a fireball that flies through imps: Doom's kills them once its thrower is dead, and the score would count that"""


def _clip(name: str, sprite: str, scale: float) -> dict[str, str]:
    """A DECORATE class that gives two bullets."""
    properties = f"Scale {scale}", "Radius 32", "Inventory.Amount 2"
    return {name: definition(f"{name} : Clip", *properties, spawn=f"{sprite} A -1\n    Stop")}


def _decoy(name: str, base: str) -> dict[str, str]:
    """A DECORATE class of ammunition for another weapon."""
    return {name: f"ACTOR {name} : {base}\n{{\n  Scale 2\n  Radius 32\n}}\n"}


DECOYS = ("WrongShells", "WrongRocket", "WrongCell", "WrongRockets")
"""like clips, larger than Doom's: else they could not be seen across the room, and hardly be met by chance"""

SCENARIO = Scenario(
    id="find_ammunition",
    title="Find Ammunition",
    script=SCRIPT,
    draw_map=drain_acid,
    content=Content(
        base_wad=WAD,
        textures=Textures("STONE2", "FLOOR4_6", "CEIL5_1"),
        things={WAD: starts_at(ROOM_SPOTS, 10)},
        parameters={
            "classes": ("Demon",),
            "clip": '"Bullets"',
            "decoys": DECOYS,
            "decoys_put": 0,
            "first_spot": 10,
            "last_spot": 34,
            "scatter": 96.0,
        },
        entity={"Speed": 4.0},
        agent={"DamageFactor": 0.25},
        actors={
            **PISTOL,
            **_clip("Bullets", "CLIP", 3),
            **_clip("BulletBox", "AMMO", 2),
            **_decoy("WrongShells", "Shell"),
            **_decoy("WrongRocket", "RocketAmmo"),
            **_decoy("WrongCell", "Cell"),
            **_decoy("WrongRockets", "RocketBox"),
        },
    ),
    variety=Variety(
        entities=("Demon", "Bullets"),
        entity_parameters=("classes", "clip"),
        max_decorations=16,
        draw_layout=draw_rooms_of_spots,
    ),
    attributes=(
        MAZE,
        OBSTACLES,
        retextured("metal", "AQSECT09", "FLAT19", "AQF052"),
        retextured("stone_wall", "FLAT5_7", "FLOOR1_6", "CEIL3_3"),
        Attribute(
            name="imps",
            groups=("entity_type",),
            content=Content(parameters={"classes": ("DoomImp",)}, actors=HARMLESS_TO_IMPS),
        ),
        RESIZED_ENEMIES,
        GLOWING_ENEMIES,
        Attribute(
            name="fast_enemies", groups=("entity_speed",), aliases=("fast",), content=Content(entity={"Speed": 8.0})
        ),
        Attribute(name="boxes", groups=("item_type",), content=Content(parameters={"clip": '"BulletBox"'})),
        Attribute(
            name="wrong_ammunition",
            groups=("decoys",),
            aliases=("wrong",),
            content=Content(parameters={"decoys_put": 4}),
        ),
    ),
    complete=words("maze obstacles metal imps resized_enemies glowing_enemies fast_enemies boxes wrong_ammunition"),
    tasks=words(
        """
        default
        obstacles metal stone_wall imps maze boxes wrong_ammunition fast_enemies resized_enemies glowing_enemies
        metal+obstacles boxes+glowing maze+wrong stone_wall+imps fast+glowing
        stone_wall+maze+boxes obstacles+metal+imps wrong+resized+fast
        complete
        """
    ),
    splits={
        "train1": words("default"),
        "train4": words("default stone_wall obstacles imps"),
        "train8": words("default obstacles metal stone_wall imps maze wrong_ammunition boxes"),
        "test": words(
            "metal+obstacles boxes+glowing maze+wrong stone_wall+maze+boxes obstacles+metal+imps "
            "wrong+resized+fast complete"
        ),
    },
    buttons=("ATTACK", "MOVE_FORWARD", "TURN_LEFT", "TURN_RIGHT"),
    game_variables=("KILLCOUNT", "AMMO2", "HEALTH", "POSITION_X", "POSITION_Y"),
    metric="kills",
    render_weapon=True,
    timeouts={"thesis": 1400, "levdoom": 1400},
    upper_bounds={"thesis": 24, "levdoom": 24},
    rewards={
        # Some bullets are left from before; then they have to be found.
        "kill": Reward(
            event=Rose("KILLCOUNT"), weight=1.0, levdoom=1.0, paces=(Pace(tics=13, times=6), Pace(tics=30, times=18))
        ),
        # Two clips may lie together; there are twelve.
        "clip_taken": Reward(
            event=Rose("KITS_TAKEN"), weight=0.5, levdoom=0.5, paces=(Pace(tics=20, times=2), Pace(tics=50, times=10))
        ),
        "decoy_taken": Reward(event=Rose("POISONS_TAKEN"), weight=-0.5, levdoom=-0.5, paces=(Pace(tics=20, times=4),)),
        "living": Reward(event=living, weight=0.01, levdoom=0.01),
        "death": Reward(event=death, weight=-1.0, levdoom=-1.0, paces=(Pace(times=1),)),
    },
)
