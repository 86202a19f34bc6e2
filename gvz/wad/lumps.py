"""WAD files: a header, lumps of bytes, a directory of their names. Works on bytes, never on files.

This replaces omgifol. That library merges lumps with the same name, writes additions to a map after its ENDMAP (where
the engine does not look), opens files for writing, and accepts damaged bytes.
"""

import itertools
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass

from gvz.core.errors import WadError

HEADER = struct.Struct("<4sii")
ENTRY = struct.Struct("<ii8s")
MAP_NAME = "MAP01"
"""the map that is played of every scenario file"""
_NAME = re.compile(r"[!-~]{1,8}")


@dataclass(frozen=True, slots=True)
class Lump:
    """A named piece of a WAD; names are upper case and may repeat."""

    name: str
    data: bytes


def read_wad(data: bytes) -> list[Lump]:
    """Reads the lumps of a WAD in directory order.

    Raises:
        WadError: the bytes are not a complete WAD; the message names the lump, the offset and the error.
    """
    if len(data) < HEADER.size:
        raise WadError(f"WAD: got {len(data)} bytes, want at least a header of {HEADER.size}")
    magic, count, directory = HEADER.unpack_from(data)
    if magic not in (b"IWAD", b"PWAD"):
        raise WadError(f"WAD offset 0: got {magic!r}, want b'IWAD' or b'PWAD'")
    if count < 0 or not HEADER.size <= directory <= len(data) - count * ENTRY.size:
        raise WadError(
            f"WAD offset 4: got a directory of {count} lumps at {directory}, want one inside the {len(data)} bytes"
        )
    lumps: list[Lump] = []
    total = 0
    for number in range(count):
        lumps.append(_read_lump(data, number, directory + number * ENTRY.size))
        total += len(lumps[-1].data)
        # Without this check, lumps that share bytes could make a small file fill the memory.
        if total > len(data):
            raise WadError(
                f"WAD: got {number + 1} lumps of {total} bytes in a file of {len(data)}, want lumps that do not overlap"
            )
    return lumps


def _read_lump(data: bytes, number: int, entry: int) -> Lump:
    offset, size, raw_name = ENTRY.unpack_from(data, entry)
    name = raw_name.split(b"\0")[0].decode("latin-1")
    if not _NAME.fullmatch(name):
        raise WadError(f"WAD offset {entry}: got the name {raw_name!r} of lump {number}, want 1 to 8 ASCII characters")
    if size < 0 or (size and not HEADER.size <= offset <= len(data) - size):
        raise WadError(
            f"WAD offset {entry}: got lump {number} ({name}) of {size} bytes at {offset}, "
            f"want it inside the {len(data)} bytes"
        )
    return Lump(name.upper(), data[offset : offset + size])


def write_wad(lumps: Sequence[Lump]) -> bytes:
    """Writes a PWAD; the same lumps give the same bytes.

    Raises:
        WadError: a name that a directory cannot hold.
    """
    body, directory = bytearray(), bytearray()
    for lump in lumps:
        if not _NAME.fullmatch(lump.name) or lump.name != lump.name.upper():
            raise WadError(f"lump name: got {lump.name!r}, want 1 to 8 upper-case ASCII characters")
        directory += ENTRY.pack(HEADER.size + len(body), len(lump.data), lump.name.encode("ascii"))
        body += lump.data
    return HEADER.pack(b"PWAD", len(lumps), HEADER.size + len(body)) + bytes(body + directory)


def read_maps(lumps: Sequence[Lump]) -> dict[str, dict[str, bytes]]:
    """The UDMF maps of a WAD: map name -> lump name -> data.

    Editors can leave several lumps with the same name. The engine takes the last one before ENDMAP, and so does this.

    Raises:
        WadError: a map has no ENDMAP (the engine would refuse to start), or a name occurs twice.
    """
    maps: dict[str, dict[str, bytes]] = {}
    name: str | None = None  # of the map that the next lumps belong to
    for before, lump in itertools.pairwise(lumps):
        if name is None and lump.name == "TEXTMAP":
            name = before.name
            if name in maps:
                raise WadError(f"map {name}: got it twice, want it once")
            maps[name] = {}
        if lump.name == "ENDMAP":
            name = None
        if name is not None:
            maps[name][lump.name] = lump.data
    if name is not None:
        raise WadError(f"map {name}: got the end of the WAD, want an ENDMAP lump")
    return maps


def write_map_wad(*, textmap: str, behavior: bytes, scripts: str, decorate: str = "", textures: str = "") -> bytes:
    """Writes a WAD with one map, MAP_NAME; the same arguments give the same bytes.

    There are no nodes (ZNODES): the engine builds them in a few milliseconds, and outdated nodes would be wrong.

    Args:
        textmap: UDMF text of the map.
        behavior: compiled scripts.
        scripts: their source, for a reader who opens the map in an editor; the engine does not read it.
        decorate: actor definitions; no lump if empty.
        textures: definitions of textures; no lump if empty.

    Raises:
        WadError: a text has a character outside Latin-1.
    """
    lumps = [
        *(Lump(name, _encode(name, text)) for name, text in (("DECORATE", decorate), ("TEXTURES", textures)) if text),
        Lump(MAP_NAME, b""),
        Lump("TEXTMAP", _encode("TEXTMAP", textmap)),
        Lump("BEHAVIOR", behavior),
        Lump("SCRIPTS", _encode("SCRIPTS", scripts)),
        Lump("ENDMAP", b""),
    ]
    return write_wad(lumps)


def _encode(name: str, text: str) -> bytes:
    try:
        return text.encode("latin-1")
    except UnicodeEncodeError as error:
        line = text.count("\n", 0, error.start) + 1
        raise WadError(f"{name} line {line}: got the character {text[error.start]!r}, want Latin-1") from error
