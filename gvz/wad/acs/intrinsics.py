"""ACS's built-in functions, line specials and named constants: tables, and the functions that read them.

The numbers are those of the engine (ZDoom's p_acs.h, actionspecials.h) and of zcommon.acs. The tables list only what
scenarios may need. A parameter has a kind:

* `int`: a number; `fixed`: a fixed-point number, where a plain integer is almost surely an error (1.0 is 65536);
* `script`: the number of a script of the same source;
* `str`: a string; `class`: a string that names an actor class; `any`: a number or a string.

A `?` marks a parameter that may be left out.
"""

from dataclasses import dataclass
from functools import cache
from typing import Literal, cast

Kind = Literal["int", "fixed", "script", "str", "class", "any"]
Type = Literal["int", "str", "any", "void"]
"""the type of a value; `any` if it is known only when the script runs"""
Form = Literal["instruction", "function", "special"]

INSTRUCTIONS = """
 55 void Delay int
 57 int Random any any
 59 int ThingCount int int
 90 int PlayerCount
 92 int GameSkill
 93 int Timer
120 int PlayerHealth
121 int PlayerArmorPoints
135 int SinglePlayer
136 int FixedMul fixed fixed
137 int FixedDiv fixed fixed
142 void ClearInventory
143 void GiveInventory class int
145 void TakeInventory class int
147 int CheckInventory class
149 int Spawn class fixed fixed fixed int? int?
151 int SpawnSpot class int int? int?
180 void SetThingSpecial int int int? int? int? int? int?
196 int GetActorX int
197 int GetActorY int
198 int GetActorZ int
220 int Sin fixed
221 int Cos fixed
222 int VectorAngle int int
223 int CheckWeapon class
224 int SetWeapon class
245 void SetActorProperty int int any
246 any GetActorProperty int int
247 int PlayerNumber
248 int ActivatorTID
253 int StrLen str
255 int GetCVar str
257 void SetResultValue any
259 int GetActorFloorZ int
260 int GetActorAngle int
265 int GetLevelInfo int
267 int PlayerInGame int
271 int GetAmmoCapacity class
272 void SetAmmoCapacity class int
276 void SetActorAngle int fixed
282 int GetActorCeilingZ int
283 int SetActorPosition int fixed fixed fixed int
284 void ClearActorInventory int
285 void GiveActorInventory int class int
286 void TakeActorInventory int class int
287 int CheckActorInventory int class
288 int ThingCountName class int
289 int SpawnSpotFacing class int int?
331 int GetActorPitch int
332 void SetActorPitch int fixed
334 int SetActorState int str int?
335 int Thing_Damage2 int int str
348 int ClassifyActor int
"""
"""Functions with an instruction of their own: opcode, result, name, parameters. Left-out ones are passed as 0."""

FUNCTIONS = """
 9 int GetActorVelX int
10 int GetActorVelY int
11 int GetActorVelZ int
12 int SetActivator int int?
13 int SetActivatorToTarget int
14 int GetActorViewHeight int
22 int CheckActorProperty int int any
23 int SetActorVelocity int fixed fixed fixed int int
27 int CheckActorClass int class
35 int CheckSight int int int
36 int SpawnForced class fixed fixed fixed int? int?
46 int UniqueTID int? int?
47 int IsTIDUsed int
48 int Sqrt int
49 int FixedSqrt fixed
50 int VectorLength int int
61 int PlaySound int str int? fixed? int? fixed? int?
62 int StopSound int int?
63 int StrCmp str str int?
64 int StrICmp str str int?
68 str GetActorClass int
69 str GetWeapon
75 int CheckFlag int str
"""
"""Functions called by number: number, result, name, parameters. The engine sees how many were given."""

SPECIALS = """
 17 int Thing_Raise int int?
 19 int Thing_Stop int
 72 int ThrustThing int int int? int?
 73 int DamageThing int int?
 80 int ACS_Execute script int? any? any? any?
 82 int ACS_Terminate script int
 84 int ACS_ExecuteWithResult script any? any? any? any?
119 int Thing_Damage int int int?
125 int Thing_Move int int int?
128 int ThrustThingZ int int int int
130 int Thing_Activate int
131 int Thing_Deactivate int
132 int Thing_Remove int
133 int Thing_Destroy int int? int?
176 int Thing_ChangeTID int int
177 int Thing_Hate int int int?
226 int ACS_ExecuteAlways script int? any? any? any?
229 int Thing_SetGoal int int int int?
243 int Exit_Normal int
248 int HealThing int int?
"""
"""Line specials: number, result, name, parameters. Without parentheses the name means the number."""

CONSTANTS = """
TRUE 1 FALSE 0 ON 1 OFF 0 YES 1 NO 0

APROP_Health 0 APROP_Speed 1 APROP_Damage 2 APROP_Alpha 3 APROP_RenderStyle 4 APROP_SeeSound 5
APROP_AttackSound 6 APROP_PainSound 7 APROP_DeathSound 8 APROP_ActiveSound 9 APROP_Ambush 10
APROP_Invulnerable 11 APROP_JumpZ 12 APROP_ChaseGoal 13 APROP_Frightened 14 APROP_Gravity 15
APROP_Friendly 16 APROP_SpawnHealth 17 APROP_Dropped 18 APROP_Notarget 19 APROP_Species 20 APROP_Nametag 21
APROP_Score 22 APROP_Notrigger 23 APROP_DamageFactor 24 APROP_MasterTID 25 APROP_TargetTID 26
APROP_TracerTID 27 APROP_Waterlevel 28 APROP_ScaleX 29 APROP_ScaleY 30 APROP_Dormant 31 APROP_Mass 32
APROP_Accuracy 33 APROP_Stamina 34 APROP_Height 35 APROP_Radius 36 APROP_Reactiontime 37 APROP_MeleeRange 38
APROP_ViewHeight 39 APROP_AttackZOffset 40 APROP_StencilColor 41 APROP_Friction 42 APROP_DamageMultiplier 43

STYLE_None 0 STYLE_Normal 1 STYLE_Fuzzy 2 STYLE_SoulTrans 3 STYLE_OptFuzzy 4 STYLE_Stencil 5
STYLE_Translucent 64 STYLE_Add 65 STYLE_Shaded 66 STYLE_TranslucentStencil 67 STYLE_Shadow 68

MOD_UNKNOWN 0 MOD_ROCKET 5 MOD_R_SPLASH 6 MOD_PLASMARIFLE 7 MOD_BFG_BOOM 8 MOD_BFG_SPLASH 9 MOD_CHAINSAW 10
MOD_SSHOTGUN 11 MOD_WATER 12 MOD_SLIME 13 MOD_LAVA 14 MOD_CRUSH 15 MOD_TELEFRAG 16 MOD_FALLING 17
MOD_SUICIDE 18 MOD_BARREL 19 MOD_EXIT 20 MOD_SPLASH 21 MOD_HIT 22

SKILL_VERY_EASY 0 SKILL_EASY 1 SKILL_NORMAL 2 SKILL_HARD 3 SKILL_VERY_HARD 4

CHAN_AUTO 0 CHAN_WEAPON 1 CHAN_VOICE 2 CHAN_ITEM 3 CHAN_BODY 4
ATTN_NONE 0 ATTN_NORM 65536 ATTN_STATIC 196608

ACTOR_NONE 0 ACTOR_WORLD 1 ACTOR_PLAYER 2 ACTOR_BOT 4 ACTOR_VOODOODOLL 8 ACTOR_MONSTER 16 ACTOR_ALIVE 32
ACTOR_DEAD 64 ACTOR_MISSILE 128 ACTOR_GENERIC 256

AAPTR_DEFAULT 0 AAPTR_NULL 1 AAPTR_TARGET 2 AAPTR_MASTER 4 AAPTR_TRACER 8 AAPTR_PLAYER1 64

LEVELINFO_TOTAL_MONSTERS 7 LEVELINFO_KILLED_MONSTERS 8

T_NONE 0
"""
"""Names of zcommon.acs and their values."""

FIXED_PROPERTIES = frozenset((1, 3, 12, 15, 24, 29, 30, 38, 39, 40, 42, 43))
"""actor properties whose value is a fixed-point number (Speed, Alpha, JumpZ, Gravity, DamageFactor, ...)"""

LATENT = frozenset(("delay",))
"""built-ins that suspend the script and so are not allowed in a function"""


@dataclass(frozen=True, slots=True)
class Intrinsic:
    """A built-in function or line special."""

    name: str
    form: Form
    number: int
    """opcode, function number or special number"""
    parameters: tuple[Kind, ...]
    num_required: int
    returns: Type


@cache
def intrinsics() -> dict[str, Intrinsic]:
    """All built-ins by lower-case name."""
    tables: dict[Form, str] = {"instruction": INSTRUCTIONS, "function": FUNCTIONS, "special": SPECIALS}
    found = [_read(form, line) for form, table in tables.items() for line in table.strip().splitlines()]
    return {intrinsic.name.lower(): intrinsic for intrinsic in found}


def _read(form: Form, line: str) -> Intrinsic:
    number, returns, name, *kinds = line.split()
    required = sum(not kind.endswith("?") for kind in kinds)
    parameters: tuple[Kind, ...] = tuple(cast(Kind, kind.rstrip("?")) for kind in kinds)
    return Intrinsic(name, form, int(number), parameters, required, cast(Type, returns))


@cache
def constants() -> dict[str, int]:
    """All named constants by lower-case name."""
    words = CONSTANTS.lower().split()
    return dict(zip(words[::2], map(int, words[1::2]), strict=True))
