"""Pictures of Freedoom's wall textures and flats, put together as the engine does it."""

import struct
import zipfile
from functools import cache

import cv2
import numpy as np

from gvz.wad.lumps import read_wad
from gvz.wad.stock import engine_directory


@cache
def _lumps() -> dict[str, bytes]:
    return {lump.name: lump.data for lump in read_wad((engine_directory() / "freedoom2.wad").read_bytes())}


def _text(data: bytes) -> str:
    return data.split(b"\0")[0].decode("latin-1").upper()


@cache
def _patch(name: str) -> np.ndarray:
    """i16[H, W]: number of the colour, -1 in holes."""
    data = _lumps()[name]
    width, height = struct.unpack_from("<HH", data)
    picture = np.full((height, width), -1, np.int16)
    for x, offset in enumerate(struct.unpack_from(f"<{width}I", data, 8)):
        while data[offset] != 255:
            top, count = data[offset], data[offset + 1]
            pixels = np.frombuffer(data, np.uint8, count, offset + 3)
            picture[top : top + count, x] = pixels[: max(0, height - top)]
            offset += count + 4
    return picture


@cache
def picture(name: str) -> np.ndarray:
    """i16[H, W]: number of the colour of each pixel of a texture or flat, -1 in holes."""
    data = _lumps()["TEXTURE1"]
    for offset in struct.unpack_from(f"<{struct.unpack_from('<i', data)[0]}i", data, 4):
        if _text(data[offset : offset + 8]) == name:
            break
    else:
        return np.frombuffer(_lumps()[name][:4096], np.uint8).reshape(64, 64).astype(np.int16)
    width, height = struct.unpack_from("<hh", data, offset + 12)
    whole = np.full((height, width), -1, np.int16)
    for number in range(struct.unpack_from("<h", data, offset + 20)[0]):
        left, top, patch = struct.unpack_from("<hhh", data, offset + 22 + 10 * number)
        part = _patch(_text(_lumps()["PNAMES"][4 + 8 * patch : 12 + 8 * patch]))
        part = part[max(0, -top) : height - top, max(0, -left) : width - left]
        top, left = max(0, top), max(0, left)
        place = whole[top : top + part.shape[0], left : left + part.shape[1]]
        np.copyto(place, part, where=part >= 0)
    return whole


def colours(name: str) -> np.ndarray:
    """f64[H, W, 3] of a texture or flat, 0 to 255."""
    palette = np.frombuffer(_lumps()["PLAYPAL"][:768], np.uint8).reshape(256, 3)
    return palette[picture(name)].astype(float)


@cache
def thumbnail(name: str) -> np.ndarray:
    """f64[16, 16, 3], 0 to 255: the same for a picture and its near copies."""
    return cv2.resize(colours(name), (16, 16), interpolation=cv2.INTER_AREA)


@cache
def moving() -> frozenset[str]:
    """Textures and flats that the engine animates: all between the first and the last of a series."""
    with zipfile.ZipFile(engine_directory() / "vizdoom.pk3") as archive:
        data = archive.read("animated.lmp")
    names, found = list(_lumps()), set[str]()
    texture1 = _lumps()["TEXTURE1"]
    offsets = struct.unpack_from(f"<{struct.unpack_from('<i', texture1)[0]}i", texture1, 4)
    names += [_text(texture1[offset : offset + 8]) for offset in offsets]
    for entry in range(0, len(data) - 22, 23):
        last, first = (_text(data[entry + start : entry + start + 9]) for start in (1, 10))
        if first in names and last in names:
            found.update(names[names.index(first) : names.index(last) + 1])
    return frozenset(found)
