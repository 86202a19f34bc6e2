"""Guarded Goal: the agent shoots its way into a portal that guards stand round, again and again.

Ability tested: finding the goal, aiming, and weighing haste against danger: where a guard died there is a way in, but
    every guard that lives shoots on.
Actions: ATTACK, MOVE_FORWARD, TURN_LEFT, TURN_RIGHT.
Observation: the screen with weapon and HUD; variables AMMO2, HEALTH, POSITION_X, POSITION_Y.
Reward: [goal reached] + 0.2 [guard killed] + 0.05 [nearer] - 0.5 [trapped] - 0.05 [health fell] - 0.01 [ammo fell]
    - [death]. `nearer`: the agent is 64 units nearer to this goal than it ever was.
Start: a random place and angle, 100 health, a pistol and 200 bullets. The goal is at a random place 300 to 700 units
    away. Four imps of 1 health stand on its four sides, so close together that nobody passes between them. They cannot
    walk; they throw fireballs at the agent as soon as they see or hear it. An agent within 32 units of the goal has
    reached it: it stands at another random place, and there is a new goal with new guards. Lost health never returns.
Termination: the agent dies. Truncation: after 1050 tics.
Metric: goals reached; a score is at most 14. An agent that knows where the goals are, turns and walks at full speed
    from the first tic and is stopped by nobody reaches 13.9 on average (a simulation).
Attributes: below. Those that no other scenario has: `traps` are two unguarded portals of another colour; each takes 35
    of 100 health, times the damage factor of the guards (70 with `sergeants`, 20 with `flying_guards`, 13 with
    `knights`), and vanishes. Pellets of `sergeants` hit other guards, too: a noise is enough, and two of the four
    shoot the other two, while the agent does nothing. Missiles do not harm their own kind. `guard_killed` is of own
    kills alone. Profile levdoom is the same, since LevDoom has no such scenario.
Source: thesis 6.2.1, its last idea for a scenario, with its small rewards for kills and for coming closer. Differs: one
    goal follows another, so that a score is more than yes or no; not all guards have to die, so that haste has a price.
"""

from gvz.scenarios.base import Attribute, Content, Scenario, Textures, Uniform, Variety, words
from gvz.scenarios.find_the_key import ROOM_SPOTS, draw_rooms_of_spots
from gvz.scenarios.health_gathering import COLUMNS
from gvz.scenarios.parts import ACS_NEAR, SHORT_AGENT, definition, rendered, retextured, starts_at, things_at
from gvz.scenarios.rewards import Fell, Pace, Reward, Rose, death
from gvz.scenarios.seek_and_kill import drain_acid

WAD = "health_gathering.wad"

SCRIPT = (
    """\
#include "zcommon.acs"

global int 1:player_kills;
global int 2:num_spawned;
global int 4:traps_taken;
global int 5:goals;
global int 6:steps_nearer;
global int 60:map_magic;

int east[4] = {1, 0, -1, 0};
int north[4] = {0, 1, 0, -1};

// How far apart two things are; 0 is the agent.
function int Distance(int tid, int other)
{
    return VectorLength(GetActorX(tid) - GetActorX(other), GetActorY(tid) - GetActorY(other));
}

"""
    + ACS_NEAR
    + """\

// Tries to put something at a random place this far from the agent, at least and at most, and as far from the goal.
// Returns 0 if every try was blocked.
function int Put(str kind, int tid, int least, int most)
{
    Thing_Remove(tid);
    for (int tries = 0; tries < 100; tries++)
    {
        int spot = Random(10, $last_spot);
        if (Spawn(kind, Near(GetActorX(spot)), Near(GetActorY(spot)), 0.0, tid) != 0)
        {
            int away = Distance(tid, 0);
            if (away > least && away < most && (tid == 100 || Distance(tid, 100) > least))
                return 1;
            Thing_Remove(tid);
        }
    }
    return 0;
}

// Puts guards on the four sides of the goal. Returns how many found room.
function int PutGuards(void)
{
    int found = 0;
    for (int i = 0; i < 4; i++)
    {
        int tid = 110 + i;
        int x = GetActorX(100) + east[i] * $guard_distance;
        int y = GetActorY(100) + north[i] * $guard_distance;
        Thing_Remove(tid);
        if (Spawn($guard, x, y, 0.0, tid, i * 64) != 0)
        {
            SetActorProperty(tid, APROP_Health, 1);
            $entity_properties
            SetThingSpecial(tid, ACS_ExecuteAlways, 3, 0, tid);
            found++;
        }
    }
    return found;
}

script 1 OPEN
{
    player_kills = 0;
    num_spawned = 0;
    traps_taken = 0;
    goals = 0;
    steps_nearer = 0;
    map_magic = $map_magic;
}

script 2 ENTER
{
    ClearInventory();
    GiveInventory("Pistol", 1);
    SetWeapon("Pistol");
    GiveInventory("Clip", 200);
    $agent_properties
    while (1)
    {
        int i;
        for (i = 100; i < 124; i++)
            Thing_Remove(i);
        int spot = Random(10, $last_spot);
        while (SetActorPosition(0, Near(GetActorX(spot)), Near(GetActorY(spot)), 0.0, 0) == 0)
            spot = Random(10, $last_spot);
        SetActorAngle(0, Random(0.0, 1.0));
        // Columns and walls may leave no place with room for all guards.
        int guards = 0;
        for (int tries = 0; guards < 4 - tries / 10; tries++)
        {
            while (Put("Goal", 100, 300.0, 700.0) == 0)
                Delay(1);
            guards = PutGuards();
        }
        num_spawned += guards;
        for (i = 120; i < 120 + $num_traps; i++)
        {
            while (Put("Trap", i, 200.0, 2000.0) == 0)
                Delay(1);
        }
        int nearest = Distance(100, 0);
        while (Distance(100, 0) > 32.0)
        {
            if (Distance(100, 0) < nearest - 64.0)
            {
                nearest = Distance(100, 0);
                steps_nearer++;
            }
            for (i = 120; i < 120 + $num_traps; i++)
            {
                if (IsTIDUsed(i) != 0 && Distance(i, 0) < 32.0)
                {
                    Thing_Remove(i);
                    traps_taken++;
                    Thing_Damage(0, 35, MOD_SUICIDE);
                }
            }
            Delay(1);
        }
        goals++;
    }
}

// A guard died; the killer is the activator.
script 3 (int tid)
{
    if (PlayerNumber() >= 0)
        player_kills++;
    Thing_Remove(tid);
}
"""
)


def _portal(name: str, sprites: str) -> dict[str, str]:
    """A DECORATE class: light above a place, which the agent walks into."""
    look = "Scale 3.0", "RenderStyle Translucent", "Alpha 0.7"
    spawn = f"{sprites} 6 Bright\n    Loop"
    return {name: definition(name, "Radius 20", "Height 56", *look, "+BLOCKEDBYSOLIDACTORS", spawn=spawn)}


def _guards(kind: str, distance: float, damage_factor: float) -> Content:
    """Guards of another kind, which touch each other at this distance from the goal."""
    return Content(parameters={"guard": f'"{kind}"', "guard_distance": distance}, agent={"DamageFactor": damage_factor})


RESIZED_GUARDS = Content(entity={"ScaleX": Uniform(0.75, 3.0), "ScaleY": Uniform(0.75, 3.0)})
"""half to twice as wide and as high; the goal keeps its size"""


SCENARIO = Scenario(
    id="guarded_goal",
    title="Guarded Goal",
    script=SCRIPT,
    draw_map=drain_acid,
    content=Content(
        base_wad=WAD,
        textures=Textures("GSTONE1", "FLAT19", "CEIL3_3"),
        things={WAD: starts_at(ROOM_SPOTS, 10)},
        parameters={
            "guard": '"DoomImp"',
            "guard_distance": 40.0,
            "num_traps": 0,
            "last_spot": 34,
            "scatter": 32.0,
        },
        entity={"Speed": 0.0, "ScaleX": 1.5, "ScaleY": 1.5},
        actors=_portal("Goal", "IFOG AB") | _portal("Trap", "TFOG AB"),
    ),
    variety=Variety(
        entities=("DoomImp",), entity_parameters=("guard",), max_decorations=16, draw_layout=draw_rooms_of_spots
    ),
    attributes=(
        Attribute(name="obstacles", groups=("decorations",), content=Content(things={WAD: things_at(COLUMNS[WAD])})),
        retextured("moss", "A-MOSBRI", "FLOOR4_6", "CEIL5_1"),
        retextured("city", "SKY2", "ROCKRED1", "CEIL4_1"),
        retextured("bricks", "BRICK12", "CRATOP1", "CRATOP1"),
        Attribute(name="sergeants", groups=("entity_type",), content=_guards("ShotgunGuy", 40.0, 2.0)),
        Attribute(
            name="flying_guards", groups=("entity_type",), aliases=("flying",), content=_guards("Cacodemon", 62.0, 0.6)
        ),
        Attribute(name="knights", groups=("entity_type",), content=_guards("HellKnight", 48.0, 0.4)),
        Attribute(name="resized_guards", groups=("entity_size",), aliases=("resized",), content=RESIZED_GUARDS),
        rendered("shadows", "STYLE_Shadow"),
        SHORT_AGENT,
        Attribute(name="traps", groups=("traps",), content=Content(parameters={"num_traps": 2})),
    ),
    complete=words("obstacles city knights resized_guards shadows short_agent traps"),
    tasks=words(
        """
        default
        obstacles moss city bricks sergeants flying_guards resized_guards shadows short_agent traps
        moss+obstacles knights+shadows traps+city sergeants+bricks resized+short_agent
        flying+moss+traps sergeants+obstacles+resized knights+city+short_agent
        complete
        """
    ),
    splits={
        "train1": words("default"),
        "train4": words("default bricks obstacles sergeants"),
        "train8": words("default bricks moss obstacles sergeants flying_guards shadows traps"),
        "test": words(
            "moss+obstacles knights+shadows traps+city flying+moss+traps sergeants+obstacles+resized "
            "knights+city+short_agent complete"
        ),
    },
    buttons=("ATTACK", "MOVE_FORWARD", "TURN_LEFT", "TURN_RIGHT"),
    game_variables=("AMMO2", "HEALTH", "POSITION_X", "POSITION_Y"),
    metric="goals",
    render_weapon=True,
    timeouts={"thesis": 1050, "levdoom": 1050},
    upper_bounds={"thesis": 14, "levdoom": 14},
    rewards={
        # Two goals may lie close by; then they come as in the simulation of the bound.
        "goal": Reward(event=Rose("GOALS"), weight=1.0, levdoom=1.0, paces=(Pace(tics=36, times=2), Pace(tics=72))),
        # A held ATTACK button fires every 14 tics. Four guards stand round each goal.
        "guard_killed": Reward(
            event=Rose("PLAYER_KILLS"), weight=0.2, levdoom=0.2, paces=(Pace(tics=13, times=4), Pace(tics=18))
        ),
        "nearer": Reward(event=Rose("STEPS_NEARER"), weight=0.05, levdoom=0.05, paces=(Pace(tics=8),)),
        # The agent's damage factor counts for traps, too: the third kills, but with `knights` only the eighth.
        "trapped": Reward(event=Rose("POISONS_TAKEN"), weight=-0.5, levdoom=-0.5, paces=(Pace(tics=4, times=8),)),
        "health_lost": Reward(event=Fell("HEALTH"), weight=-0.05, levdoom=-0.05, paces=(Pace(tics=4, times=30),)),
        "ammo_spent": Reward(event=Fell("AMMO2"), weight=-0.01, levdoom=-0.01, paces=(Pace(tics=13, times=200),)),
        "death": Reward(event=death, weight=-1.0, levdoom=-1.0, paces=(Pace(times=1),)),
    },
)
