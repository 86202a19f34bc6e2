"""The installed engine's base maps, actor classes, sprites and textures.

Read from the vizdoom package's data files; its compiled module is never imported.
"""

import importlib.util
import re
import zipfile
from functools import cache
from pathlib import Path

from gvz.core.errors import WadError
from gvz.wad.decorate import declared_actors
from gvz.wad.lumps import read_wad
from gvz.wad.textures import Patch, Size, flats, wall_patches, wall_textures

_MAPINFO = ("common", "doomcommon", "doomitems", "doom2")
"""MAPINFO texts for Doom II, the game that we play"""


@cache
def engine_directory() -> Path:
    """The directory of the installed vizdoom package.

    Raises:
        WadError: vizdoom is not installed.
    """
    spec = importlib.util.find_spec("vizdoom")
    if spec is None or not spec.submodule_search_locations:
        raise WadError("vizdoom: got no installed package, want one; run `pip install vizdoom`")
    return Path(spec.submodule_search_locations[0])


def scenario_wad(file_name: str) -> bytes:
    """The bytes of one of the engine's own scenarios, such as `defend_the_center.wad`.

    Raises:
        WadError: there is none with that name; the message lists all.
    """
    directory = engine_directory() / "scenarios"
    known = sorted(path.name for path in directory.glob("*.wad"))
    if file_name not in known:
        raise WadError(f"scenario WAD: got {file_name!r}, want one of {', '.join(known)}")
    return (directory / file_name).read_bytes()


@cache
def stock_actors() -> frozenset[str]:
    """Names of the engine's actor classes for Doom, from the DECORATE text in its vizdoom.pk3.

    Classes of Heretic, Hexen, Strife and Chex Quest are left out: the engine has no sprites for them.
    """
    with zipfile.ZipFile(engine_directory() / "vizdoom.pk3") as archive:
        texts = [
            archive.read(name).decode("latin-1")
            for name in sorted(archive.namelist())
            if name.startswith(("actors/doom/", "actors/shared/", "actors/actor.txt")) and name.endswith(".txt")
        ]
    return frozenset(name for text in texts for name in declared_actors(text))


@cache
def stock_editor_numbers() -> frozenset[int]:
    """Editor numbers of the things that a Doom map may hold, from the MAPINFO text in the engine's vizdoom.pk3."""
    with zipfile.ZipFile(engine_directory() / "vizdoom.pk3") as archive:
        text = "\n".join(archive.read(f"mapinfo/{name}.txt").decode("latin-1") for name in _MAPINFO)
    blocks = re.findall(r"DoomEdNums\s*\{([^}]*)\}", text, re.IGNORECASE)
    return frozenset(int(number) for block in blocks for number in re.findall(r"^\s*([0-9]+)\s*=", block, re.MULTILINE))


@cache
def stock_sprites() -> frozenset[str]:
    """Sprites with their frames, such as `BON1A`, of freedoom2.wad and of the engine's vizdoom.pk3."""
    names = [lump.name for lump in read_wad((engine_directory() / "freedoom2.wad").read_bytes())]
    found = names[names.index("S_START") + 1 : names.index("S_END")]
    with zipfile.ZipFile(engine_directory() / "vizdoom.pk3") as archive:
        found += [Path(name).stem.upper() for name in archive.namelist() if name.startswith("sprites/")]
    # A name is sprite, frame, rotation; a mirrored picture has a second frame and rotation in its name.
    return frozenset(name[:4] + name[place] for name in found for place in (4, 6) if place < len(name))


@cache
def stock_textures() -> dict[str, Size]:
    """Upper-case name -> size of all wall textures and flats of freedoom2.wad, which every game uses."""
    lumps = read_wad((engine_directory() / "freedoom2.wad").read_bytes())
    return wall_textures(lumps) | flats(lumps)


@cache
def stock_patches() -> dict[str, list[Patch]]:
    """Upper-case name -> patches of all wall textures of freedoom2.wad."""
    return wall_patches(read_wad((engine_directory() / "freedoom2.wad").read_bytes()))
