"""The ACS compiler: instructions of small sources worked out by hand, and every error by its text."""

import struct
import sys

import pytest

from gvz.errors import AcsError
from gvz.wad.acs import compile_acs
from gvz.wad.acs.cursor import MAX_NESTING

TERMINATE = 1


def chunks(behavior: bytes) -> dict[str, list[bytes]]:
    """Chunks of a hybrid object file by name, found the way the engine finds them."""
    (directory,) = struct.unpack_from("<I", behavior, 4)
    start, magic = struct.unpack_from("<I4s", behavior, directory - 8)
    assert magic == b"ACSe"
    found: dict[str, list[bytes]] = {}
    while start < directory - 8:
        name, size = struct.unpack_from("<4sI", behavior, start)
        found.setdefault(name.decode(), []).append(behavior[start + 8 : start + 8 + size])
        start += 8 + size
    assert start == directory - 8
    return found


def code(source: str) -> bytes:
    """Instructions of the only script, from its address to the closing TERMINATE."""
    behavior = compile_acs(source)
    (entry,) = chunks(behavior)["SPTR"]
    assert len(entry) == 8
    (address,) = struct.unpack_from("<I", entry, 4)
    end = behavior.index(b"SPTR") - 4  # one dummy script follows the code
    body = behavior[address:end].rstrip(b"\0")
    assert body[-1] == TERMINATE
    return body[:-1]


def body(statements: str, before: str = "") -> bytes:
    return code(f"{before} script 1 OPEN {{ {statements} }}")


def error_of(source: str, **options) -> AcsError:
    with pytest.raises(AcsError) as caught:
        compile_acs(source, **options)
    return caught.value


# Instructions


@pytest.mark.parametrize(
    ("statements", "expected"),
    [
        ("", ""),
        ("int x = 5;", "a7 05 19 00"),
        ("int x = 256;", "03 00010000 19 00"),
        ("int x = -1;", "a7 01 4e 19 00"),
        ("int x = 0.5;", "03 00800000 19 00"),
        ("int x = 0xFF, y = x;", "a7 ff 19 00 1c 00 19 01"),
        ("int x; x += 1; x -= 2; x *= 3;", "a7 01 1f 00 a7 02 22 00 a7 03 25 00"),
        ("int x; x /= 4; x %= 5;", "a7 04 28 00 a7 05 2b 00"),
        ("int x; x++; ++x; x--; --x;", "2e 00 2e 00 31 00 31 00"),
        ("int x; x = x++ + --x;", "1c 00 2e 00 31 00 1c 00 0e 19 00"),
        ("int x = 1 + 2 * 3 - 4 % 2;", "b1 01 02 03 10 0e b0 04 02 12 0f 19 00"),
        ("int x = (1 + 2) * 3;", "b0 01 02 0e a7 03 10 19 00"),
        ("int x = 1 < 2 && 3 >= 4 || !5 != 6;", "b0 01 02 15 b0 03 04 18 46 a7 05 4b a7 06 14 47 19 00"),
        ("int x = ~1 | 2 ^ 3 & 4 << 5 >> 6;", "a7 01 f0 5a b2 02 03 04 05 4c a7 06 4d 48 4a 49 19 00"),
        ("int x = +7;", "a7 07 19 00"),
        ("Delay(1);", "a7 01 37"),
        ("Exit_Normal(0);", "a7 00 04 f3"),
        ("Thing_Damage(1, 2, 3);", "b1 01 02 03 06 77"),
        ("int x = Thing_Damage(1, 2);", "b3 01 02 00 00 00 f0 17 77 19 00"),
        ("Random(1, 2);", "b0 01 02 39 36"),
        ('Spawn("Demon", 1.0, 2.0, 0.0);', "a7 00 03 00000100 03 00000200 b1 00 00 00 95 36"),
        ("SetActivatorToTarget(7);", "a7 07 f0 6f 01 0d00 36"),
        ("int x = SetActivator(7, 2);", "b0 07 02 f0 6f 02 0c00 19 00"),
        ("SetThingSpecial(9, ACS_ExecuteAlways, 1);", "af 07 09 e2 01 00 00 00 00 b4"),
        ("SetThingSpecial(9, Thing_Remove, 1, 2, 3);", "af 07 09 84 01 02 03 00 00 b4"),
        ("SetThingSpecial(9, 132, 1, 2, 3, 4, 5);", "af 07 09 84 01 02 03 04 05 b4"),
        ("suspend; restart; terminate;", "02 45"),
        ('Log(s:"a", d:1, c:65, f:1.5, i:2);', "55 a7 00 57 a7 01 58 a7 41 59 03 00800100 9d a7 02 58 f0 1e"),
        ('Print(s:"a");', "55 a7 00 57 56"),
    ],
)  # fmt: skip
def test_instructions_are_those_worked_out_by_hand(statements: str, expected: str):
    assert body(statements).hex() == expected.replace(" ", "")


@pytest.mark.parametrize(
    ("declaration", "expected"),
    [
        ("int v;", "a7 01 1a 00 1d 00 1b"),
        ("global int 7:v;", "a7 01 b5 07 b6 07 1b"),
    ],
)
def test_assignment_goes_where_the_variable_lives(declaration: str, expected: str):
    assert body("v = 1; Delay(v);", declaration)[:6].hex() == expected.replace(" ", "")[:12]


def test_an_array_index_is_evaluated_once_when_an_element_is_changed_in_an_expression():
    assert body("int x = a[2]++; x = ++a[1];", "int a[3];").hex() == (
        "a702" "d8" "cf00" "d9" "d600" "1900" "a701" "d8" "d600" "cf00" "1900"
    )  # fmt: skip


def test_a_local_array_takes_its_values_element_by_element():
    behavior = compile_acs('script 9 OPEN { str a[3] = { "x", "y" }; int b[2]; }')
    assert chunks(behavior)["SARY"] == [struct.pack("<hII", 9, 3, 2)]
    assert bytes.fromhex("b00000f07c00b00101f07c00") in behavior


def test_a_function_with_arrays_gets_its_own_chunk():
    behavior = compile_acs("function void f(void) { } function void g(int x) { int a[5], y; a[0] = x; y = 1; }")
    assert chunks(behavior)["FARY"] == [struct.pack("<hI", 1, 5)]
    assert chunks(behavior)["FUNC"] == [struct.pack("<4BI4BI", 0, 0, 0, 0, 8, 1, 1, 0, 0, 9)]


def test_more_than_twenty_locals_are_announced():
    declared = ", ".join(f"v{i}" for i in range(21))
    assert chunks(compile_acs(f"script 5 (int a) {{ int {declared}; }}"))["SVCT"] == [struct.pack("<hH", 5, 22)]
    assert "SVCT" not in chunks(compile_acs("script 5 (int a) { int b; }"))


def test_script_types_and_parameters_stand_in_the_script_table():
    source = """script 1 OPEN {} script 2 ENTER {} script 3 RESPAWN {} script 4 DEATH {}
        script 5 (int who) DISCONNECT {} script 6 (void) {} script 300 (int a, int b, int c, int d) {}"""
    (table,) = chunks(compile_acs(source))["SPTR"]
    entries = [struct.unpack_from("<hBB", table, 8 * i) for i in range(7)]
    assert entries == [(1, 1, 0), (2, 4, 0), (3, 2, 0), (4, 3, 0), (5, 14, 1), (6, 0, 0), (300, 0, 4)]


def test_start_values_of_map_variables_are_trimmed_and_arrays_keep_theirs_apart():
    found = chunks(compile_acs('int a, b = 2, c[3] = { 5, 0 }, d = -1, e; str s[2] = { "x" };'))
    assert found["MINI"] == [struct.pack("<I3i", 1, 2, 0, -1)]
    assert found["ARAY"] == [struct.pack("<4I", 2, 3, 5, 2)]
    assert found["AINI"] == [struct.pack("<2I", 2, 5)]  # of s all values are 0, as string 0


def test_a_run_of_constants_becomes_one_instruction_of_at_most_255():
    parameters = ", ".join(f"int p{i}" for i in range(200))
    inner = f"f({', '.join(['8'] * 200)})"
    outer = f"f({', '.join(['9'] * 199)}, {inner})"
    behavior = compile_acs(f"script 1 OPEN {{ {outer}; }} function int f({parameters}) {{ return 0; }}")
    run = bytes([9] * 199 + [8] * 200)
    expected = bytes((175, 255)) + run[:255] + bytes((175, 144)) + run[255:] + bytes((203, 0, 204, 0))
    assert behavior[8:].startswith(expected)


def test_the_last_statement_of_a_void_function_may_be_a_conditional_return():
    behavior = compile_acs("function void f(int x) { if (x) return; }")
    assert behavior[8:].startswith(bytes.fromhex("1c00 4f 10000000 cd cd"))


def test_switch_jumps_through_a_sorted_table():
    source = """script 1 OPEN { int x; switch (x) { case 7: x = 1; break; case -2: x = 2; default: x = 3; } }"""
    behavior = compile_acs(source)
    position = behavior.index(bytes((240, 16)))
    table = position + 2 + -(position + 2) % 4
    count, first, address_of_first, second, address_of_second = struct.unpack_from("<IiIiI", behavior, table)
    assert (count, first, second) == (2, -2, 7)
    assert behavior[address_of_first:].startswith(bytes.fromhex("a702 1900"))
    assert behavior[address_of_second:].startswith(bytes.fromhex("a701 1900"))
    assert behavior[table + 20] == 54  # DROP, then on to default


def test_break_and_continue_leave_and_repeat_the_innermost_loop():
    # do { continue; break; } while (x):  GOTO test, GOTO end, test: PUSH x, IFGOTO top, end:
    assert body("int x; do { continue; break; } while (x);").hex() == "341200000034190000001c003508000000"
    # while (x) { break; }:  top: PUSH x, IFNOTGOTO end, GOTO end, GOTO top, end:
    assert body("int x; while (x) { break; }").hex() == "1c004f1900000034190000003408000000"
    assert body("int x; until (x);").hex() == "1c0035140000003408000000"
    assert body("int x; do ; until (x);").hex() == "1c004f08000000"


def test_a_chain_of_else_if_may_be_long():
    chain = " ".join(f"else if (x == {i}) x = 0;" for i in range(500))
    assert body(f"int x; if (x) x = 1; {chain} else x = 2;")


def test_a_long_sum_compiles():
    assert body("int x = 1" + " + 1" * 5000 + ";").count(bytes((167, 1, 14))) == 4999
    assert compile_acs("int x = 1" + " + 1" * 5000 + ";")


def test_names_and_keywords_ignore_case():
    assert body("INT X = 1; DELAY(x);") == body("int x = 1; delay(X);")


def test_a_name_of_a_script_is_free_again_after_it():
    assert compile_acs("script 1 OPEN { int x; } function void f(int x) { } int x; script 2 (int y) { x = y; }")


def test_a_script_whose_number_only_the_game_knows_may_be_started():
    assert compile_acs("script 1 (int n) { ACS_Execute(n, 0); ACS_Execute(n + 1, 0); }")


def test_equal_strings_are_stored_once_in_order_of_first_use():
    (table,) = chunks(compile_acs('script 1 OPEN { Log(s:"b", s:"a"); Log(s:"b"); Log(s:"A"); }'))["STRL"]
    assert table == struct.pack("<6I", 0, 3, 0, 24, 26, 28) + b"b\0a\0A\0" + b"\0\0"


def test_constants_may_be_defined_and_folded():
    source = """#define SIZE 2 * 2
        #define NAME "Demon"
        int a[SIZE - 1] = { -SIZE, SIZE / 3, -7 % 4, }; str s = NAME;
        int b = 7 / -2 == -3 && 1 << 4 != 17, c = !0 + ~0 - (3 ^ 1), d = 1.5 > 1 || 2 <= 1 | 4 & 6, e = 8 >> 2 >= 2 < 1;
        script SIZE OPEN { Spawn(NAME, 0.0, 0.0, 0.0); switch (1) { case SIZE: } }"""
    found = chunks(compile_acs(source))
    assert found["AINI"] == [struct.pack("<I3i", 0, -4, 1, -3)]
    assert found["MINI"] == [struct.pack("<I3i", 2, 1, -2, 1)]
    assert found["SPTR"][0].startswith(struct.pack("<h", 4))


def test_arithmetic_of_constants_wraps_at_32_bits():
    assert chunks(compile_acs("int a = 2147483647 + 2, b = 0x10000 * 0x10000 - 1;"))["MINI"] == [
        struct.pack("<I2i", 0, -2147483647, -1)
    ]


def test_a_source_without_scripts_is_the_empty_object_file():
    assert compile_acs('#include "zcommon.acs"').hex() == "41435300100000000800000041435365" + "00" * 8


def test_no_dummy_script_stands_for_a_number_beyond_255():
    behavior = compile_acs("script 300 OPEN {} script 255 (int a) {}")
    assert behavior.endswith(struct.pack("<5I", 1, 255, 12, 1, 0))


# Errors


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
        ("script 1 OPEN { Dely(1); }", 1, 17, "undeclared name 'dely', want a declared one; did you mean 'delay'?"),
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
    assert str(error).startswith(f"line {line}, column {column}: ")


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
