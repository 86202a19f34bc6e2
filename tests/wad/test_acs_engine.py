"""Compiled scripts in the real engine: what built-ins, operators and statements do is read back from the game."""

import importlib.util
import json
import random
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from gvz.wad.acs import compile_acs
from gvz.wad.acs.intrinsics import intrinsics
from gvz.wad.acs.lexer import tokenize
from gvz.wad.decorate import declared_actors
from gvz.wad.lumps import read_maps, read_wad, write_map_wad
from gvz.wad.stock import scenario_wad
from gvz.wad.udmf import make_thing, parse_textmap, write_textmap

pytestmark = pytest.mark.engine

PLAYER = Path(__file__).parent / "play_map.py"
FIXED = 65536
HEADER = '#include "zcommon.acs"\n' + "".join(f"global int {i}:u{i};\n" for i in range(1, 61))
DECORATE = "ACTOR CountedSoul : LostSoul { +COUNTKILL Health 7 }"

BUILT_INS = [
    # (statements, expression, its value); all in one ENTER script, in this order. Map spot 50 is at (300, 350).
    ("", 'SpawnSpot("Demon", 50, 60, 64)', 1),
    ("", 'SpawnForced("DoomImp", 900.0, 900.0, 0.0, 61)', 1),
    ("", 'SpawnSpotFacing("Clip", 50, 62)', 1),
    ("", 'Spawn("countedsoul", 700.0, 900.0, 40.0, 63)', 1),
    ("", "ThingCount(T_NONE, 60)", 1),
    ("", 'ThingCountName("DoomImp", 0)', 1),
    ("", "ClassifyActor(60)", 16 | 32),
    ("", "ClassifyActor(0)", 2 | 32),
    ("", 'CheckActorClass(60, "Demon") * 10 + CheckActorClass(60, "DoomImp")', 10),
    ("", 'StrICmp(GetActorClass(60), "DEMON")', 0),
    ("", "GetActorX(50) + GetActorY(50) * 2", (300 + 2 * 350) * FIXED),
    ("", "GetActorZ(63)", 40 * FIXED),
    ("", "GetActorFloorZ(63) + GetActorCeilingZ(63)", 104 * FIXED),
    ("", "GetActorAngle(60)", FIXED // 4),
    ("SetActorAngle(60, 0.5);", "GetActorAngle(60)", FIXED // 2),
    ("SetActorPitch(60, 0.25);", "GetActorPitch(60)", FIXED // 4),
    ("", "SetActorPosition(60, 310.0, 320.0, 0.0, 0)", 1),
    ("Thing_Move(62, 61);", "GetActorX(62)", 900 * FIXED),
    ("", "ActivatorTID()", 0),
    ("Thing_ChangeTID(0, 1);", "ActivatorTID()", 1),
    ("", "PlayerNumber() + 10 * PlayerCount() + 100 * PlayerInGame(0) + 1000 * SinglePlayer()", 1110),
    ("", "GameSkill() * 10 + GetCVar(\"skill\")", 22),
    ("int t = Timer(); Delay(5);", "Timer() - t", 5),
    ("", "PlayerHealth() + PlayerArmorPoints()", 100),
    ("DamageThing(30);", "PlayerHealth()", 70),
    ("HealThing(5);", "PlayerHealth()", 75),
    ('GiveInventory("Clip", 7);', 'CheckInventory("Clip")', 57),
    ('TakeInventory("Clip", 50);', 'CheckInventory("Clip")', 7),
    ('SetAmmoCapacity("Clip", 300);', 'GetAmmoCapacity("Clip")', 300),
    ("ClearInventory();", 'CheckInventory("Clip")', 0),
    ('GiveActorInventory(1, "Shell", 3);', 'CheckActorInventory(1, "Shell")', 3),
    ('TakeActorInventory(1, "Shell", 1);', 'CheckInventory("Shell")', 2),
    ("ClearActorInventory(1);", 'CheckInventory("Shell")', 0),
    ('GiveInventory("Shotgun", 1);', 'SetWeapon("Shotgun")', 1),
    ("Delay(40);", 'CheckWeapon("Shotgun") * 10 + StrCmp(GetWeapon(), "Shotgun")', 10),
    ("", "StrLen(\"four\") * 10 + (StrCmp(\"a\", \"b\") < 0)", 41),
    ("", 'SetActorState(60, "See") * 10 + SetActorState(60, "NoSuchState")', 10),
    ("", 'Thing_Damage2(61, 5, "None")', 1),
    ("", "GetActorProperty(61, APROP_Health) * 100 + CheckActorProperty(61, APROP_Health, 55)", 5501),
    ("SetActorProperty(60, APROP_Speed, 0); SetActorProperty(61, APROP_Speed, 0); Thing_Stop(61);",
     "GetActorVelX(61) + GetActorVelY(61) + GetActorVelZ(61)", 0),
    ("SetActorVelocity(61, 3.0, 2.0, 1.0, FALSE, FALSE);",
     "GetActorVelX(61) + GetActorVelY(61) * 10 + GetActorVelZ(61) * 100", 123 * FIXED),
    ("Thing_Stop(61); ThrustThing(0, 5, 0, 61); ThrustThingZ(61, 8, 0, 0);",
     "(GetActorVelX(61) > 0) * 10 + (GetActorVelZ(61) > 0)", 11),
    ("", "GetActorViewHeight(0)", 41 * FIXED),
    ("", "CheckSight(60, 61, 0)", 1),
    ("", "UniqueTID(1000) + IsTIDUsed(60) + IsTIDUsed(1000)", 1001),
    ("", "Sqrt(49) * 100 + VectorLength(3, 4) * 10 + (FixedSqrt(4.0) == 2.0)", 751),
    ("", "VectorAngle(0, 1.0) + 8 >> 4", FIXED // 4 // 16),  # the engine takes it from a coarse table
    ("", "FixedMul(1.5, -2.5) + FixedDiv(1.0, 4.0)", int((-3.75 + 0.25) * FIXED)),
    ('PlaySound(60, "demon/sight"); StopSound(60);', 'CheckFlag(60, "SOLID") * 10 + CheckFlag(60, "MISSILE")', 10),
    ("Thing_Deactivate(63);", "GetActorProperty(63, APROP_Dormant)", 1),
    ("Thing_Activate(63);", "GetActorProperty(63, APROP_Dormant)", 0),
    ("Thing_Hate(60, 61);", "SetActivatorToTarget(60) * 100 + ActivatorTID()", 161),
    ("", "SetActivator(0, AAPTR_PLAYER1) * 10 + PlayerNumber()", 10),
    ("Thing_Remove(62);", "IsTIDUsed(62)", 0),
    ("", "ACS_ExecuteWithResult(11, 6, 7)", 42),
    ("ACS_Execute(12, 0); Delay(5); ACS_Terminate(12, 0); int beats = heart; Delay(5);",
     "(heart == beats) * 10 + (beats >= 4)", 11),
    ("Thing_Destroy(61); Delay(60);", "ClassifyActor(61) * 10 + GetLevelInfo(LEVELINFO_KILLED_MONSTERS)", 801),
    ("Thing_Raise(61); Delay(60);", "ClassifyActor(61)", 48),
]  # fmt: skip
BUILT_INS_SOURCE = (
    HEADER
    + "int heart; script 11 (int a, int b) { SetResultValue(a * b); } "
    + "script 12 (void) { while (TRUE) { heart++; Delay(1); } }\n script 2 ENTER {\n"
    + "".join(f"{prelude} u{i} = {value};\n" for i, (prelude, value, _) in enumerate(BUILT_INS, 1))
    + "}"
)


@dataclass(frozen=True)
class Played:
    """What a map left behind; `user[i]` is USER variable i."""

    user: dict[int, int]
    finished: bool
    dead: bool
    log: str


def play(directory: Path, source: str, num_tics: int) -> Played:
    """Compiles `source` into health_gathering's room (its floor made harmless, map spot 50 added) and plays it."""
    room = parse_textmap(read_maps(read_wad(scenario_wad("health_gathering.wad")))["MAP01"]["TEXTMAP"].decode())
    del room.sectors[0]["special"]
    room.things.append(make_thing(9001, 300, 350, tid=50))
    behavior = compile_acs(source, actor_classes=declared_actors(DECORATE))
    wad = directory / "map.wad"
    wad.write_bytes(write_map_wad(textmap=write_textmap(room), behavior=behavior, scripts=source, decorate=DECORATE))
    result = subprocess.run(
        [sys.executable, PLAYER, wad, str(num_tics)], cwd=directory, capture_output=True, text=True, timeout=120
    )
    assert result.returncode == 0, result.stderr
    found = json.loads(result.stdout)
    user = {i: int(value) for i, value in enumerate(found["user"], 1)}
    return Played(user, found["finished"], found["dead"], (directory / "engine.log").read_text("latin-1"))


# Built-ins


@pytest.fixture(scope="module")
def built_ins(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return play(tmp_path_factory.mktemp("built_ins"), BUILT_INS_SOURCE, 400)


@pytest.mark.parametrize(
    ("number", "case"), list(enumerate(BUILT_INS, 1)), ids=[f"{prelude}{value}" for prelude, value, _ in BUILT_INS]
)
def test_a_built_in_does_in_the_engine_what_it_says(built_ins: Played, number: int, case: tuple[str, str, int]):
    assert built_ins.user[number] == case[2]


def test_the_engine_has_nothing_to_complain_about(built_ins: Played):
    complaints = ("unknown", "error", "tried to register", "runaway", "warning")
    assert [line for line in built_ins.log.splitlines() if any(word in line.lower() for word in complaints)] == []


def test_every_built_in_is_proven_in_the_engine_or_by_a_golden_pair():
    folder = Path(next(iter(importlib.util.find_spec("vizdoom").submodule_search_locations))) / "scenarios"
    sources = [BUILT_INS_SOURCE, EVENTS_SOURCE]
    for file in folder.glob("*.wad"):
        sources += [m["SCRIPTS"].decode("latin-1") for m in read_maps(read_wad(file.read_bytes())).values()]
    used = {token.text for source in sources for token in tokenize(source)}
    assert intrinsics().keys() <= used


# Events

EVENTS_SOURCE = (
    HEADER
    + """
    script 1 OPEN {
        SpawnForced("DoomImp", 900.0, 900.0, 0.0, 61); SetThingSpecial(61, ACS_ExecuteAlways, 10, 0, 61);
        SpawnForced("DoomImp", 300.0, 900.0, 0.0, 62); SetThingSpecial(62, ACS_ExecuteAlways, 10, 0, 62);
        SpawnForced("Demon", 900.0, 300.0, 0.0, 63);
        u1 = ThingCount(0, 61) + ThingCount(0, 62);
    }
    script 2 ENTER {
        Delay(2); Thing_Damage2(61, 1000, "None");
        ACS_Execute(3, 0); Delay(5);
        Exit_Normal(0);
    }
    script 3 (void) { SetActivator(63); Thing_Damage2(62, 1000, "None"); }
    script 10 (int victim) { if (PlayerNumber() >= 0) u2 = victim; else u3 = victim * 100 + ActivatorTID(); }
    """
)


def test_the_activator_of_a_death_special_is_the_killer(tmp_path: Path):
    played = play(tmp_path, EVENTS_SOURCE, 100)
    assert played.user[1] == 2
    assert played.user[2] == 61  # killed by the player
    assert played.user[3] == 62 * 100 + 63  # killed by the demon
    assert played.finished  # by Exit_Normal
    assert not played.dead


# Operators and statements


def wrap(value: int) -> int:
    return (value + 2**31) % 2**32 - 2**31


def divide(left: int, right: int) -> int:
    return abs(left) // abs(right) * (1 if (left < 0) == (right < 0) else -1)


OPERATORS = {
    "+": lambda a, b: wrap(a + b),
    "-": lambda a, b: wrap(a - b),
    "*": lambda a, b: wrap(a * b),
    "/": divide,
    "%": lambda a, b: a - divide(a, b) * b,
    "==": lambda a, b: int(a == b),
    "!=": lambda a, b: int(a != b),
    "<": lambda a, b: int(a < b),
    ">": lambda a, b: int(a > b),
    "<=": lambda a, b: int(a <= b),
    ">=": lambda a, b: int(a >= b),
    "&&": lambda a, b: int(bool(a and b)),
    "||": lambda a, b: int(bool(a or b)),
    "&": lambda a, b: a & b,
    "|": lambda a, b: a | b,
    "^": lambda a, b: a ^ b,
    "<<": lambda a, b: wrap(a << b),
    ">>": lambda a, b: a >> b,
}
LEVELS = ("||", "&&", "|", "^", "&", "== !=", "< > <= >=", "<< >>", "+ -", "* / %")
OPERANDS = {"x": 7, "y": -3, "z": 100_000, "m": 12, "u60": -1, "a[1]": 40, "c[x - 5]": 9} | {
    str(literal): literal for literal in (0, 2, 255, 256, 70_000)
}


def random_expression(rng: random.Random, depth: int, level: int = 0) -> tuple[str, int]:
    """ACS text whose operators bind as tightly as those of LEVELS[level] or tighter, and its value."""
    if level == len(LEVELS):
        form = rng.choice(("operand", "unary", "parentheses")) if depth else "operand"
        if form == "operand":
            return rng.choice(list(OPERANDS.items()))
        if form == "parentheses":
            text, value = random_expression(rng, depth - 1)
            return f"({text})", value
        text, value = random_expression(rng, depth - 1, level)
        operator = rng.choice("-!~")
        return f"{operator} {text}", {"-": wrap(-value), "!": int(not value), "~": ~value}[operator]
    text, value = random_expression(rng, depth, level + 1)
    for _ in range(rng.choice((0, 0, 1))):
        operator = rng.choice(LEVELS[level].split())
        right_text, right = random_expression(rng, depth, level + 1)
        if (operator in "/%" and right == 0) or (operator in ("<<", ">>") and not 0 <= right < 32):
            right_text, right = "3", 3
        text, value = f"{text} {operator} {right_text}", OPERATORS[operator](value, right)
    return text, value


def test_expressions_have_the_value_their_precedence_gives(tmp_path: Path):
    rng = random.Random(11)
    cases = [random_expression(rng, depth=2) for _ in range(59)]
    assert {operator for text, _ in cases for operator in OPERATORS if f" {operator} " in text} == set(OPERATORS)
    assignments = "".join(f"u{i} = {text};\n" for i, (text, _) in enumerate(cases, 1))
    source = (
        f"{HEADER} int m = 12, a[3] = {{ 0, 40 }}; script 1 OPEN {{ int x = 7, y = -3, z = 100000, c[4];\n"
        f"c[2] = 9; u60 = -1;\n{assignments} }}"
    )
    played = play(tmp_path, source, 2)
    wrong = {text: (played.user[i], value) for i, (text, value) in enumerate(cases, 1) if played.user[i] != value}
    assert wrong == {}


STATEMENTS = [
    # (statements that set r, the value of r)
    ("for (i = 0; i < 5; i++) r += i;", 10),
    ("for (i = 0; i < 10; i++) { if (i == 3) continue; if (i == 6) break; r = r * 10 + i; }", 1245),
    ("i = 4; while (i) { i--; if (i == 2) continue; r = r * 10 + i; }", 310),
    ("i = 4; until (i == 0) { r += i; --i; }", 10),
    ("i = 0; do { i++; if (i < 3) continue; r += 100; } while (i < 5); r += i;", 305),
    ("i = 0; do r++; until (++i >= 4);", 4),
    ("for (i = 0; i < 3; i++) for (int j = 0; j < 3; j++) { if (j == 2) break; r = r * 10 + j; }", 10101),
    ("for (i = -1; i < 4; i++) switch (i) { case 2: r += 100; break; case -1: r += 1; case 0: r += 10; break; "
     "default: r += 1000; }", 2121),
    ("switch (5) { case 1: r = 1; } r += 2;", 2),
    ("switch (5) { default: r = 1; break; case 1: r = 2; }", 1),
    ("for (i = 0; i < 3; i++) { switch (i) { case 1: continue; } r++; }", 2),
    ("if (0) r = 1; else if (0) r = 2; else r = 3;", 3),
    ("if (1) r = 1; else if (1) r = 2; else r = 3;", 1),
    ("if (0) r = 1; else if (1) r = 2; else r = 3;", 2),
    ("i = 3; r = i++ * 10 + i;", 34),
    ("i = 3; r = ++i * 10 + i--; r = r * 10 + i;", 443),
    ("a[0] = 5; r = a[0]++ * 100 + ++a[0] * 10 + a[0]--; a[0]--; r = r * 10 + a[0];", 5775),
    ("int c[2] = { 5 }; r = c[0]++ * 100 + ++c[0] * 10 + c[1]--; r += c[1];", 569),
    ("m = 20; m += 4; m -= 2; m *= 3; m /= 4; m %= 10; r = m;", 6),
    ("i = 20; i += 4; i -= 2; i *= 3; i /= 4; i %= 10; r = i;", 6),
    ("u60 = 20; u60 += 4; u60 -= 2; u60 *= 3; u60 /= 4; u60 %= 10; u60++; ++u60; u60--; --u60; r = u60;", 6),
    ("a[1] = 20; a[1] += 4; a[1] -= 2; a[1] *= 3; a[1] /= 4; a[1] %= 10; r = a[1];", 6),
    ("int d[2]; d[1] = 20; d[1] += 4; d[1] -= 2; d[1] *= 3; d[1] /= 4; d[1] %= 10; r = d[1];", 6),
    ("r = factorial(6);", 720),
    ("r = sum_of_locals(3);", 3 * 24),
    ("set_m(8); r = m;", 8),
    ("i = 1, r = 2; r += i;", 3),
    ("r = with_array(5) + with_array(2);", 50 + 20),
    ('str s = "abc"; r = (s == "abc") * 10 + (s == "ab"); r += StrLen(names[1]);', 12),
    ("r = ACS_ExecuteWithResult(20, 9);", 9 * 25),
]  # fmt: skip
FUNCTIONS = f"""
int m, a[3], r; str names[2] = {{ "", "xy" }};
function int factorial(int n) {{ if (n < 2) return 1; return n * factorial(n - 1); }}
function int sum_of_locals(int n) {{
    int {", ".join(f"v{i} = n" for i in range(24))};
    return {" + ".join(f"v{i}" for i in range(24))};
}}
function void set_m(int value) {{ if (value == 8) {{ m = value; return; }} m = -1; }}
function int with_array(int n) {{ int c[10]; for (int i = 0; i < 10; i++) c[i] += n; return c[0] + c[9] * 9; }}
script 20 (int n) {{ int {", ".join(f"v{i} = n" for i in range(25))}; SetResultValue(v0 * 24 + v24); }}
"""


def test_statements_run_in_the_order_they_say(tmp_path: Path):
    bodies = "".join(f"r = 0; {body}\n u{i} = r;\n" for i, (body, _) in enumerate(STATEMENTS, 1))
    played = play(tmp_path, f"{HEADER}{FUNCTIONS} script 1 OPEN {{ int i;\n{bodies} }}", 2)
    wrong = {body: (played.user[i], value) for i, (body, value) in enumerate(STATEMENTS, 1) if played.user[i] != value}
    assert wrong == {}
