"""Evaluations on disk: episodes are played and appended to a record file, and those already there are not played
again. Imports gvz.evaluation.{play,players}, gvz.rundir, gvz.specs.
"""

import dataclasses
import fcntl
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from gvz.errors import ConfigError
from gvz.evaluation.play import Job, Row, play
from gvz.evaluation.players import PlayerSpec
from gvz.rundir import RECORDS_SCHEMA, read_records
from gvz.specs import EnvConfig
from gvz.tasks import Task


def row_identity(player: Mapping[str, Any], env: EnvConfig) -> dict[str, Any]:
    """What tells one evaluation's rows from another's in the same file: who played, and by which rules.

    Args:
        player: fields that name the player, `player` among them.
        env: what it plays in. Sizes are left out: nobody's score depends on what it does not look at.
    """
    rules = {name: getattr(env, name) for name in ("profile", "action_set", "frame_skip")}
    return {**player, **rules}


def missing_jobs(rows: Sequence[Row], identity: Mapping[str, Any], tasks: Sequence[Task], episodes: int) -> list[Job]:
    """Episodes 0 .. episodes - 1 of each task that `rows` do not hold under this identity."""
    held = {(row["task"], row["episode"]) for row in rows if identity.items() <= row.items()}
    return [(task.id, n) for task in tasks for n in range(episodes) if (task.id, n) not in held]


def read_rows(file: Path) -> list[Row]:
    """The rows of a record file; none if there is no file yet. A half-written last line is cut off.

    Raises:
        ConfigError: a line that is damaged or of another schema.
    """
    if not file.exists():
        return []
    whole = file.read_bytes().rpartition(b"\n")[0]
    with file.open("r+b") as stream:
        stream.truncate(len(whole) + 1 if whole else 0)
    rows, problems = read_records(file)
    if problems:
        raise ConfigError(f"{problems[0]}; move the file aside or give another with --out")
    return rows


class RecordFile:
    """A record file that this process alone appends to."""

    def __init__(self, path: Path):
        """Opens (or creates) the file and reads the rows it holds.

        Raises:
            ConfigError: it cannot be opened, another process uses it, or it holds something else.
        """
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = path.open("a")
            fcntl.flock(self._stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            self._stream.close()
            raise ConfigError(f"--out: {path} is being written by another process") from error
        except OSError as error:
            raise ConfigError(f"--out: {path} cannot be written: {error.strerror}") from error
        try:
            self.rows = read_rows(path)
        except ConfigError:
            self.close()
            raise

    def append(self, row: Row) -> None:
        """Writes a row and flushes it."""
        self._stream.write(json.dumps({"schema": RECORDS_SCHEMA, **row}) + "\n")
        self._stream.flush()
        self.rows.append(row)

    def close(self) -> None:
        """Closes the file and gives it free."""
        self._stream.close()


def play_and_record(
    file: RecordFile, jobs: Sequence[Job], identity: dict[str, Any], spec: PlayerSpec, env: EnvConfig, num_workers: int
) -> Iterator[Row]:
    """Plays episodes; each row is on disk before it is yielded.

    Raises:
        GvzError: an episode could not be played.
    """
    options = dataclasses.asdict(env)
    if spec.kind != "policy":
        options["recycle_episodes"] = 0  # a fresh engine makes fuzz look the same again: only a policy looks at it
    for row in play(jobs, spec, options, num_workers=num_workers):
        file.append({**identity, **row})
        yield file.rows[-1]
