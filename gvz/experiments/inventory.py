"""What a results directory holds: checkpoints, episodes, logs. Reads only.

RESULTS/runs/<run id>/  players/<player>.jsonl  logs/<job id>.log  plan.json
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypeVar

from gvz.core import records
from gvz.core.durable import saved_steps
from gvz.experiments.base import TrainingRun
from gvz.experiments.plan import Evaluation
from gvz.run.rundir import EVALUATION_RECORDS

END_MARK = "# ended with exit code "
"""begins the line that closes a command's part of a log"""
STOPPED_CODES = (129, 130, 143)
"""exit codes of a job that saved its run and stopped after a signal"""

PROCESSOR_S = "run/processor_s"
"""the scalar of the processor time, in metrics.jsonl"""

Number = TypeVar("Number", int, float)
State = Literal["done", "running", "failed", "stopped", "waiting"]


@dataclass(frozen=True, kw_only=True, slots=True)
class RunProgress:
    """How far a run is."""

    num_updates: int
    """gradient steps in its records"""
    processor_s: float
    """processor time in its records"""
    trained: bool
    missing: dict[int, int]
    """checkpoint -> evaluation episodes that are still to be played"""
    absent: int
    """planned checkpoints without a policy or an episode"""

    def lacking(self, evaluation: Evaluation) -> int:
        """Evaluation episodes that a trained run does not have, those of absent checkpoints among them."""
        return sum(self.missing.values()) + self.absent * len(evaluation.tasks) * evaluation.episodes


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
    held = _held_episodes(directory / EVALUATION_RECORDS)
    saved = sorted({*saved_steps(directory / "policies"), *held})  # policies of a finished run may have been removed
    num_updates, processor_s = last_update(directory), last_processor_s(directory)
    if run.max_processor_s is not None and num_updates:  # a later one is of what was discarded: its checkpoint failed
        saved = [checkpoint for checkpoint in saved if checkpoint <= num_updates]
    checkpoints = standing_checkpoints(run, saved)
    trained = run.total_updates in checkpoints
    if run.max_processor_s is not None:
        trained = trained or (processor_s >= run.max_processor_s and num_updates in saved)
    wanted = {(task, n) for task in evaluation.tasks for n in range(evaluation.episodes)}
    missing = {c: len(wanted - held.get(c, set())) for c in checkpoints}
    return RunProgress(
        num_updates=num_updates,
        processor_s=processor_s,
        trained=trained,
        missing={c: n for c, n in missing.items() if n},
        absent=run.num_checkpoints - len(checkpoints),
    )


def missing_player_episodes(file: Path, evaluation: Evaluation) -> int:
    """Episodes that a player's record file does not hold yet."""
    held = set().union(*_held_episodes(file).values())
    return sum((task, n) not in held for task in evaluation.tasks for n in range(evaluation.episodes))


def standing_checkpoints(run: TrainingRun, saved: Sequence[int]) -> tuple[int, ...]:
    """For each planned checkpoint the first one saved at or after it, and before the next planned one.

    A checkpoint is saved a little late if a jitted call has several gradient steps, or if the one before is still being
    written. A run that was stopped has more checkpoints than planned. Of a run that ends by its processor time only the
    newest stands.
    """
    if run.max_processor_s is not None:
        return tuple(saved[-1:])
    wanted = run.checkpoints
    until = (*wanted[1:], run.total_updates + 1)
    first = (next((s for s in saved if low <= s < high), None) for low, high in zip(wanted, until, strict=True))
    return tuple(s for s in first if s is not None)


def last_update(directory: Path) -> int:
    """Gradient steps by the newest whole row of metrics.jsonl; 0 without one."""
    return _last_number(directory, "num_updates", int)


def last_processor_s(directory: Path) -> float:
    """Processor time by the newest whole row of metrics.jsonl, seconds; 0 without one."""
    return _last_number(directory, PROCESSOR_S, float)


def _last_number(directory: Path, field: str, kind: type[Number]) -> Number:
    for row in records.newest_rows(directory / "metrics.jsonl"):
        try:
            return kind(row[field])
        except (ValueError, KeyError, TypeError, OverflowError):  # no row of ours
            continue
    return kind()


def count_rows(file: Path) -> int:
    """Lines of a record file, compressed or not; 0 if there is none."""
    stored = records.stored(file)
    return 0 if stored is None else sum(1 for _ in records.lines(stored))


def job_state(results: Path, job: str, *, done: bool, begun: bool) -> State:
    """The state of a job: by its lock, its results and the end of its log, in this order."""
    log = log_file(results, job)
    if records.is_locked(log):
        return "running"
    if done:
        return "done"
    code = exit_code(log)
    if code not in (None, 0, *STOPPED_CODES):
        return "failed"
    return "stopped" if begun or code is not None else "waiting"


def exit_code(log: Path) -> int | None:
    """Of the last command in a log; None if it has not ended, or was killed before it could be noted."""
    lines = records.last_lines(log)
    ended = re.fullmatch(rf"{END_MARK}(\d+) after \d+ s", lines[-1]) if lines else None
    return None if ended is None else int(ended[1])


def seconds_of(log: Path, step: str) -> float:
    """How long the commands of a step (train, evaluate) took, by a job's log; without those that were killed."""
    found, current = 0.0, ""
    for line in log.read_text(errors="replace").splitlines() if log.exists() else ():
        if command := re.fullmatch(r"# \S+ \S+ python -m gvz\.(launch|cli evaluate)\b.*", line):
            current = "train" if command[1] == "launch" else "evaluate"
        elif (ended := re.fullmatch(rf"{END_MARK}\d+ after (\d+) s", line)) and current == step:
            found += float(ended[1])
    return found


def last_words(log: Path) -> list[str]:
    """The last lines that a failed job wrote itself."""
    return [line for line in records.last_lines(log) if not line.startswith("#")][-3:]


def _held_episodes(file: Path) -> dict[int, set[tuple[str, int]]]:
    """Checkpoint (0 for a player without one) -> the (task, episode) a record file holds, damaged lines left out."""
    held: dict[int, set[tuple[str, int]]] = {}
    for row in records.read_stored(file)[0]:
        try:
            if row.get("base_seed", 0) == 0:  # the episodes that everybody meets
                held.setdefault(row.get("num_updates", 0), set()).add((row["task"], row["episode"]))
        except (KeyError, TypeError):  # no row of an evaluation
            continue
    return held
