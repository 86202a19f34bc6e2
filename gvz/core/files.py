"""Files of a directory and of all below it, also where these are links to directories elsewhere; and files that are
written whole.
"""

import contextlib
import errno
import fnmatch
import heapq
import os
from collections.abc import Generator
from pathlib import Path
from typing import IO

from gvz.core import records
from gvz.core.errors import ConfigError

NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""errors of a full disk; those of a write do not name the file"""


@contextlib.contextmanager
def written_whole(path: Path) -> Generator[Path]:
    """A file to write to, which takes the place of `path` at the end of the block: nobody sees half of it, and one
    process at a time writes it. An error leaves what was there before, and that of a full disk names a file. What a
    killed process has left goes with the next one. Directories are made.

    Raises:
        ConfigError: it cannot be made, or another process writes it.
    """
    writing = path.with_name(f".writing-{path.name}")
    if path.is_dir():
        raise ConfigError(f"{path} is a directory; want the name of a file")
    try:
        with _opened(writing, path) as file:
            if not _is_ours(file, writing):
                raise ConfigError(f"{path} is being written by another process; wait for its end, or give another name")
            file.truncate(0)  # of what a killed process left
            yield writing
            writing.replace(path)
    except BaseException as error:  # perhaps a Ctrl-C that came while the file was made
        if isinstance(error, OSError) and error.errno in NO_ROOM and error.filename is None:
            with contextlib.suppress(AttributeError):  # PyAV's cannot be set
                error.filename = str(path)
        with contextlib.suppress(OSError), writing.open("rb+") as file:
            if _is_ours(file, writing):
                writing.unlink()
        raise


def _is_ours(file: IO[bytes], writing: Path) -> bool:
    return records.lock(file) and records.is_at(file, writing)


def _opened(writing: Path, path: Path) -> IO[bytes]:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        return writing.open("ab")
    except OSError as error:
        raise ConfigError(f"{path} cannot be written: {error.strerror}; give a place that you can write to") from error


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
