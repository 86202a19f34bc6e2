"""Files that survive a power cut: their data and names are on the disk before other files refer to them; and where
checkpoints and policies are. Tier 0."""

import os
from pathlib import Path


def fsync(path: Path) -> None:
    """Waits until a file's data, or the names in a directory, are on the disk.

    Raises:
        OSError: the disk could not take them.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def fsync_tree(directory: Path) -> None:
    """`fsync` of everything in `directory`, each file before the directory that names it, and `directory` last.

    Raises:
        OSError: the disk could not take it.
    """
    for folder, _, files in os.walk(directory, topdown=False):
        for name in files:
            fsync(Path(folder, name))
        fsync(Path(folder))


def saved_steps(directory: Path) -> list[int]:
    """Gradient steps of the checkpoints or policies in `directory`, ascending, valid or not."""
    return sorted(int(p.name) for p in directory.glob("*") if p.is_dir() and p.name.isdecimal())
