"""The run directory: its paths, its lock, its records. Reports read records, never checkpoints.

    config.json  checkpoints/  metrics.jsonl  episodes.jsonl  faults.jsonl  starts.jsonl  tensorboard/
    segmenters/ (the networks of its segmented frames)  work/ (logs of the actors)

The directory is private to its user. The lengths of its record files stand in every checkpoint: a resumed run moves to
`discarded/` what a killed one wrote after its last checkpoint, and the evaluation of policies that it never had.
"""

import contextlib
import errno
import json
import os
import shutil
import time
from collections.abc import Generator
from pathlib import Path
from typing import Any

from gvz.core import records
from gvz.core.durable import fsync, saved_steps
from gvz.core.errors import ConfigError, GvzError, ResumeError
from gvz.core.registry import NO_OWN_FILES, OwnFiles
from gvz.run.config import RunConfig
from gvz.run.config_files import config_from_dict, config_to_dict
from gvz.run.resume import changed_schedules, differences

RECORD_FILES = ("metrics.jsonl", "episodes.jsonl", "faults.jsonl")
START_RECORDS = "starts.jsonl"
"""A row for every start of the run: machine, versions, commit. Never cut back."""
EVALUATION_RECORDS = "evaluation.jsonl"
"""Where `gvz evaluate` writes, whose lock is its own."""
_BEFORE_A_RUN = ("checkpoints", "policies", "process_", "lost+found", ".")
"""Beginnings of names that may be there before a run: links to another disk, learners of its group, what a new disk
holds, hidden files.
"""
_LOGS = (".log", ".out", ".err", ".txt")
"""Ends of such names: files that a shell or Slurm has opened for the output of the run."""


class RunDir:
    """An open run directory. One process at a time holds it."""

    def __init__(self, path: Path, *, in_another: bool = False):
        """Creates the directory if need be and locks it.

        Args:
            path: of the directory.
            in_another: it lies in a further run directory, which may not be there yet: that of process 0 of a group.

        Raises:
            ResumeError: another live process holds it, or it cannot be created.
        """
        self.path = path
        with disk_checked(path):
            for made in (path.parent, path) if in_another else (path,):  # a mode does not hold for parents
                made.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._lock = os.fdopen(os.open(path / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600), "a+")
            locked = records.lock(self._lock) and records.is_at(self._lock, path / "lock")  # not moved by --fresh
        if not locked:
            self._lock.close()
            raise ResumeError(f"run directory {path}: another running process uses it; wait or use --run-dir")
        self.checkpoints = path / "checkpoints"
        self.tensorboard = path / "tensorboard"
        self.work = path / "work"
        self._writers: dict[str, records.Writer] = {}
        # what orbax, TensorBoard, actors and engines make while it is open is this user's alone, too
        self._umask = os.umask(0o077)

    def saved_config(self, own_files: OwnFiles = NO_OWN_FILES) -> RunConfig | None:
        """The configuration of the run that lives here, or None in an empty directory. `own_files`: as for
        `config_from_dict`.

        Raises:
            ResumeError: config.json is damaged, or of another schema.
        """
        file = self.path / "config.json"
        if not file.exists():
            return None
        try:
            return config_from_dict(json.loads(file.read_text()), own_files)
        except (ValueError, OSError, RecursionError) as error:
            raise ResumeError(f"{file} cannot be read: {error}; start again with --fresh or --run-dir") from error

    def check_resumable(self, config: RunConfig) -> list[str]:
        """Refuses a configuration that would change the meaning of the run that lives here.

        Returns: what the user should know of changes that are allowed, a line each.

        Raises:
            ResumeError: names every differing field.
        """
        saved = self.saved_config(config.own_files)
        if saved is None:
            return []
        if changed := differences(saved, config):
            raise ResumeError(
                f"run directory {self.path} holds a run with another configuration:\n  "
                + "\n  ".join(changed)
                + "\nGive the same configuration to go on, --fresh to move that run aside, or another --run-dir."
            )
        return changed_schedules(saved, config)

    def write_config(self, config: RunConfig) -> None:
        """Writes config.json atomically: after a power cut too it is the old one or the new one.

        Raises:
            ResumeError: the disk does not take it.
        """
        temporary = self.path / "config.json.tmp"
        with disk_checked(self.path):
            temporary.write_text(json.dumps(config_to_dict(config), indent=2) + "\n")
            fsync(temporary)
            temporary.replace(self.path / "config.json")
            fsync(self.path)

    def append(self, name: str, row: dict[str, Any]) -> None:
        """Adds a row to a record file. On a full disk rows wait in memory, and are written with the next one.

        Raises:
            GvzError: too many rows wait. ResumeError: what an earlier start has written cannot be read.
        """
        if name not in self._writers:
            file = self.path / name
            if file.exists():
                with disk_checked(self.path):
                    records.cut_half_row(file)  # the disk was full, and the process was killed then
            self._writers[name] = records.Writer(file)
        self._writers[name].append(row)

    def record_lengths(self) -> dict[str, int]:
        """Bytes of each record file now, with the rows that wait: what a checkpoint vouches for."""
        files = {name: self.path / name for name in RECORD_FILES}
        sizes = {name: file.stat().st_size if file.exists() else 0 for name, file in files.items()}
        waiting = {name: writer.waiting_bytes for name, writer in self._writers.items()}
        return {name: size + waiting.get(name, 0) for name, size in sizes.items()}

    def truncate_records(self, lengths: dict[str, int]) -> int:
        """Cuts the records to the lengths a checkpoint vouches for, keeping the rest in `discarded/`.

        Returns: number of bytes moved.

        Raises:
            ResumeError: the disk does not take them; the records are as they were.
        """
        known = {name: length for name, length in lengths.items() if name in RECORD_FILES}
        with disk_checked(self.path):
            return sum(
                records.cut(self.path / name, length, self.path / "discarded" / name) for name, length in known.items()
            )

    def discard_after(self, num_updates: int) -> None:
        """Moves policies and checkpoints of more gradient steps to `discarded/`, and rows of their evaluation: the run
        that goes on from there never had them, and may come to others of the same numbers. A checkpoint that could not
        be read today might be read tomorrow, and is of another history then.

        A folder on another file system, as a link leads to, has a `discarded/` of its own.

        Raises:
            ResumeError: they cannot be moved, or an evaluation is under way.
        """
        with disk_checked(self.path):
            folders = (self.path / "policies", self.checkpoints)
            later = [folder / str(steps) for folder in folders for steps in saved_steps(folder) if steps > num_updates]
            with self._discarding_evaluations(num_updates, policies_too=bool(later)):
                for directory in later:
                    try:
                        _move_into(self.path / "discarded" / directory.parent.name, directory)
                    except OSError as error:
                        if error.errno != errno.EXDEV:
                            raise
                        _move_into(directory.parent / "discarded", directory)

    @contextlib.contextmanager
    def _discarding_evaluations(self, num_updates: int, *, policies_too: bool) -> Generator[None]:
        """Within it no evaluation begins; at its end the rows of later policies are moved."""

        def is_later(row: dict[str, Any]) -> bool:
            return isinstance(row.get("num_updates"), int) and row["num_updates"] > num_updates

        file = (self.path / EVALUATION_RECORDS).resolve()  # of a link, the file itself is replaced
        if not file.is_file() or not (policies_too or records.split(file, is_later)[1]):
            yield
            return
        with file.open("r+b") as locked:
            if not records.lock(locked):
                raise ResumeError(
                    f"{file} is being written by another process, and the run, which goes on from update "
                    f"{num_updates}, discards later policies and their evaluation; wait until that process has ended"
                )
            yield
            records.move_rows(file, is_later, self.path / "discarded" / EVALUATION_RECORDS)  # last: unlocks the file

    def close(self) -> None:
        """Closes the record files and releases the lock. Can be repeated.

        Raises:
            GvzError: rows waited for room on the disk, and there is none yet.
        """
        lost: list[GvzError] = []
        for writer in self._writers.values():
            try:
                writer.close()
            except GvzError as error:
                lost.append(error)
        self._writers.clear()
        if not self._lock.closed:
            os.umask(self._umask)
        self._lock.close()
        if lost:
            raise lost[0]

    def __enter__(self) -> "RunDir":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextlib.contextmanager
def disk_checked(path: Path) -> Generator[None]:
    """Within it, an error of the disk is one of the run directory `path`.

    Raises:
        ResumeError: says what the disk cannot do.
    """
    try:
        yield
    except OSError as error:
        raise ResumeError(
            f"run directory {path}: {error.strerror}; mend this, or choose another with --run-dir"
        ) from error


def _move_into(folder: Path, directory: Path) -> None:
    """Renames a directory into `folder`; one of its name that is there is removed."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder / directory.name, ignore_errors=True)
    directory.rename(folder / directory.name)


def refuse_other_contents(path: Path) -> None:
    """Refuses a directory for a new run that holds something else: a run's files would lie among them, the run replaces
    what has the names of its own, and `--fresh` moves the whole directory.

    Raises:
        ConfigError: names what is in it. ResumeError: it is no directory, or cannot be read.
    """
    with disk_checked(path):
        if not path.exists() or any((path / name).exists() for name in ("config.json", "lock")):
            return
        names = [entry.name for entry in path.iterdir() if not (entry.is_file() and entry.name.endswith(_LOGS))]
        others = sorted(name for name in names if not name.startswith(_BEFORE_A_RUN))
    if others:
        more = " and more" if others[1:] else ""
        raise ConfigError(
            f"--run-dir: {path} holds {others[0]}{more}, and no run (no config.json); want an empty or a new one, "
            f"for example {path / 'run'}"
        )


def no_run(path: Path, error: OSError) -> ConfigError:
    """The error about a directory whose config.json cannot be opened; it names the first run inside, if any."""
    inside = sorted(path.glob("*/config.json"))
    hint = f"; did you mean {inside[0].parent}?" if inside else ""
    return ConfigError(f"{path} is not a run directory (config.json: {error.strerror}){hint}")


def move_aside(path: Path) -> Path | None:
    """Moves an old run out of the way for `--fresh`: never overwrites, never deletes.

    Returns: where it went, or None if there was nothing.

    Raises:
        ConfigError: the directory holds something that is not a run of ours.
        ResumeError: a live process uses it, or it cannot be moved.
    """
    path = Path(os.path.abspath(path))  # noqa: PTH100  # "." has no name, and a link to a run is moved, not the run
    with disk_checked(path):
        if not path.exists() or not any(path.iterdir()):
            return None
    if not (path / "config.json").exists() and not (path / "lock").exists():
        raise ConfigError(f"--fresh: {path} is not a run directory (no config.json); choose another --run-dir")
    with RunDir(path):  # refuses a directory in use
        target = path.with_name(f"{path.name}.{time.strftime('%Y%m%d-%H%M%S')}")
        while target.exists():
            target = target.with_name(target.name + "+")
        with disk_checked(path):
            path.rename(target)
    return target
