"""UDMF text: reading, writing, and what damaged text is answered with."""

import importlib.util
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvz.core.errors import WadError
from gvz.wad.lumps import read_maps, read_wad
from gvz.wad.stock import engine_directory
from gvz.wad.udmf import Block, UdmfMap, is_inside, make_thing, parse_textmap, write_textmap

TRIANGLE = """
namespace = "zdoom"; // a comment
/* and { another } */
vertex { x = 0.0; y = 0; } vertex { X = 64.5; y = -1.0e1; } vertex { x = 0.0; y = 64.0; }
linedef { v1 = 0; v2 = 1; sidefront = 0; blocking = TRUE; sideback = -1; }
linedef { v1 = 1; v2 = 2; sidefront = 0; } linedef { v1 = 2; v2 = 0; sidefront = 0; }
sidedef { sector = 0; texturemiddle = "A \\"q\\" \\\\"; }
sector { texturefloor = "F"; textureceiling = "C"; special = 0x53; }
thing { x = 8.0; y = 8.0; type = 1; skill1 = true; coop = False; }
"""


def triangle() -> UdmfMap:
    return parse_textmap(TRIANGLE)


def all_maps() -> list[tuple[str, bytes]]:
    folders = [engine_directory() / "scenarios"]
    spec = importlib.util.find_spec("levdoom")
    assert spec is not None, "the development dependency levdoom==1.0.3 is missing"
    folders += [Path(location) for location in spec.submodule_search_locations]
    files = [file for folder in folders for file in sorted(folder.rglob("*.wad")) if file.stat().st_size]
    return [
        (f"{file.stem}/{name}", level["TEXTMAP"])
        for file in files
        for name, level in read_maps(read_wad(file.read_bytes())).items()
    ]


def test_a_place_is_inside_between_walls_and_not_in_a_pillar():
    room = UdmfMap(sectors=[{}])
    for (west, south), (east, north) in (((0, 0), (100, 60)), ((40, 20), (60, 40))):  # a room and a pillar in it
        first = len(room.vertices)
        room.vertices += [{"x": x, "y": y} for x, y in ((west, south), (west, north), (east, north), (east, south))]
        room.linedefs += [{"v1": first + i, "v2": first + (i + 1) % 4} for i in range(4)]
    room.vertices += [{"x": 20, "y": 0}, {"x": 20, "y": 60}]
    room.linedefs.append({"v1": 8, "v2": 9, "sideback": 0})  # drawn through open space: no wall
    inside = {(10, 30), (30, 30), (70, 30), (50, 10), (50, 50), (99.5, 0.5)}
    outside = {(50, 30), (-10, 30), (110, 30), (50, 70), (50, -1), (-10, 0), (-10, 60)}
    assert {place for place in inside | outside if is_inside(room, *place)} == inside


def test_a_map_is_read_into_its_blocks():
    assert triangle() == UdmfMap(
        namespace="zdoom",
        things=[{"x": 8.0, "y": 8.0, "type": 1, "skill1": True, "coop": False}],
        vertices=[{"x": 0.0, "y": 0}, {"x": 64.5, "y": -10.0}, {"x": 0.0, "y": 64.0}],
        linedefs=[
            {"v1": 0, "v2": 1, "sidefront": 0, "blocking": True, "sideback": -1},
            {"v1": 1, "v2": 2, "sidefront": 0},
            {"v1": 2, "v2": 0, "sidefront": 0},
        ],
        sidedefs=[{"sector": 0, "texturemiddle": 'A "q" \\'}],
        sectors=[{"texturefloor": "F", "textureceiling": "C", "special": 83}],
    )


def test_a_map_is_written_block_by_block():
    small = UdmfMap(sectors=[{"texturefloor": "F", "textureceiling": "C", "gravity": 1e-05, "silent": True, "id": -3}])
    assert write_textmap(small) == (
        'namespace = "zdoom";\n\nsector // 0\n{\ntexturefloor = "F";\ntextureceiling = "C";\n'
        "gravity = 1.0e-05;\nsilent = true;\nid = -3;\n}\n"
    )


def test_every_map_of_vizdoom_and_levdoom_survives_reading_and_writing():
    maps = all_maps()
    assert len(maps) >= 98
    for name, data in {data: (name, data) for name, data in maps}.values():
        first = parse_textmap(data.decode("latin-1"))
        text = write_textmap(first)
        second = parse_textmap(text)
        assert second == first, name
        assert write_textmap(second) == text, name


FIELDS = st.dictionaries(
    st.from_regex(r"user_[a-z0-9_]{1,5}", fullmatch=True),
    st.booleans()
    | st.integers(-(2**31), 2**31 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(st.characters(min_codepoint=160, max_codepoint=255) | st.sampled_from(" \"\\/*{};=azAZ09-")),
    max_size=4,
)  # fmt: skip


@given(st.lists(FIELDS, min_size=7, max_size=7))
def test_any_values_survive_writing_and_reading(extra: list[Block]):
    level = triangle()
    blocks = [block for blocks in level.blocks().values() for block in blocks]
    for block, fields in zip(blocks, extra, strict=False):
        block.update(fields)
    assert parse_textmap(write_textmap(level)) == level


def test_a_made_thing_is_there_for_everyone():
    assert make_thing(26, -352, 160, tid=5, angle=90) == {
        **dict.fromkeys(("skill1", "skill2", "skill3", "skill4", "skill5", "single", "coop", "dm"), True),
        "id": 5,
        "x": -352.0,
        "y": 160.0,
        "angle": 90,
        "type": 26,
    }
    assert "id" not in make_thing(26, 0, 0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('namespace = "zdoom";', "", "TEXTMAP line 1: got no namespace, want 'namespace = \"zdoom\";'"),
        ('namespace = "zdoom";', "namespace = 5;", "TEXTMAP line 2: got the assignment of 'namespace', want"),
        ('namespace = "zdoom";', 'namespace = "a"; namespace = "b";', "TEXTMAP line 2: got the assignment of"),
        ('namespace = "zdoom";', 'name = "zdoom";', "TEXTMAP line 2: got the assignment of 'name', want"),
        ("sidedef {", "sidedeaf {", "TEXTMAP line 7: got the block 'sidedeaf', want one of thing, vertex, linedef"),
        ("sidedef {", "7 {", "TEXTMAP line 7: got '7', want a block or 'namespace'"),
        ("sidedef {", "sidedef ;", "TEXTMAP line 7: got ';', want '{'"),
        ("v1 = 0;", "v1 0;", "TEXTMAP line 5: got '0', want '='"),
        ("v1 = 0;", "v1 = 0", "TEXTMAP line 5: got 'v2', want ';'"),
        ("v1 = 0;", "v1 = {;", "TEXTMAP line 5: got '{', want a number, a string, true or false"),
        ("v1 = 0;", "v1 = yes;", "TEXTMAP line 5: got 'yes', want a number, a string, true or false"),
        ("v1 = 0;", "v1 = 0; V1 = 0;", "TEXTMAP line 5: got the field 'V1' again, want it once in a block"),
        ("v1 = 0;", "5 = 0;", "TEXTMAP line 5: got '5', want a field or '}'"),
        ("v1 = 0;", "v1 = 2147483648;", "TEXTMAP line 5: got the number 2147483648, want a 32-bit one"),
        ("v1 = 0;", f"v1 = {'1' * 41};", "TEXTMAP line 5: got a number of 41 characters, want at most 40"),
        ("v1 = 0;", "v1 = 1.0e999;", "TEXTMAP line 5: got the number 1.0e999, want a finite one"),
        ("v1 = 0;", "v1 = 007;", "TEXTMAP line 5: got '007; v2 = ', want a name, number, string"),
        ("v1 = 0;", "@", "TEXTMAP line 5: got '@ v2 = 1; ', want a name, number, string, '{', '}', '=' or ';'"),
        ('"C";', '"C;', "TEXTMAP line 8: got '\"C; specia', want a name"),
        ("thing {", "thing { /* ", "TEXTMAP line 9: got '/*  x = 8.', want a name"),
        ("coop = False; }", "coop = False;", "TEXTMAP line 10: got the end of the text, want a field or '}'"),
        ("type = 1; skill1 = true; coop = False; }", "type =", "TEXTMAP line 10: got the end of the text, want a"),
        ("v1 = 0;", "v1 = 3;", "TEXTMAP line 5, linedef 0, v1: got 3, want the number of one of 3 vertex blocks"),
        ("v1 = 0;", "v1 = -1;", "TEXTMAP line 5, linedef 0, v1: got -1, want the number of one of 3 vertex blocks"),
        ("v1 = 0;", "v1 = true;", "TEXTMAP line 5, linedef 0, v1: got True, want"),
        ("v1 = 0;", "", "TEXTMAP line 5, linedef 0, v1: got nothing, want the number of one of 3 vertex blocks"),
        ("sideback = -1;", "sideback = 1;", "TEXTMAP line 5, linedef 0, sideback: got 1, want the number of one of 1"),
        ("sector = 0;", "sector = 1;", "TEXTMAP line 7, sidedef 0, sector: got 1, want the number of one of 1 sector"),
        ('texturefloor = "F";', "", "TEXTMAP line 8, sector 0, texturefloor: got None, want str"),
        ("type = 1;", "type = 1.0;", "TEXTMAP line 9, thing 0, type: got 1.0, want int"),
        ("X = 64.5;", "X = 32768.0;", "TEXTMAP line 4, vertex 1, x: got 32768.0, want a coordinate from -32767 to"),
        ("X = 64.5;", "X = true;", "TEXTMAP line 4, vertex 1, x: got True, want a coordinate"),
        ("X = 64.5;", "", "TEXTMAP line 4, vertex 1, x: got None, want a coordinate"),
    ],
)  # fmt: skip
def test_damaged_text_is_refused_by_line(old: str, new: str, message: str):
    assert TRIANGLE.count(old) == 1
    with pytest.raises(WadError) as caught:
        parse_textmap(TRIANGLE.replace(old, new))
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("block", "message"),
    [
        ({"id": 2**31}, "thing 0: id: got 2147483648, want a boolean, 32-bit integer, finite float or Latin-1 text"),
        ({"zoom": float("nan")}, "thing 0: zoom: got nan, want a boolean"),
        ({"text": "a\nb"}, "thing 0: text: got 'a\\nb', want a boolean"),
        ({"text": "\u20ac"}, "thing 0: text: got '\u20ac', want a boolean"),
        ({"Big": 1}, "thing 0: got the field 'Big', want a lower-case name"),
        ({"type": "imp"}, "thing 0, type: got 'imp', want int"),
        ({"x": float("nan")}, "thing 0, x: got nan, want a coordinate"),
    ],
)
def test_what_udmf_cannot_express_is_not_written(block: Block, message: str):
    level = triangle()
    level.things[0].update(block)
    with pytest.raises(WadError) as caught:
        write_textmap(level)
    assert message in str(caught.value)


def test_a_reference_that_an_edit_broke_is_not_written():
    level = triangle()
    level.sidedefs.clear()
    with pytest.raises(WadError, match="linedef 0, sidefront: got 0, want the number of one of 0 sidedef blocks"):
        write_textmap(level)
