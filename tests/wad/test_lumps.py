"""WAD files: reading, writing, and what damaged bytes are answered with (tests/fuzz has many more of these)."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gvz.core.errors import WadError
from gvz.wad.lumps import ENTRY, HEADER, Lump, read_maps, read_wad, write_map_wad, write_wad

NAMES = st.from_regex(r"[A-Z0-9_\[\]\\]{1,8}", fullmatch=True)


def wad(*lumps: tuple[str, bytes]) -> bytes:
    return write_wad([Lump(name, data) for name, data in lumps])


@given(st.lists(st.builds(Lump, NAMES, st.binary(max_size=40)), max_size=8))
def test_what_was_written_is_read_back(lumps: list[Lump]):
    assert read_wad(write_wad(lumps)) == lumps
    assert write_wad(lumps) == write_wad(list(lumps))


def test_the_layout_is_header_lumps_directory():
    assert wad(("A", b"xyz"), ("MAP01", b"")) == (
        b"PWAD" + struct.pack("<ii", 2, 15) + b"xyz"
        + struct.pack("<ii8s", 12, 3, b"A") + struct.pack("<ii8s", 15, 0, b"MAP01")
    )  # fmt: skip


def test_names_are_read_up_to_their_first_zero_and_in_upper_case():
    data = b"IWAD" + HEADER.pack(b"", 1, 12)[4:] + ENTRY.pack(12, 0, b"map01\0?!")
    assert read_wad(data) == [Lump("MAP01", b"")]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"PWAD", "WAD: got 4 bytes, want at least a header of 12"),
        (b"ZWAD" + bytes(8), "WAD offset 0: got b'ZWAD', want b'IWAD' or b'PWAD'"),
        (HEADER.pack(b"PWAD", 1, 12), "WAD offset 4: got a directory of 1 lumps at 12, want one inside the 12 bytes"),
        (HEADER.pack(b"PWAD", -1, 12), "WAD offset 4: got a directory of -1 lumps at 12"),
        (HEADER.pack(b"PWAD", 0, 4), "WAD offset 4: got a directory of 0 lumps at 4"),
        (
            HEADER.pack(b"PWAD", 1, 12) + ENTRY.pack(12, 17, b"A"),
            "WAD offset 12: got lump 0 (A) of 17 bytes at 12, want it inside the 28 bytes",
        ),
        (HEADER.pack(b"PWAD", 1, 12) + ENTRY.pack(-8, 4, b"A"), "WAD offset 12: got lump 0 (A) of 4 bytes at -8"),
        (HEADER.pack(b"PWAD", 1, 12) + ENTRY.pack(12, -1, b"A"), "WAD offset 12: got lump 0 (A) of -1 bytes at 12"),
        (HEADER.pack(b"PWAD", 1, 12) + ENTRY.pack(12, 0, b""), "WAD offset 12: got the name b'\\x00\\x00"),
        (HEADER.pack(b"PWAD", 1, 12) + ENTRY.pack(12, 0, b"\xff"), "of lump 0, want 1 to 8 ASCII characters"),
        (HEADER.pack(b"PWAD", 1, 12) + ENTRY.pack(12, 0, b"\xdf"), "got the name b'\\xdf"),  # in upper case SS
        (
            HEADER.pack(b"PWAD", 4, 12) + ENTRY.pack(12, 60, b"A") * 4,
            "WAD: got 2 lumps of 120 bytes in a file of 76, want lumps that do not overlap",
        ),
    ],
)  # fmt: skip
def test_a_damaged_wad_is_refused_by_offset_and_lump(data: bytes, message: str):
    with pytest.raises(WadError) as caught:
        read_wad(data)
    assert message in str(caught.value)


@pytest.mark.parametrize("name", ["", "NINECHARS", "lower", "WITH SP", "\u00c4"])
def test_a_name_the_directory_cannot_hold_is_refused(name: str):
    with pytest.raises(WadError, match="want 1 to 8 upper-case ASCII characters"):
        write_wad([Lump(name, b"")])


def test_of_lumps_with_one_name_the_last_before_endmap_counts():
    lumps = read_wad(
        wad(
            ("DECORATE", b"d"), ("MAP01", b""), ("TEXTMAP", b"t"), ("BEHAVIOR", b"stale"), ("BEHAVIOR", b"fresh"),
            ("ENDMAP", b""), ("BEHAVIOR", b"outside"), ("MAP02", b""), ("TEXTMAP", b"u"), ("ENDMAP", b""),
        )
    )  # fmt: skip
    assert read_maps(lumps) == {"MAP01": {"TEXTMAP": b"t", "BEHAVIOR": b"fresh"}, "MAP02": {"TEXTMAP": b"u"}}


def test_a_map_without_end_is_refused():
    with pytest.raises(WadError, match="map MAP01: got the end of the WAD, want an ENDMAP lump"):
        read_maps(read_wad(wad(("MAP01", b""), ("TEXTMAP", b""))))


def test_a_map_that_stands_twice_is_refused():
    level = (("MAP01", b""), ("TEXTMAP", b""), ("ENDMAP", b""))
    with pytest.raises(WadError, match="map MAP01: got it twice, want it once"):
        read_maps(read_wad(wad(*level, *level)))


def test_lumps_that_overlap_are_refused_before_they_fill_the_memory():
    count, size = 60_000, 10**6  # 60 GB in a file of 2 MB
    entries = ENTRY.pack(HEADER.size, size, b"A") * count
    with pytest.raises(WadError, match="want lumps that do not overlap"):
        read_wad(HEADER.pack(b"PWAD", count, HEADER.size + size) + bytes(size) + entries)


def test_a_map_within_a_map_is_part_of_it():
    lumps = wad(("MAP01", b""), ("TEXTMAP", b"t"), ("MAP02", b""), ("TEXTMAP", b"u"), ("ENDMAP", b""))
    assert read_maps(read_wad(lumps)) == {"MAP01": {"TEXTMAP": b"u", "MAP02": b""}}
    many = [Lump(name, b"") for number in range(20_000) for name in (f"M{number}", "TEXTMAP")]
    assert len(read_maps([*many, Lump("ENDMAP", b"")])) == 1


def test_a_map_wad_has_its_lumps_in_the_fixed_order():
    data = write_map_wad(textmap="t", behavior=b"b", scripts="s\u00e9", decorate="d")
    assert read_wad(data) == [
        Lump("DECORATE", b"d"), Lump("MAP01", b""), Lump("TEXTMAP", b"t"),
        Lump("BEHAVIOR", b"b"), Lump("SCRIPTS", b"s\xe9"), Lump("ENDMAP", b""),
    ]  # fmt: skip
    assert data == write_map_wad(textmap="t", behavior=b"b", scripts="s\u00e9", decorate="d")


def test_a_map_wad_has_no_lumps_for_empty_texts():
    data = write_map_wad(textmap="t", behavior=b"b", scripts="s")
    assert [lump.name for lump in read_wad(data)] == ["MAP01", "TEXTMAP", "BEHAVIOR", "SCRIPTS", "ENDMAP"]


def test_a_character_beyond_latin_1_is_refused_by_line():
    with pytest.raises(WadError, match="SCRIPTS line 2: got the character '\u20ac', want Latin-1"):
        write_map_wad(textmap="", behavior=b"", scripts="a\n\u20ac")
