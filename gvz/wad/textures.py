"""Textures: those in a WAD, those that a map uses, and blends of two."""

import math
import re
import struct
from collections.abc import Collection, Mapping, Sequence

from gvz.core.errors import WadError, nearest
from gvz.wad.lumps import Lump
from gvz.wad.udmf import UdmfMap

WALL_FIELDS = ("texturetop", "texturemiddle", "texturebottom")
PLANE_FIELDS = ("texturefloor", "textureceiling")
NO_TEXTURE = "-"
Size = tuple[int, int]
"""(width, height) of a texture, pixels"""
_NAME = re.compile(r"[!-~]{1,8}")


def wall_textures(lumps: Sequence[Lump]) -> dict[str, Size]:
    """Name -> size of the textures in the TEXTURE1 and TEXTURE2 lumps.

    The first name of TEXTURE1 is left out: to the engine it means "no texture".

    Raises:
        WadError: a texture lump is damaged.
    """
    sizes: dict[str, Size] = {}
    for lump in lumps:
        if lump.name in ("TEXTURE1", "TEXTURE2"):
            sizes.update(_textures(lump)[lump.name == "TEXTURE1" :])
    return sizes


def _textures(lump: Lump) -> list[tuple[str, Size]]:
    data = lump.data
    count = struct.unpack_from("<i", data)[0] if len(data) >= 4 else -1
    if count < 0 or 4 + 4 * count > len(data):
        raise WadError(f"{lump.name}: got {count} textures in {len(data)} bytes, want their offsets to fit")
    found = []
    for offset in struct.unpack_from(f"<{count}i", data, 4):
        if not 0 <= offset <= len(data) - 16:
            raise WadError(f"{lump.name}: got a texture at {offset}, want it inside the {len(data)} bytes")
        raw_name = data[offset : offset + 8]
        name = raw_name.split(b"\0")[0].decode("latin-1")
        if not _NAME.fullmatch(name):
            raise WadError(f"{lump.name}: got the name {raw_name!r} at {offset}, want 1 to 8 ASCII characters")
        found.append((name.upper(), struct.unpack_from("<hh", data, offset + 12)))
    return found


def flats(lumps: Sequence[Lump]) -> dict[str, Size]:
    """Name -> size of the floor and ceiling textures: the lumps between F_START and F_END, which are square."""
    sizes: dict[str, Size] = {}
    inside = False
    for lump in lumps:
        if lump.name in ("F_START", "FF_START", "F_END", "FF_END"):
            inside = lump.name.endswith("START")
        elif inside and lump.data:  # an empty lump is a marker of a sub-section
            sizes[lump.name] = math.isqrt(len(lump.data)), math.isqrt(len(lump.data))
    return sizes


def used_textures(udmf_map: UdmfMap) -> dict[str, str]:
    """Every texture name of the map, upper case -> the first place it is used, such as `sidedef 3 texturemiddle`."""
    used: dict[str, str] = {}
    for kind, blocks, fields in (
        ("sidedef", udmf_map.sidedefs, WALL_FIELDS),
        ("sector", udmf_map.sectors, PLANE_FIELDS),
    ):
        for number, block in enumerate(blocks):
            for name in fields:
                texture = str(block.get(name, NO_TEXTURE)).upper()
                if texture != NO_TEXTURE:
                    used.setdefault(texture, f"{kind} {number} {name}")
    return used


def check_textures(udmf_map: UdmfMap, textures: Collection[str]) -> None:
    """Refuses a map with an unknown texture; the engine itself would show a checkerboard and go on.

    Walls may use flats, and floors and ceilings may use wall textures: the engine searches both.

    Args:
        udmf_map: the map.
        textures: upper-case names of all wall textures and flats.

    Raises:
        WadError: an unknown texture; the message names it, its place, and the nearest known name.
    """
    for texture, place in used_textures(udmf_map).items():
        if texture not in textures:
            hint = nearest(texture, textures)
            raise WadError(f"{place}: got the unknown texture {texture!r}{hint}, want a wall texture or flat")


def blended(name: str, under: str, over: str, opacity: float, sizes: Mapping[str, Size]) -> str:
    """The entry of a TEXTURES lump that makes a texture of two.

    It is as large as a whole number of each, so that both lie where they would lie alone.

    Args:
        name: of the new texture.
        under: a texture that is covered.
        over: the texture that covers it.
        opacity: of `over`, 0 to 1.
        sizes: of all textures.
    """
    width, height = (math.lcm(*pair) for pair in zip(sizes[under], sizes[over], strict=True))
    patches = [
        f'Patch "{texture}", {x}, {y} {style}'
        for texture, style in ((under, ""), (over, f"{{ Style Translucent Alpha {opacity:g} }}"))
        for x in range(0, width, sizes[texture][0])
        for y in range(0, height, sizes[texture][1])
    ]
    return "\n".join((f'Texture "{name}", {width}, {height}', "{", *patches, "}", ""))
