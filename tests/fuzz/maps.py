"""Fuzz targets: what a map comes as. WAD files, UDMF text, texture lumps, DECORATE, ACS source.

Imports gvz.wad; the examples are the installed engine's own.
"""

import contextlib
import re
import struct
from pathlib import Path

from gvz.core.errors import AcsError, WadError
from gvz.wad.acs import compile_acs
from gvz.wad.acs.lexer import tokenize
from gvz.wad.decorate import declared_actors
from gvz.wad.lumps import ENTRY, HEADER, Lump, read_maps, read_wad, write_wad
from gvz.wad.stock import engine_directory, scenario_wad
from gvz.wad.textures import check_textures, flats, wall_patches, wall_textures
from gvz.wad.udmf import UdmfMap, parse_textmap, write_textmap
from tests.fuzz.target import Target

SMALL_WADS = ("basic.wad", "health_gathering.wad", "defend_the_center.wad")


def _lumps(name: str) -> list[bytes]:
    """The lumps of one name in the small stock WADs."""
    wads = [read_wad(scenario_wad(wad)) for wad in SMALL_WADS]
    return [lump.data for lumps in wads for lump in lumps if lump.name == name]


def wad(_directory: Path) -> Target:
    """A WAD: header, directory, lumps; and the maps in it."""

    def run(data: bytes) -> bool:
        try:
            lumps = read_wad(data)
        except WadError:
            return False
        _, count, directory = HEADER.unpack_from(data)
        names = [ENTRY.unpack_from(data, directory + i * ENTRY.size)[2].split(b"\0")[0] for i in range(count)]
        assert [lump.name.encode() for lump in lumps] == [name.upper() for name in names]
        assert sum(len(lump.data) for lump in lumps) <= len(data)
        assert read_wad(write_wad(lumps)) == lumps
        assert flats(lumps).keys() <= {lump.name for lump in lumps}
        with contextlib.suppress(WadError):
            wall_textures(lumps)
        with contextlib.suppress(WadError):
            for name, level in read_maps(lumps).items():
                assert "TEXTMAP" in level, name
                assert "ENDMAP" not in level, name
        return True

    names = b"PWAD IWAD MAP01 TEXTMAP ENDMAP BEHAVIOR SCRIPTS F_START F_END TEXTURE1".split()
    level = [
        Lump(name, data) for name, data in (("MAP01", b""), ("TEXTMAP", b"t"), ("BEHAVIOR", b"b"), ("ENDMAP", b""))
    ]
    return Target(
        run=run,
        seeds=[write_wad([]), write_wad(level), write_wad(2 * level), *(scenario_wad(name) for name in SMALL_WADS)],
        words=[name.ljust(8, b"\0") for name in names],
    )


def udmf(_directory: Path) -> Target:
    """The text of a map."""

    def run(data: bytes) -> bool:
        try:
            level = parse_textmap(data.decode("latin-1"))
        except WadError as error:
            refusal = str(error)
        else:
            return _comes_back(level)
        assert refusal.startswith("TEXTMAP line ")
        return False

    words = "namespace vertex linedef sidedef sector thing v1 v2 sidefront sideback texturefloor x y type true // /* */"
    small = b"""namespace = "zdoom"; vertex { x = 0.0; y = -1.5e3; } vertex { x = 1.0; y = 0x10; }
        linedef { v1 = 0; v2 = 1; sidefront = 0; sideback = -1; } sidedef { sector = 0; }
        sector { texturefloor = "A\\"\\\\"; textureceiling = ""; }
        thing { x = 1.0; y = 2; type = 5; /* c */ ambush = true; } // end"""
    return Target(
        run=run, seeds=[small, *_lumps("TEXTMAP")], words=[*words.encode().split(), b'"', b"{", b"}", b"= ", b";"]
    )


def _comes_back(level: UdmfMap) -> bool:
    """Whether a map can be written; then it is the same when it is read."""
    try:
        text = write_textmap(level)
    except WadError:  # reading takes every character of Latin-1 in a string, writing only printable ones
        return False
    again = parse_textmap(text)
    assert again == level
    assert write_textmap(again) == text
    with contextlib.suppress(WadError):
        check_textures(level, frozenset(("CEIL5_2", "STONE2")))
    return True


def texture_lump(_directory: Path) -> Target:
    """A TEXTURE1 lump: offsets and names of wall textures."""

    def run(data: bytes) -> bool:
        try:
            names = wall_textures([Lump("TEXTURE2", data)])
        except WadError:
            return False
        with contextlib.suppress(WadError):
            wall_patches([Lump("TEXTURE2", data), Lump("PNAMES", bytes(4 + 8 * 1000))])
        assert all(re.fullmatch("[!-~]{1,8}", name) and name == name.upper() for name in names)
        assert 4 * len(names) < len(data)
        return True

    stock = read_wad((engine_directory() / "freedoom2.wad").read_bytes())
    whole = next(lump.data for lump in stock if lump.name == "TEXTURE1")
    first = [whole[offset : offset + 32] for offset in struct.unpack_from("<3i", whole, 4)]
    few = struct.pack("<4i", 3, 16, 48, 80) + b"".join(first)
    return Target(run=run, seeds=[few, struct.pack("<i", 0)], words=[struct.pack("<i", n) for n in (-1, 2**31 - 1, 16)])


def decorate(_directory: Path) -> Target:
    """DECORATE text, for the names of the classes it declares."""

    def run(data: bytes) -> bool:
        text = data.decode("latin-1")
        names = declared_actors(text)
        assert all(re.fullmatch("[A-Za-z0-9_~.]+", name) and name in text for name in names)
        assert declared_actors("\n".join(f"actor {name} : Health {{}}" for name in names)) == names
        return True

    words = (b"ACTOR ", b"actor\n", b"/*", b"*/", b"//", b'"', b'\\"', b"\\", b"\n", b" \n", b"{", b"}", b":")
    return Target(run=run, seeds=_lumps("DECORATE"), words=words, max_bytes=65536)


def acs(_directory: Path) -> Target:
    """ACS source."""

    sources = _lumps("SCRIPTS")
    words = {token.text.encode("latin-1") for s in sources for token in tokenize(s.decode("latin-1")) if token.text}
    words |= set(b"switch case default do until continue break return terminate #define static function".split())
    words |= {*b'0x7fffffff 2147483647 0.5 " /* */ // << (( a[ ]'.split(), b"{ {", b"- -"}
    return Target(run=lambda data: compiles(data.decode("latin-1")), seeds=sources, words=sorted(words))


def compiles(source: str) -> bool:
    """Whether ACS source compiles: to an object file that the engine can read, or to an error with its place."""
    try:
        behavior = compile_acs(source, actor_classes=["Poison", "MarineChainsawVzd"])
    except AcsError as error:
        refusal = error
    else:
        _check_object_file(behavior)
        return True
    lines = source.split("\n")
    assert 1 <= refusal.line <= len(lines)
    assert 1 <= refusal.column <= len(lines[refusal.line - 1]) + 1
    return False


def _check_object_file(data: bytes) -> None:
    """The layout that the engine relies on: chunks that fill their room, scripts and functions within the code."""
    magic, directory = struct.unpack_from("<4sI", data)
    chunks_at, marker = struct.unpack_from("<I4s", data, directory - 8)
    (count,) = struct.unpack_from("<I", data, directory)
    assert (magic, marker, len(data)) == (b"ACS\0", b"ACSe", directory + 4 + 12 * count + 4)
    at, chunks = chunks_at, {}
    while at < directory - 8:
        name, size = struct.unpack_from("<4sI", data, at)
        chunks[name] = data[at + 8 : at + 8 + size]
        at += 8 + size
    assert at == directory - 8
    scripts = list(struct.iter_unpack("<hBBI", chunks.get(b"SPTR", b"")))
    functions = list(struct.iter_unpack("<BBBBI", chunks.get(b"FUNC", b"")))
    assert all(8 <= address < chunks_at for *_, address in scripts + functions)
    assert all(1 <= number <= 32767 for number, *_ in scripts)
    assert len({number for number, *_ in scripts}) == len(scripts)
