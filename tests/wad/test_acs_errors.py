"""What the ACS compiler refuses: every error by its place and its text."""

import pickle
import sys

import pytest

from gvz.core.errors import AcsError
from gvz.wad.acs import compile_acs
from gvz.wad.acs.cursor import MAX_NESTING


def error_of(source: str, **options) -> AcsError:
    with pytest.raises(AcsError) as caught:
        compile_acs(source, **options)
    return caught.value


@pytest.mark.parametrize(
    ("source", "line", "column", "text"),
    [
        # characters and literals
        ("script 1 OPEN { $ }", 1, 17, "got the character '$', want a name, number, string or operator"),
        ("\n /* open", 2, 2, "unterminated comment: got the end of the source, want '*/'"),
        ('str s = "open\n";', 1, 9, "unterminated string: got the end of the line, want a closing '\"'"),
        ('str s = "a\tb";', 1, 9, "string: got the character '\\t', want printable Latin-1"),
        ('str s = "\u20ac";', 1, 9, "string: got the character '\u20ac', want printable Latin-1"),
        ("int x = 2147483648;", 1, 9, "got the number 2147483648, want at most 2147483647"),
        ("int x = 0x100000000;", 1, 9, "got the number 0x100000000, want at most 4294967295"),
        ("int x = 32768.0;", 1, 9, "got the number 32768.0, want at most 32767.99998"),
        ("int x = 12345678901234567;", 1, 9, "got a number of 17 characters, want at most 16"),
        # grammar
        ("script 1 OPEN", 1, 14, "got the end of the source, want a statement"),
        ("script 1 OPEN {", 1, 16, "got the end of the source, want a statement or '}'"),
        ("script 1 OPEN { Delay(1) }", 1, 26, "got symbol '}', want ';'"),
        ("script OPEN { }", 1, 8, "got the keyword 'open', want the name of a script number's constant"),
        ("script 1 CLOSED { }", 1, 10, "got name 'closed', want '(' or 'open' or 'enter' or 'respawn' or 'death'"),
        ('script "a" OPEN { }', 1, 8, "got string 'a', want the name of a script number's constant"),
        ("Delay(1);", 1, 1, "got name 'delay', want 'script', 'function', 'global', 'int', 'str', 'bool' or '#'"),
        ('#include "other.acs"', 1, 10, "#include: got string 'other.acs', want \"zcommon.acs\""),
        ("#library", 1, 2, "got name 'library', want 'include'"),
        ("global int x:y;", 1, 12, "got name 'x', want the number of a global variable"),
        ("int if;", 1, 5, "got the keyword 'if', want the name of a variable"),
        ("int 5;", 1, 5, "got number '5', want the name of a variable"),
        ("int a[2] = 5;", 1, 12, "got number '5', want '{'"),
        ("script 1 OPEN { int x = ; }", 1, 25, "got symbol ';', want an expression"),
        ("script 1 OPEN { else ; }", 1, 17, "got name 'else', want a statement"),
        ("script 1 OPEN { int x; x 5; }", 1, 26, "got number '5', want '='"),
        ("script 1 OPEN { switch (1) { case 1 } }", 1, 37, "got symbol '}', want ':'"),
        ("script 1 OPEN { switch (1) {", 1, 29, "got the end of the source, want 'case', 'default', a"),
        ("script 1 OPEN { Log(x:1); }", 1, 21, "got name 'x', want 's' or 'd' or 'i' or 'c' or 'f'"),
        ("script 1 OPEN { case 1: ; }", 1, 17, "got name 'case', want a statement"),
        # names
        ("script 1 OPEN { Dely(1); }", 1, 17, "undeclared name 'dely' (did you mean 'delay'?), want a declared one"),
        ("script 1 OPEN { zzqq = 1; }", 1, 17, "got the undeclared name 'zzqq', want a declared one"),
        ("int x; int X;", 1, 12, "got 'x' again, want a name that is not yet in use"),
        ("int x; script 1 OPEN { int x; }", 1, 28, "got 'x' again"),
        ("int spawn;", 1, 5, "got 'spawn' again"),
        ("int true;", 1, 5, "got 'true' again"),
        ("function void f(int a, int a) { }", 1, 24, "got 'a' again"),
        ("function void f(void) { } function void f(void) { }", 1, 27, "got 'f' again"),
        ("script 1 OPEN { int x; } script 2 OPEN { x = 1; }", 1, 42, "got the undeclared name 'x'"),
        ("int x = y; int y;", 1, 9, "got the undeclared name 'y'"),
        ("script 1 OPEN { Delay = 1; }", 1, 17, "got 'delay', which cannot be changed, want a variable"),
        ("script 1 OPEN { TRUE++; }", 1, 17, "got 'true', which cannot be changed, want a variable"),
        ("int x; script 1 OPEN { x(1); }", 1, 24, "got a call of 'x', want the name of a function"),
        ("script 1 OPEN { int x = Delay; }", 1, 25, "got the function 'delay' without '(', want a call or a value"),
        ("int a[2]; script 1 OPEN { a = 1; }", 1, 27, "got the array 'a' without an index, want a[...]"),
        ("int a; script 1 OPEN { a[0] = 1; }", 1, 24, "got an index on 'a', want it on an array"),
        ("script 1 OPEN { int x = TRUE[0]; }", 1, 25, "got an index on 'true', want it on an array"),
        # arguments and types
        ("script 1 OPEN { Delay(); }", 1, 17, "Delay: got 0 arguments, want 1"),
        ('script 1 OPEN { Spawn("Demon"); }', 1, 17, "Spawn: got 1 arguments, want 4 to 6"),
        ("script 1 OPEN { Thing_Damage(1, 2, 3, 4); }", 1, 17, "Thing_Damage: got 4 arguments, want 2 to 3"),
        ("script 1 OPEN { f(1); } function void f(void) { }", 1, 17, "f: got 1 arguments, want 0"),
        ("script 1 OPEN { GiveInventory(1, 1); }", 1, 31, "argument 1 of GiveInventory: got a number, want a string"),
        ('script 1 OPEN { Delay("1"); }', 1, 23, "argument 1 of Delay: got a string, want a number"),
        ('script 1 OPEN { int x = 1 + "a"; }', 1, 29, "right of '+': got a string, want a number"),
        ('script 1 OPEN { int x = "a" * 1; }', 1, 25, "left of '*': got a string, want a number"),
        ('script 1 OPEN { int x = -"a"; }', 1, 26, "operand of '-': got a string, want a number"),
        ('script 1 OPEN { if ("a") ; }', 1, 21, "condition: got a string, want a number"),
        ('int a[2]; script 1 OPEN { a["x"] = 1; }', 1, 29, "index of 'a': got a string, want a number"),
        ("str s; script 1 OPEN { s = 1; }", 1, 28, "value of 's': got a number, want a string"),
        ('str s; script 1 OPEN { s += "a"; }', 1, 24, "got '+=' on the string 's', want '='"),
        ("script 1 OPEN { f(1); } function void f(str s) { }", 1, 19, "value of 's': got a number, want a string"),
        ("function str f(void) { return 1; }", 1, 31, "result of 'f': got a number, want a string"),
        ("str s = 5;", 1, 9, "start value of 's': got a number, want a string"),
        ("script 1 OPEN { int x = Delay(1); }", 1, 25, "value of 'x': got a function that returns nothing"),
        ("script 1 OPEN { int x = f(); } function void f(void) { }", 1, 25, "nothing, want a value"),
        ("script 1 OPEN { Log(s:1); }", 1, 23, "log of 's': got a number, want a string"),
        (
            "script 1 OPEN { SetActorProperty(0, APROP_Speed, 20); }", 1, 50,
            "argument 3 of SetActorProperty: got the integer 20, want a fixed-point number such as 20.0",
        ),
        (
            'script 1 OPEN { Spawn("Demon", -96, 0, 0); }', 1, 33,
            "argument 2 of Spawn: got the integer 96, want a fixed-point number such as 96.0",
        ),
        (
            "script 1 OPEN { int x = FixedMul(Cos(0.5), 735); }", 1, 44,
            "argument 2 of FixedMul: got the integer 735, want a fixed-point number such as 735.0",
        ),
        ("script 1 OPEN { int x = FixedDiv(-1, 3.0); }", 1, 35, "argument 1 of FixedDiv: got the integer 1, want"),
        (
            "#define RADIUS 735\nscript 1 OPEN { int x = FixedMul(RADIUS, 0.5); }", 2, 34,
            "argument 1 of FixedMul: got the integer 735, want a fixed-point number such as 735.0",
        ),
        ("script 1 OPEN { TakeInventory(ON, 1); }", 1, 31, "argument 1 of TakeInventory: got a number, want a string"),
        ("script 5 OPEN { ACS_Execute(3, 0); }", 1, 29, "got script 3, which is not there, want one of [5]"),
        ("#define N 6\nscript 5 OPEN { ACS_ExecuteAlways(N); }", 2, 35, "got script 6, which is not there"),
        ("script 5 OPEN { SetThingSpecial(1, ACS_Execute, 7); }", 1, 49, "got script 7, which is not there"),
        ('script 5 OPEN { ACS_Terminate("x", 0); }', 1, 31, "argument 1 of ACS_Terminate: got a string, want a number"),
        # statements out of place
        ("script 1 OPEN { break; }", 1, 17, "got 'break' outside a loop, want it in one"),
        ("script 1 OPEN { switch (1) { case 1: continue; } }", 1, 38, "got 'continue' outside a loop, want it in one"),
        ("script 1 OPEN { return; }", 1, 17, "got 'return' in a script, want 'terminate'"),
        ("function void f(void) { terminate; }", 1, 25, "got 'terminate' in a function, want 'return'"),
        ("function void f(void) { Delay(1); }", 1, 25, "got Delay in a function, want it in a script"),
        ("function void f(void) { return 1; }", 1, 25, "got a value, want none: function 'f' is void"),
        ("function int f(void) { return; }", 1, 24, "got no value, want one: function 'f' returns int"),
        ("function int f(void) { \n }", 2, 2, "got the end of function 'f', want 'return' with a value"),
        ("script 1 OPEN { switch (1) { case 1: case 1: } }", 1, 38, "got case 1 again, want it once"),
        ("script 1 OPEN { switch (1) { default: default: } }", 1, 39, "got default again, want it once"),
        # constants and limits
        ("int x; int y = x;", 1, 16, "start value of 'y': got a value known only when the script"),
        ("int x = 1 / 0;", 1, 11, "got a division by zero on the right of '/', want another constant"),
        ("int x = 1 % 0;", 1, 11, "got a division by zero on the right of '%'"),
        ("script 1 OPEN { int x = Timer() / 0; }", 1, 35, "got a division by zero on the right of '/'"),
        ("script 1 OPEN { int x = 1 / (2 - 2); }", 1, 32, "got a division by zero on the right of '/'"),
        ("#define N 0\nscript 1 OPEN { int x = 1;\n x %= N; }", 3, 7, "got a division by zero on the right of '%='"),
        ("int a[3]; script 1 OPEN { a[3] = 1; }", 1, 29, "index of 'a': got 3, want 0 to 2"),
        ("script 1 OPEN { int a[2]; a[0] = a[-1]; }", 1, 36, "index of 'a': got -1, want 0 to 1"),
        ("#define N 2\nint a[N]; script 1 OPEN { a[N]++; }", 2, 29, "index of 'a': got 2, want 0 to 1"),
        ("int x = Timer();", 1, 9, "got a value known only when the script runs, want a constant"),
        ('int x = 1 + "a";', 1, 13, "start value of 'x': got a string, want a number"),
        ("int a[0];", 1, 5, "size of 'a': got 0, want 1 to 65536"),
        ("int a[65537];", 1, 5, "size of 'a': got 65537, want 1 to 65536"),
        ("int a[1] = { 1, 2 };", 1, 5, "array 'a': got 2 values, want at most 1"),
        ("global int 64:x;", 1, 1, "got global variable 64, want a number from 0 to 63"),
        ("script 0 OPEN { }", 1, 1, "script number: got 0, want 1 to 32767"),
        ("script 1 OPEN { } script 1 ENTER { }", 1, 19, "got script 1 again, want another number"),
        ("script 1 (int a, int b, int c, int d, int e) { }", 1, 1, "script 1: got 5 parameters, want at most 4"),
        ("script 1 (void) DISCONNECT { }", 1, 1, "disconnect script: got 0 parameters, want 1, the player"),
    ],
)  # fmt: skip
def test_an_error_says_where_and_what_was_found_and_expected(source: str, line: int, column: int, text: str):
    error = error_of(source)
    assert text in str(error)
    assert (error.line, error.column) == (line, column)
    assert str(error).startswith(f"ACS script, line {line}, column {column}: ")
    sent = pickle.loads(pickle.dumps(error))  # as a worker process sends it
    assert (str(sent), sent.line, sent.column) == (str(error), line, column)


@pytest.mark.parametrize(
    ("source", "text"),
    [
        (f"function void f({', '.join(f'int v{i}' for i in range(256))}) {{ }}", "got more than 255 local variables"),
        ("".join(f"int v{i};" for i in range(129)), "got more than 128 map variables"),
        ("".join(f"function void f{i}(void) {{ }}" for i in range(257)), "got more than 256 functions"),
        (f"script 1 OPEN {{ int {', '.join(f'v{i}' for i in range(256))}; }}", "got more than 255 local variables"),
        (f"script 1 OPEN {{ int {', '.join(f'v{i}[1]' for i in range(256))}; }}", "got more than 255 local variables"),
    ],
)
def test_numbers_that_the_object_file_cannot_hold_are_refused(source: str, text: str):
    assert text in str(error_of(source))


def test_more_strings_than_the_engine_holds_are_refused():
    texts = ", ".join(f'"{i}"' for i in range(32769))
    assert "got more than 32768 different strings" in str(error_of(f"str s[32769] = {{ {texts} }};"))


# Actor classes


@pytest.mark.parametrize(
    "source",
    [
        'script 1 OPEN { Spawn("NoSuch", 0.0, 0.0, 0.0); }',
        'script 1 OPEN { GiveInventory("NoSuch", 1); }',
        'script 1 OPEN { if (SetWeapon("NoSuch")) ; }',
        'script 1 OPEN { CheckActorClass(0, "NoSuch"); }',
        'script 1 OPEN { str m = "NoSuch"; GiveInventory(m, 1); }',
        'script 1 OPEN { str m[2] = { "Demon", "NoSuch" }, c = m[0]; GiveInventory(c, 1); }',
        'str kinds[2] = { "Demon", "NoSuch" }; script 1 OPEN { GiveInventory(kinds[1], 1); }',
        'str kinds[2]; script 1 OPEN { GiveInventory(kinds[1], 1); } script 2 OPEN { kinds[0] = "NoSuch"; }',
        'script 1 OPEN { give("NoSuch"); } function void give(int what) { GiveInventory(what, 1); }',
        'script 1 OPEN { GiveInventory(kind(), 1); } function str kind(void) { return "NoSuch"; }',
        '#define KIND "NoSuch"\nscript 1 OPEN { GiveInventory(KIND, 1); }',
    ],
)
def test_an_unknown_actor_class_is_found_wherever_its_name_comes_from(source: str):
    error = error_of(source)
    assert "got the unknown actor class 'NoSuch', want one the engine or DECORATE has" in str(error)
    place = source.splitlines()[error.line - 1][error.column - 1 :]
    assert place.startswith(('"NoSuch"', "KIND"))


def test_a_misspelt_actor_class_is_answered_with_the_nearest():
    assert "did you mean 'Cacodemon'?" in str(error_of('script 1 OPEN { Spawn("Cacodemn", 0.0, 0.0, 0.0); }'))


def test_actor_classes_of_the_caller_are_known_and_case_is_ignored():
    source = 'script 1 OPEN { Spawn("poison", 0.0, 0.0, 0.0); Spawn("DEMON", 0.0, 0.0, 0.0); }'
    assert compile_acs(source, actor_classes=["Poison"])
    assert "'poison'" in str(error_of(source))


def test_a_string_that_names_no_class_may_be_anything():
    assert compile_acs('str text = "NoSuch"; script 1 OPEN { Log(s:text); SetActorState(0, "NoSuch"); }')


# Nesting


def nested(kind: str, depth: int) -> str:
    """A source whose deepest place is `depth` statements and operands down; the script's body is the first."""
    operators = ("||", "&&", "|", "^", "&", "==", "<", "<<", "+", "*")
    climb = "".join(("(", *(f"a {o} " for o in operators))[i % 11] for i in range(depth - 2))
    start, end = {
        "blocks": ("{" * depth, "}" * depth),
        "ifs": ("if (a) " * (depth - 1), ";"),
        "parentheses": ("a = " + "(" * (depth - 2), "a" + ")" * (depth - 2) + ";"),
        "operators": (f"a = {climb}", "a" + ")" * climb.count("(") + ";"),
        "negations": ("a = " + "!" * (depth - 2), "a;"),
        "indices": ("b" + "[b" * (depth - 2) + "[a]", "]" * (depth - 2) + " = 1;"),
        "calls": ("a = " + "f(" * (depth - 2), "a" + ")" * (depth - 2) + ";"),
    }[kind]
    return f"int a, b[9]; function int f(int x) {{ return x; }} script 1 OPEN {start}{end}"


@pytest.mark.parametrize("kind", ["blocks", "ifs", "parentheses", "operators", "negations", "indices", "calls"])
def test_nesting_is_bounded_far_from_pythons_own_limit(kind: str):
    limit = sys.getrecursionlimit()
    frames_in_use = 0
    frame = sys._getframe()
    while frame is not None:
        frames_in_use += 1
        frame = frame.f_back
    sys.setrecursionlimit(frames_in_use + 600)
    try:
        assert compile_acs(nested(kind, MAX_NESTING))
        error = error_of(nested(kind, MAX_NESTING + 1))
        assert f"nested too deeply: got {MAX_NESTING + 1} levels, want at most {MAX_NESTING}" in str(error)
        assert "nested too deeply" in str(error_of(nested(kind, 5_000)))
    finally:
        sys.setrecursionlimit(limit)
