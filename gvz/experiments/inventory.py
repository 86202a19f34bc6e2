"""What stands on the disk of a results directory: checkpoints, episodes, logs. Reads only.

RESULTS/runs/<run id>/  players/<player>.jsonl  logs/<job id>.log  plan.json
"""

import fcntl
import gzip
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gvz.experiments.base import TrainingRun
from gvz.experiments.plan import Evaluation

LOG_TAIL_BYTES = 4_000
END_MARK = "# ended with exit code "
"""begins the line that closes a command's part of a log"""
STOPPED_CODES = (130, 143)
"""exit codes of a job that saved itself and stopped, as it was told to"""

State = Literal["done", "running", "failed", "stopped", "waiting"]


@dataclass(frozen=True, kw_only=True, slots=True)
class RunProgress:
    """How far a run is."""

    num_updates: int
    """gradient steps in its records"""
    checkpoints: tuple[int, ...]
    """gradient steps of the checkpoints that stand for those wanted; as many as are there"""
    trained: bool
    missing: dict[int, int]
    """checkpoint -> evaluation episodes that are still to be played"""

    @property
    def done(self) -> bool:
        return self.trained and not self.missing


def run_directory(results: Path, run: TrainingRun) -> Path:
    """Where the trainer keeps the run."""
    return results / "runs" / run.id


def player_file(results: Path, player: str) -> Path:
    """Where the episodes of random, idle and scripted are recorded."""
    return results / "players" / f"{player}.jsonl"


def log_file(results: Path, job: str) -> Path:
    """Where the output of a job goes."""
    return results / "logs" / f"{job}.log"


def run_progress(results: Path, run: TrainingRun, evaluation: Evaluation) -> RunProgress:
    """Reads how far a run is, from its policies and records alone."""
    directory = run_directory(results, run)
    checkpoints = standing_checkpoints(run, policies(directory))
    held = _held_episodes(directory / "evaluation.jsonl")
    wanted = {(task, n) for task in evaluation.tasks for n in range(evaluation.episodes)}
    missing = {c: len(wanted - held.get(c, set())) for c in checkpoints}
    return RunProgress(
        num_updates=last_update(directory),
        checkpoints=checkpoints,
        trained=run.total_updates in checkpoints,
        missing={c: n for c, n in missing.items() if n},
    )


def missing_player_episodes(file: Path, evaluation: Evaluation) -> int:
    """Episodes that a player's record file does not hold yet."""
    held = set().union(*_held_episodes(file).values())
    return sum((task, n) not in held for task in evaluation.tasks for n in range(evaluation.episodes))


def policies(directory: Path) -> list[int]:
    """Gradient steps of the policies a run has saved, rising."""
    folder = directory / "policies"
    return sorted(int(p.name) for p in folder.iterdir() if p.name.isdecimal()) if folder.is_dir() else []


def standing_checkpoints(run: TrainingRun, saved: Sequence[int]) -> tuple[int, ...]:
    """For each checkpoint wanted the first one saved at or after it, before the next is wanted.

    A save falls a little later than wanted if a jitted call has several gradient steps or the one before is still
    being written; and a run that was stopped has others besides.
    """
    wanted = run.checkpoints
    until = (*wanted[1:], run.total_updates + 1)
    first = (next((s for s in saved if low <= s < high), None) for low, high in zip(wanted, until, strict=True))
    return tuple(s for s in first if s is not None)


def last_update(directory: Path) -> int:
    """Gradient steps by the newest whole row of metrics.jsonl; 0 without one."""
    for line in reversed(tail(directory / "metrics.jsonl").splitlines()):
        try:
            return int(json.loads(line)["num_updates"])
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):  # half-written, or no row of ours
            continue
    return 0


def count_rows(file: Path) -> int:
    """Lines of a record file; 0 if there is none."""
    return sum(1 for _ in _lines(file))


def job_state(results: Path, job: str, *, done: bool, begun: bool) -> State:
    """What a job is at: by its lock, its results and the end of its log, in this order."""
    log = log_file(results, job)
    if is_locked(log):
        return "running"
    if done:
        return "done"
    code = exit_code(log)
    if code not in (None, 0, *STOPPED_CODES):
        return "failed"
    return "stopped" if begun or code is not None else "waiting"


def exit_code(log: Path) -> int | None:
    """Of the last command in a log; None if it has not ended, or was killed before it could be noted."""
    lines = tail(log).splitlines()
    if not lines or not lines[-1].startswith(END_MARK):
        return None
    return int(lines[-1].removeprefix(END_MARK).split()[0])


def tail(file: Path, num_bytes: int = LOG_TAIL_BYTES) -> str:
    """The end of a file; empty if there is none."""
    try:
        with file.open("rb") as stream:
            stream.seek(max(0, file.stat().st_size - num_bytes))
            return stream.read().decode(errors="replace")
    except FileNotFoundError:
        return ""


def last_words(log: Path, num_lines: int = 3) -> list[str]:
    """The last lines that a failed job wrote itself."""
    return [line for line in tail(log).splitlines() if line.strip() and not line.startswith("#")][-num_lines:]


def is_locked(log: Path) -> bool:
    """A job is at work: it and its runner hold its log."""
    if not log.exists():
        return False
    with log.open("a") as stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _lines(file: Path) -> Iterator[str]:
    """Of a record file, compressed or not; none if there is no file."""
    packed = file.with_name(f"{file.name}.gz")
    if file.exists():
        with file.open(errors="replace") as stream:
            yield from stream
    elif packed.exists():
        with gzip.open(packed, "rt", errors="replace") as stream:
            yield from stream


def _held_episodes(file: Path) -> dict[int, set[tuple[str, int]]]:
    """Checkpoint (0 for a player without one) -> the (task, episode) a record file holds; damaged lines count not."""
    held: dict[int, set[tuple[str, int]]] = {}
    for line in _lines(file):
        try:
            row = json.loads(line)
            if row.get("base_seed", 0) == 0:  # the episodes that everybody meets
                held.setdefault(row.get("num_updates", 0), set()).add((row["task"], row["episode"]))
        except (ValueError, KeyError, AttributeError, TypeError, RecursionError):  # half-written, or no row of ours
            continue
    return held
