"""The run directory: its paths, its lock, its records. Reports read records, never checkpoints.

    config.json  checkpoints/  metrics.jsonl  episodes.jsonl  faults.jsonl  starts.jsonl  tensorboard/
    work/ (logs of the actors)

The directory is private to its user. Records are JSON lines, flushed row by row; their lengths stand in every
checkpoint, so that a resumed run drops (into `discarded/`) what a killed one wrote after its last checkpoint.
"""

import fcntl
import gzip
import io
import json
import os
import shutil
import time
import zlib
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import Any

from gvz.core.durable import fsync
from gvz.core.errors import ConfigError, GvzError, ResumeError
from gvz.run.config import RunConfig, config_from_dict, config_to_dict, differences

RECORDS_SCHEMA = 1
"""Stands in every row as `schema`; raised by one when a row's meaning changes."""

MAX_LINE_LENGTH = 2**20
MAX_LINES = 2**22
"""far beyond any record of ours; a small compressed file could hold more than fits into memory"""
MAX_WAITING_BYTES = 64 * 2**20
"""rows kept in memory while the disk is full: hours of a run"""

RECORD_FILES = ("metrics.jsonl", "episodes.jsonl", "faults.jsonl")
START_RECORDS = "starts.jsonl"
"""A row for every start of the run: machine, versions, commit. Never cut back."""


class RunDir:
    """An open run directory. One process at a time holds it."""

    def __init__(self, path: Path):
        """Creates the directory if need be and locks it.

        Raises:
            ResumeError: another live process holds it, or it cannot be created.
        """
        self.path = path
        try:
            path.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._lock = os.fdopen(os.open(path / "lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600), "a+")
        except OSError as error:
            raise ResumeError(f"run directory {path}: {error.strerror}; choose another with --run-dir") from error
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._lock.close()
            raise ResumeError(
                f"run directory {path}: another running process uses it; wait or use --run-dir"
            ) from error
        self.checkpoints = path / "checkpoints"
        self.tensorboard = path / "tensorboard"
        self.work = path / "work"
        self._files: dict[str, io.FileIO] = {}
        self._waiting: dict[str, bytearray] = {}
        # what orbax, TensorBoard, actors and engines make while it is open is this user's alone, too
        self._umask = os.umask(0o077)

    def saved_config(self) -> RunConfig | None:
        """The configuration of the run that lives here, or None in an empty directory.

        Raises:
            ResumeError: config.json is damaged.
        """
        file = self.path / "config.json"
        if not file.exists():
            return None
        try:
            return config_from_dict(json.loads(file.read_text()))
        except (ValueError, OSError, RecursionError) as error:
            raise ResumeError(f"{file} cannot be read: {error}; start anew with --fresh or --run-dir") from error

    def check_resumable(self, config: RunConfig) -> None:
        """Refuses a configuration that would change the meaning of the run that lives here.

        Raises:
            ResumeError: names every differing field.
        """
        saved = self.saved_config()
        if saved is not None and (changed := differences(saved, config)):
            raise ResumeError(
                f"run directory {self.path} holds a run with another configuration:\n  "
                + "\n  ".join(changed)
                + "\nGive the same configuration to go on, --fresh to move that run aside, or another --run-dir."
            )

    def write_config(self, config: RunConfig) -> None:
        """Writes config.json atomically: after a power cut too it is the old one or the new one."""
        temporary = self.path / "config.json.tmp"
        temporary.write_text(json.dumps(config_to_dict(config), indent=2) + "\n")
        fsync(temporary)
        temporary.replace(self.path / "config.json")
        fsync(self.path)

    def append(self, name: str, row: dict[str, Any]) -> None:
        """Adds a row to a record file. On a full disk rows wait in memory, and are written with the next one.

        Raises:
            GvzError: too many rows wait.
        """
        waiting = self._waiting.setdefault(name, bytearray())
        waiting += json.dumps({"schema": RECORDS_SCHEMA, **row}).encode() + b"\n"
        try:
            self._write(name)
        except OSError as error:
            if len(waiting) > MAX_WAITING_BYTES:
                raise self._unwritten(name, error) from error

    def _write(self, name: str) -> None:
        """Writes what waits; what the disk took, if only a part of a row, does not wait any more."""
        if name not in self._files:
            self._files[name] = (self.path / name).open("ab", buffering=0)
        waiting = self._waiting[name]
        while waiting:
            del waiting[: self._files[name].write(waiting)]

    def _unwritten(self, name: str, error: OSError) -> GvzError:
        return GvzError(
            f"{self.path / name}: {len(self._waiting[name])} bytes of records cannot be written: {error.strerror}; "
            "make room and give the same command: the run goes on from its newest checkpoint"
        )

    def record_lengths(self) -> dict[str, int]:
        """Bytes of each record file now, with the rows that wait: what a checkpoint vouches for."""
        sizes = {n: (self.path / n).stat().st_size if (self.path / n).exists() else 0 for n in RECORD_FILES}
        return {n: size + len(self._waiting.get(n, b"")) for n, size in sizes.items()}

    def truncate_records(self, lengths: dict[str, int]) -> int:
        """Cuts the records to the lengths a checkpoint vouches for, keeping the rest in `discarded/`.

        Returns: number of bytes moved.
        """
        moved = 0
        for name, length in lengths.items():
            file = self.path / name
            if name not in RECORD_FILES or not file.exists() or file.stat().st_size <= length:
                continue
            with file.open("r+b") as stream:
                stream.seek(length)
                tail = stream.read()
                (self.path / "discarded").mkdir(exist_ok=True)
                with (self.path / "discarded" / name).open("ab") as keep:
                    keep.write(tail)
                stream.truncate(length)
            moved += len(tail)
        return moved

    def close(self) -> None:
        """Closes the record files and releases the lock. Idempotent.

        Raises:
            GvzError: rows waited for room on the disk, and there is none yet.
        """
        lost: list[GvzError] = []
        for name in self._waiting:
            try:
                self._write(name)
            except OSError as error:
                lost.append(self._unwritten(name, error))
        for file in self._files.values():
            file.close()
        self._files.clear()
        self._waiting.clear()
        shutil.rmtree(self.work / "engines", ignore_errors=True)
        if not self._lock.closed:
            os.umask(self._umask)
        self._lock.close()
        if lost:
            raise lost[0]

    def __enter__(self) -> "RunDir":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        self.close()


def move_aside(path: Path) -> Path | None:
    """Moves an old run out of the way for `--fresh`: never overwrites, never deletes.

    Returns: where it went, or None if there was nothing.

    Raises:
        ConfigError: the directory holds something that is not a run of ours.
        ResumeError: a live process uses it.
    """
    if not path.exists() or not any(path.iterdir()):
        return None
    if not (path / "config.json").exists() and not (path / "lock").exists():
        raise ConfigError(f"--fresh: {path} is not a run directory (no config.json); choose another --run-dir")
    with RunDir(path):  # refuses a directory in use
        target = path.with_name(f"{path.name}.{time.strftime('%Y%m%d-%H%M%S')}")
        while target.exists():
            target = target.with_name(target.name + "+")
        path.rename(target)
    return target


def read_records(file: Path) -> tuple[list[dict[str, Any]], list[str]]:
    """Reads a JSON-lines record file (`.gz`: compressed); everything readable is returned.

    Returns: rows, and one message for each line that is damaged or of another schema.

    Raises:
        GvzError: there is no such file.
    """
    if not file.exists():
        raise GvzError(f"{file}: no such record file; is {file.parent} a run directory?")
    rows: list[dict[str, Any]] = []
    problems: list[str] = []
    try:
        with gzip.open(file, "rt", errors="replace") if file.suffix == ".gz" else file.open(errors="replace") as stream:
            for number, line in enumerate(iter(partial(stream.readline, MAX_LINE_LENGTH), ""), 1):
                if len(line) == MAX_LINE_LENGTH or number > MAX_LINES:
                    problems.append(
                        f"{file}, line {number}: not read on; want lines shorter than {MAX_LINE_LENGTH} characters, "
                        f"and at most {MAX_LINES} of them"
                    )
                    break
                try:
                    row = json.loads(line)
                except (ValueError, RecursionError):
                    problems.append(f"{file}, line {number}: not JSON (half-written?)")
                    continue
                if not isinstance(row, dict) or row.get("schema") != RECORDS_SCHEMA:
                    got = row.get("schema") if isinstance(row, dict) else type(row).__name__
                    problems.append(f"{file}, line {number}: schema {got!r}, want {RECORDS_SCHEMA}")
                    continue
                rows.append(row)
    except (OSError, EOFError, zlib.error) as error:
        problems.append(f"{file}, after {len(rows)} rows: cannot be read on ({error})")
    return rows, problems
