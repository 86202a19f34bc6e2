"""What a person sees while a run goes on: a live panel on a terminal, plain lines elsewhere."""

import contextlib
import math
import os
import sys
import time
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from typing import Any, TextIO, cast

from rich.columns import Columns
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from gvz.tasks import parse_task

PLAIN_PERIOD_S = 10.0
"""seconds between lines when the output is not a terminal"""
LEAST_WIDTH = 60
"""columns of a terminal with room for bars and their names, or for all columns of the panel's table"""
MAX_TASK_ROWS = 24
"""with more tasks than that, the tasks of a level are shown together"""


@dataclass(frozen=True, kw_only=True, slots=True)
class TaskStatus:
    """Recent play of one task. `score` and `upper_bound` in the scenario's metric; NaN before the first episode."""

    task: str
    episodes: int
    score: float
    upper_bound: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Status:
    """A moment of a run."""

    phase: str
    num_updates: int
    total_updates: int
    row: Mapping[str, float]
    """scalars of the time since the last look, by name (docs/reference/metrics.md)"""
    staleness_updates: float
    """mean age of the acting parameters, gradient steps"""
    loss: float
    """NaN before the first log period"""
    tasks: tuple[TaskStatus, ...]

    @property
    def eta_s(self) -> float | None:
        """Seconds to the end at the present rate; None while nothing is being learned."""
        rate = self.row["learner/updates_per_s"]
        return (self.total_updates - self.num_updates) / rate if rate > 0 else None


def format_duration(seconds: float | None) -> str:
    """1:02:03, or --:-- when unknown."""
    if seconds is None:
        return "--:--"
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes:02d}:{rest:02d}"


def _rows(status: Status) -> tuple[TaskStatus, ...]:
    """The tasks; if there are many, the levels of each scenario, with the mean score in percent of the bound."""
    if len(status.tasks) <= MAX_TASK_ROWS:
        return status.tasks
    levels: dict[str, list[TaskStatus]] = {}
    for one in status.tasks:
        task = parse_task(one.task)
        levels.setdefault(f"{task.scenario.id}/level {task.level}", []).append(one)
    return tuple(_together(level, tasks) for level, tasks in levels.items())


def _together(level: str, tasks: list[TaskStatus]) -> TaskStatus:
    name = f"{level} ({len(tasks)} {'task' if len(tasks) == 1 else 'tasks'})"
    percents = [100 * task.score / task.upper_bound for task in tasks if task.episodes]
    mean = sum(percents) / len(percents) if percents else math.nan
    return TaskStatus(task=name, episodes=sum(task.episodes for task in tasks), score=mean, upper_bound=100.0)


def _short_score(task: TaskStatus) -> str:
    return f"{task.score:.0f}/{task.upper_bound:.0f}" if task.episodes else "-"


def _scenarios(status: Status) -> list[str]:
    return list(dict.fromkeys(task.task.partition("/")[0] for task in status.tasks))


def _short_name(task: TaskStatus, status: Status) -> str:
    """Without its scenario, unless there are several."""
    return task.task.partition("/")[2] if len(_scenarios(status)) == 1 else task.task


def _figures(status: Status) -> tuple[str, ...]:
    row = status.row
    return (
        f"{row['learner/updates_per_s']:.1f} updates/s",
        f"{row['actors/decisions_per_s']:,.0f} decisions/s",
        f"{row['actors/frames_per_s']:,.0f} frames/s",
        "loss -" if math.isnan(status.loss) else f"loss {status.loss:.4f}",
        f"replay {row['replay/fill_share']:.0%}",
        f"learner waits {row['learner/wait_share']:.0%}",
        f"actors wait {row['actors/wait_share']:.0%}",
        f"parameters {status.staleness_updates:.0f} updates old",
    )


def plain_line(status: Status) -> str:
    """One line with everything of a status."""
    scores = "  ".join(f"{_short_name(t, status)} {_short_score(t)}" for t in _rows(status))
    return (
        f"{status.phase}  update {status.num_updates:,}/{status.total_updates:,}  eta {format_duration(status.eta_s)}  "
        f"{'  '.join(_figures(status))}  {scores}"
    )


def panel(status: Status, width: int) -> Group:
    """The live panel; on a terminal of fewer than LEAST_WIDTH columns, tasks have their scores alone."""
    head = Text.assemble(
        (f"{status.phase}  ", "bold"),
        "".join(f"{scenario}  " for scenario in _scenarios(status)),
        f"{status.num_updates:,} / {status.total_updates:,} updates   ETA {format_duration(status.eta_s)}",
    )
    bar = Table.grid()  # puts the bar on a line of its own
    bar.add_row(ProgressBar(total=status.total_updates, completed=status.num_updates, width=min(width, 100)))
    rates = Columns(_figures(status), padding=(0, 3))
    tasks = Table(box=None, padding=(0, 1))
    tasks.add_column("task", overflow="fold")
    wide = width >= LEAST_WIDTH
    for name in ("episodes", "recent score", "% of bound") if wide else ("score",):
        tasks.add_column(name, justify="right", no_wrap=True)
    for t in _rows(status):
        percent = f"{100 * t.score / t.upper_bound:.1f}" if t.episodes else "-"
        numbers = (f"{t.episodes:,}", _short_score(t), percent) if wide else (_short_score(t),)
        tasks.add_row(_short_name(t, status), *numbers)
    num_restarts = int(status.row["actors/restarts"])
    restarts = [Text(f"{num_restarts} actor restarts", style="yellow")] if num_restarts else []
    return Group(head, bar, rates, *restarts, tasks)


class _Lossy:
    """A text stream that loses what it cannot write: progress that nobody can see is no reason to end a run."""

    def __init__(self, stream: TextIO):
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> None:
        with self._lossy():
            self._stream.write(text)

    def flush(self) -> None:
        with self._lossy():
            self._stream.flush()

    @contextlib.contextmanager
    def _lossy(self) -> Generator[None]:
        try:
            yield
        except OSError as error:
            with contextlib.suppress(OSError):
                self._drop(for_good=isinstance(error, BrokenPipeError))  # else a full disk, which may have room again

    def _drop(self, *, for_good: bool) -> None:
        """Writes what is left to nowhere. Python would try once more at the end of the process, and fail."""
        number = self._stream.fileno()
        kept, nowhere = os.dup(number), os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, number)
        self._stream.flush()
        if not for_good:
            os.dup2(kept, number)
        os.close(kept)
        os.close(nowhere)


def stderr_console() -> Console:
    """Standard error, for what a person sees of long work. What cannot be written is lost, without an error."""
    return Console(stderr=True) if sys.stderr is None else Console(file=cast(TextIO, _Lossy(sys.stderr)))


class Progress:
    """Shows statuses. Use as a context manager; messages go through `say` so that they do not tear the panel."""

    def __init__(self, console: Console | None = None):
        self._console = stderr_console() if console is None else console
        self._live: Live | None = None
        self._next_line_s = 0.0

    def __enter__(self) -> "Progress":
        if self._console.is_terminal:
            self._live = Live(console=self._console, auto_refresh=False, transient=False)
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live is not None:
            self._live.stop()
            self._live = None

    def say(self, message: str) -> None:
        """Prints a line that stays."""
        self._console.print(message, markup=False, highlight=False, soft_wrap=True)

    def show(self, status: Status) -> None:
        """Draws a status: at once on a terminal, at most every PLAIN_PERIOD_S seconds elsewhere."""
        if self._live is not None:
            self._live.update(panel(status, self._console.width), refresh=True)
            return
        now = time.monotonic()
        if now >= self._next_line_s:
            self.say(plain_line(status))
            self._next_line_s = now + PLAIN_PERIOD_S
