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
Patch = tuple[str, int, int]
"""a picture's name, and where its left and upper edges lie in a texture, pixels"""
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
            found = _textures(lump)[lump.name == "TEXTURE1" :]
            sizes.update((name, struct.unpack_from("<hh", lump.data, offset + 12)) for name, offset in found)
    return sizes


def wall_patches(lumps: Sequence[Lump]) -> dict[str, list[Patch]]:
    """Name -> patches of the textures in the TEXTURE1 and TEXTURE2 lumps, in the order in which they are drawn.

    Raises:
        WadError: a texture lump is damaged, or a patch has no name in the PNAMES lump.
    """
    listed = b"".join(lump.data[4:] for lump in lumps if lump.name == "PNAMES")
    names = {n: listed[8 * n : 8 * n + 8].split(b"\0")[0].decode("latin-1").upper() for n in range(len(listed) // 8)}
    patches: dict[str, list[Patch]] = {}
    for lump in lumps:
        if lump.name in ("TEXTURE1", "TEXTURE2"):
            for texture, offset in _textures(lump):
                try:
                    (count,) = struct.unpack_from("<h", lump.data, offset + 20)
                    found = [struct.unpack_from("<hhh", lump.data, offset + 22 + 10 * n) for n in range(count)]
                    patches[texture] = [(names[number], x, y) for x, y, number in found]
                except (struct.error, KeyError) as error:
                    raise WadError(
                        f"{lump.name}: got {texture} with a patch outside the {len(lump.data)} bytes or the "
                        f"{len(names)} names of PNAMES, want all inside"
                    ) from error
    return patches


def _textures(lump: Lump) -> list[tuple[str, int]]:
    """(Name, offset in the lump) of each texture."""
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
        found.append((name.upper(), offset))
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
        _check_texture(place, texture, textures)


def _check_texture(place: str, texture: str, textures: Collection[str]) -> None:
    if texture not in textures:
        hint = nearest(texture, textures)
        raise WadError(f"{place}: got the unknown texture {texture!r}{hint}, want a wall texture or flat")


def blended(
    name: str,
    under: str,
    over: str,
    opacity: float,
    sizes: Mapping[str, Size],
    patches: Mapping[str, Sequence[Patch]],
) -> str:
    """The entries of a TEXTURES lump that make a texture of two.

    It is as large as a whole number of each, so that both lie where they would lie alone. A wall texture comes first as
    an entry of its own, made of its patches: by the texture's name the engine finds a patch of this name, if there is
    one, and that may be another picture.

    Args:
        name: of the new texture. The entries of its wall textures have the letter U or O instead of its first one.
        under: a texture that is covered.
        over: the texture that covers it.
        opacity: of `over`, 0 to 1.
        sizes: of all textures.
        patches: of all wall textures.

    Raises:
        WadError: an unknown texture; an opacity outside 0..1; a name that the engine would cut off.
    """
    if not _NAME.fullmatch(name) or name != name.upper() or not 0 <= opacity <= 1:
        raise WadError(
            f"texture {name}: got a blend with opacity {opacity:g}, want a name of 1 to 8 upper-case ASCII characters, "
            "and an opacity from 0 to 1"
        )
    for texture in (under, over):
        _check_texture(f"texture {name}", texture, sizes)
    width, height = (math.lcm(*pair) for pair in zip(sizes[under], sizes[over], strict=True))
    text, parts = "", []
    for texture, letter, style in ((under, "U", ""), (over, "O", f"{{ Style Translucent Alpha {opacity:g} }}")):
        part = texture
        if texture in patches:
            part = f"{letter}{name[1:]}"
            text += _entry(part, sizes[texture], [f'Patch "{patch}", {x}, {y}' for patch, x, y in patches[texture]])
        parts += [
            f'Patch "{part}", {x}, {y} {style}'
            for x in range(0, width, sizes[texture][0])
            for y in range(0, height, sizes[texture][1])
        ]
    return text + _entry(name, (width, height), parts)


def _entry(name: str, size: Size, parts: Sequence[str]) -> str:
    """An entry of a TEXTURES lump."""
    return "\n".join((f'Texture "{name}", {size[0]}, {size[1]}', "{", *parts, "}", ""))
