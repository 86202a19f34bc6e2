"""A job: what is to be done for one run (train, then evaluate) or one player, and the process that does it now.

The next command follows from what stands on the disk, so a job that was cut goes on.
"""

import fcntl
import os
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Protocol

from gvz.core import janitor
from gvz.core.env_config import SimplePlayer
from gvz.experiments import inventory as progress
from gvz.experiments.base import TrainingRun
from gvz.experiments.plan import Evaluation
from gvz.experiments.scale import scaled_settings
from gvz.run.config import load_config


@dataclass(frozen=True, kw_only=True, slots=True)
class Command:
    """One step of a job, as arguments of Python."""

    step: str
    """train or evaluate"""
    arguments: tuple[str, ...]
    total: int
    """what it will have done at its end: gradient steps, or evaluation episodes of the job"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Outlook:
    """What is left of a job."""

    next: Command | None
    """None: it is done"""
    begun: bool
    """something of it stands on the disk"""
    text: str
    """how far it is, for a person"""


class Job(Protocol):
    """What is to be done, in commands that follow from what stands on the disk."""

    @property
    def id(self) -> str:
        """Unique in the results directory; names the log."""
        ...

    @property
    def results(self) -> Path:
        """The results directory."""
        ...

    def outlook(self) -> Outlook:
        """What is left, read from the disk."""
        ...

    def done_count(self, step: str) -> int:
        """Of `Command.total`, how much is done; of a job at work."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class RunJob:
    """Trains a run and evaluates its checkpoints."""

    results: Path
    run: TrainingRun
    evaluation: Evaluation
    scale: float

    @property
    def id(self) -> str:
        return self.run.id

    def outlook(self) -> Outlook:
        """Reads the run's directory."""
        now = progress.run_progress(self.results, self.run, self.evaluation)
        total = len(self.evaluation.tasks) * self.evaluation.episodes * self.run.num_checkpoints
        played = total - sum(now.missing.values()) if now.trained else 0
        text = f"{now.num_updates:,}/{self.run.total_updates:,} updates, {played:,}/{total:,} episodes"
        if not now.trained:
            following = Command(step="train", arguments=self.train_arguments(), total=self.run.total_updates)
        elif now.missing:
            following = Command(step="evaluate", arguments=self.evaluate_arguments(tuple(now.missing)), total=total)
        else:
            following = None
        return Outlook(next=following, begun=now.num_updates > 0, text=text)

    def done_count(self, step: str) -> int:
        """Gradient steps or episodes done, of a job at work."""
        directory = progress.run_directory(self.results, self.run)
        if step == "train":
            return progress.last_update(directory)
        return progress.count_rows(directory / "evaluation.jsonl")

    def train_arguments(self) -> tuple[str, ...]:
        """Trains the run, or goes on with it."""
        directory = progress.run_directory(self.results, self.run)
        return ("-m", "gvz.launch", *training_flags(self.run, self.scale), "--run-dir", str(directory))

    def evaluate_arguments(self, checkpoints: Sequence[int]) -> tuple[str, ...]:
        """Plays what is missing of the evaluation of these checkpoints."""
        directory = progress.run_directory(self.results, self.run)
        which = ("--checkpoints", *map(str, checkpoints))
        return ("-m", "gvz.cli", "evaluate", str(directory), *which, *_episodes(self.evaluation))


@dataclass(frozen=True, kw_only=True, slots=True)
class PlayerJob:
    """Plays the evaluation episodes as a player that needs no training."""

    results: Path
    player: SimplePlayer
    evaluation: Evaluation

    @property
    def id(self) -> str:
        return f"players/{self.player}"

    def outlook(self) -> Outlook:
        """Reads the player's record file."""
        missing = progress.missing_player_episodes(self._file, self.evaluation)
        total = len(self.evaluation.tasks) * self.evaluation.episodes
        arguments = ("-m", "gvz.cli", "evaluate", "--player", self.player, "--out", str(self._file))
        following = Command(step="evaluate", arguments=(*arguments, *_episodes(self.evaluation)), total=total)
        text = f"{total - missing:,}/{total:,} episodes"
        return Outlook(next=following if missing else None, begun=missing < total, text=text)

    def done_count(self, step: str) -> int:
        """Episodes played, of a job at work."""
        return progress.count_rows(self._file)

    @property
    def _file(self) -> Path:
        return progress.player_file(self.results, self.player)


def training_flags(run: TrainingRun, scale: float) -> tuple[str, ...]:
    """The flags of gvz.launch that make this run, but for where it is kept."""
    settings: dict[str, Any] = {
        "tasks": run.tasks,
        "seed": run.seed,
        "learner.total_updates": run.total_updates,
        "checkpoint.period_updates": run.checkpoint_period_updates,
        **scaled_settings(load_config(run.config), run.total_updates, scale),
    }
    return ("--config", run.config, *(text for name, value in settings.items() for text in _flag(name, value)))


def _flag(name: str, value: Any) -> tuple[str, ...]:
    flag = "--" + name.replace("_", "-")
    if isinstance(value, bool):
        group, _, field = flag.removeprefix("--").rpartition(".")
        return (flag if value else f"--{group}.no-{field}",)
    return (flag, *map(str, value)) if isinstance(value, tuple) else (flag, str(value))


def _episodes(evaluation: Evaluation) -> tuple[str, ...]:
    return ("--tasks", *evaluation.tasks, "--episodes", str(evaluation.episodes))


@dataclass(frozen=True, kw_only=True, slots=True)
class Slot:
    """A share of the machine, for one job at a time."""

    cores: tuple[int, ...]
    environment: dict[str, str]
    """what its jobs have besides ours: which GPU, how much of its memory"""


class RunningJob:
    """A command of a job at work in a slot.

    The job's log is locked meanwhile. The process holds the lock too, so one that outlives us for as long as it saves
    keeps others away.
    """

    def __init__(self, job: Job, command: Command, slot: Slot, log: IO[bytes]):
        self.job, self.command, self.slot = job, command, slot
        self._log = log
        self._started_s = time.monotonic()
        self._code: int | None = None
        self._note(f"# {time.strftime('%Y-%m-%d %H:%M:%S')} python {shlex.join(command.arguments)}")
        cores = ",".join(map(str, slot.cores))
        self._process = subprocess.Popen(
            [sys.executable, "-m", "gvz.experiments.child", str(os.getpid()), cores, *command.arguments],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env={**os.environ, **slot.environment, "PYTHONUNBUFFERED": "1"},
            start_new_session=True,  # the terminal's Ctrl-C is for us, who then stop it in order
        )

    @classmethod
    def start(cls, job: Job, command: Command, slot: Slot) -> "RunningJob | None":
        """Starts a command; None if another process is at the job."""
        file = progress.log_file(job.results, job.id)
        file.parent.mkdir(parents=True, exist_ok=True)
        log = file.open("ab", buffering=0)
        try:
            fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            log.close()
            return None
        return cls(job, command, slot, log)

    def poll(self) -> int | None:
        """Exit code of the command, as a shell says it; None while it runs."""
        code = self._process.poll()
        if code is not None and self._code is None:
            self._code = 128 - code if code < 0 else code
            self._note(f"{progress.END_MARK}{self._code} after {time.monotonic() - self._started_s:.0f} s")
            self._log.close()
        return self._code

    def stop(self) -> None:
        """Asks the command to save what it has and to end."""
        if self.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def kill(self) -> None:
        """Ends the command and all it started at once."""
        if self.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
            janitor.reap_killed(self._process, self.job.id)
            self.poll()

    def _note(self, line: str) -> None:
        self._log.write(f"{line}\n".encode())
