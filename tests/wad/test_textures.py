"""Texture names of WADs and maps."""

import struct

import pytest

from gvz.core.errors import WadError
from gvz.wad.lumps import Lump, read_maps, read_wad
from gvz.wad.stock import scenario_wad, stock_patches, stock_textures
from gvz.wad.textures import check_textures, flats, used_textures, wall_patches, wall_textures
from gvz.wad.udmf import UdmfMap, parse_textmap


def texture_lump(name: str, *textures: bytes) -> Lump:
    first = 4 + 4 * len(textures)
    offsets = struct.pack(f"<{len(textures)}i", *(first + 16 * i for i in range(len(textures))))
    entries = b"".join(struct.pack("<8s4xhh", texture, 64, 128) for texture in textures)
    return Lump(name, struct.pack("<i", len(textures)) + offsets + entries)


def walls_and_floor(wall: str, floor: str) -> UdmfMap:
    return UdmfMap(
        sidedefs=[{"sector": 0, "texturetop": "-"}, {"sector": 0, "texturemiddle": wall}],
        sectors=[{"texturefloor": floor, "textureceiling": floor}],
    )


def test_wall_textures_are_listed_without_the_one_that_means_none():
    lumps = [texture_lump("TEXTURE1", b"NOTHING", b"Brick", b"EIGHTLET"), texture_lump("TEXTURE2", b"STONE")]
    assert wall_textures(lumps) == dict.fromkeys(("BRICK", "EIGHTLET", "STONE"), (64, 128))


def test_flats_are_the_lumps_between_their_markers():
    names = ("PATCH", "F_START", "F1_START", "FLOOR", "F1_END", "F_END", "SOUND", "FF_START", "LAVA", "FF_END")
    lumps = [Lump(name, b"" if name.endswith(("START", "END")) else bytes(64 * 64)) for name in names]
    assert flats(lumps) == {"FLOOR": (64, 64), "LAVA": (64, 64)}


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "TEXTURE1: got -1 textures in 0 bytes, want their offsets to fit"),
        (struct.pack("<i", 2) + bytes(4), "TEXTURE1: got 2 textures in 8 bytes"),
        (struct.pack("<i", -2) + bytes(4), "TEXTURE1: got -2 textures in 8 bytes"),
        (struct.pack("<ii", 1, 4), "TEXTURE1: got a texture at 4, want it inside the 8 bytes"),
        (struct.pack("<iii", 1, -4, 0), "TEXTURE1: got a texture at -4, want it inside the 12 bytes"),
        (
            struct.pack("<ii8s8x", 1, 8, b"A\xff"),
            r"TEXTURE1: got the name b'A\\xff.*' at 8, want 1 to 8 ASCII characters",
        ),
        (struct.pack("<ii8s8x", 1, 8, b""), "TEXTURE1: got the name b'.*' at 8, want 1 to 8 ASCII characters"),
    ],
)
def test_a_damaged_texture_lump_is_refused(data: bytes, message: str):
    with pytest.raises(WadError, match=message):
        wall_textures([Lump("TEXTURE1", data)])


def test_patches_of_wall_textures_are_listed_with_their_places():
    """A texture may have the name of a patch that is none of its own."""
    patches = stock_patches()
    assert patches["FIREBLU2"] == [("W65B_2", 0, 0)]
    assert patches["ICKWALL3"] == [("WALL72_7", 0, 0), ("WALL69_9", 0, 64), ("W67_2", 32, 64)]
    assert patches["STONE2"][1] == ("W28_5", 64, 64)


@pytest.mark.parametrize("patches", [b"", struct.pack("<h", 2) + bytes(10), struct.pack("<h3h4x", 1, 0, 0, 2)])
def test_patches_beyond_the_texture_lump_or_without_a_name_are_refused(patches: bytes):
    names = Lump("PNAMES", struct.pack("<i8s8s", 2, b"ONE", b"two"))
    entry = struct.pack("<ii8s4xhh4x", 1, 8, b"WALL", 64, 128)
    whole = Lump("TEXTURE1", entry + struct.pack("<h3h4x", 1, 5, -6, 1))
    assert wall_patches([whole, names]) == {"WALL": [("TWO", 5, -6)]}
    with pytest.raises(
        WadError, match=r"TEXTURE1: got WALL with a patch outside the .* bytes or the 2 names of PNAMES"
    ):
        wall_patches([Lump("TEXTURE1", entry + patches), names])


def test_freedoom_has_every_texture_of_the_benchmark_as_wall_or_flat():
    wanted = """A-MOSBRI A-CAMO3 AQCONC14 AQSECT09 ICKWALL3 FIREBLU2 FIREWALL SKY2 TANROCK2 BRICK12 GSTONE1 STONE2
        CRACKLE4 DORED CAVERN1 ROCKRED1 FLOOR4_6 CEIL5_1 FLOOR1_6 CEIL3_3 SLIME04 GRASS2 LAVA1 CEIL1_1 FWATER1 AQF052
        AQF051 FLAT19 FLAT14 CEIL4_3 CEIL4_1 RROCK02 NUKAGE1 CRATOP1 FLOOR0_5 FLAT5_7 SWATER1"""
    assert set(wanted.split()) <= stock_textures().keys()
    assert len(stock_textures()) > 1000


def test_textures_are_listed_with_the_first_place_of_their_use():
    assert used_textures(walls_and_floor("brick", "Lava")) == {
        "BRICK": "sidedef 1 texturemiddle",
        "LAVA": "sector 0 texturefloor",
    }


def test_an_unknown_texture_is_refused_with_its_place_and_the_nearest_name():
    check_textures(walls_and_floor("lava1", "BRICK12"), stock_textures())  # a flat on the wall and the reverse
    with pytest.raises(WadError) as caught:
        check_textures(walls_and_floor("BRICK12", "LAVAA1"), stock_textures())
    assert str(caught.value) == (
        "sector 0 texturefloor: got the unknown texture 'LAVAA1' (did you mean 'LAVA1'?), want a wall texture or flat"
    )


def test_the_base_maps_use_no_unknown_texture():
    for name in ("defend_the_center", "health_gathering", "health_gathering_supreme", "defend_the_line"):
        textmap = read_maps(read_wad(scenario_wad(f"{name}.wad")))["MAP01"]["TEXTMAP"]
        check_textures(parse_textmap(textmap.decode("latin-1")), stock_textures())
