"""Files of a directory and of all below it, also where these are links to directories elsewhere."""

import fnmatch
import heapq
import os
from pathlib import Path


def files_below(directory: Path, pattern: str) -> list[Path]:
    """Files in a directory, at any depth, whose names match the pattern; sorted.

    Links to directories are followed, as `runs` on another disk; paths are as they lead there, not resolved. Every
    directory is searched once: a link that leads back ends there, and a second name of a run does not take the place of
    the first (`_order`). A link to a directory that holds `directory` is left out.
    """
    found: list[Path] = []
    top = os.path.realpath(directory)
    seen = set(map(str, Path(top).parents))
    starts: list[tuple[tuple[int, ...], str]] = [((), str(directory))]
    while starts:
        order, start = heapq.heappop(starts)
        for folder, folders, files in os.walk(start):
            if (real := os.path.realpath(folder)) in seen:
                folders.clear()
                continue
            seen.add(real)
            found += [Path(folder, name) for name in fnmatch.filter(files, pattern)]
            for path in (Path(folder, name) for name in folders):
                if path.is_symlink():
                    heapq.heappush(starts, ((*order, *_order(path, real, top)), str(path)))
    return sorted(found)


def _order(link: Path, folder: str, top: str) -> tuple[bool, int]:
    """Which of several links to one directory is followed, the smallest: one that leads out of `top`, and not one that
    names something in there again; then the one with the larger directory, of which the others' are parts.
    """
    target = Path(os.path.normpath(Path(folder, link.readlink())))
    return top in map(os.path.realpath, target.parents), os.path.realpath(link).count(os.sep)
