"""The ACS compiler: instructions of small sources worked out by hand, in the chunks of the object file."""

import struct

import pytest

from gvz.wad.acs import compile_acs

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
