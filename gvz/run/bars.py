"""How far commands are: bars on a terminal, a line now and then elsewhere and on a narrow one. On stderr."""

import time
from collections.abc import Sequence
from dataclasses import dataclass

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn
from rich.table import Column

from gvz.run.progress import LEAST_WIDTH, format_duration, stderr_console

DRAW_PERIOD_S = 0.1


@dataclass(frozen=True, kw_only=True, slots=True)
class Bar:
    """Something of which so much is done."""

    name: str
    """tells it from the others"""
    done: int
    total: int
    unit: str
    """of what is done"""
    text: str = ""
    """stands behind the bar; default: its name"""


class Bars:
    """Shows bars, with rate and time left. Starts no thread: processes that are to die with the thread that started
    them need one thread alone.
    """

    def __init__(self, line_period_s: float, console: Console | None = None):
        """`line_period_s`: seconds between lines where no bars are drawn; inf: none."""
        self._console = stderr_console() if console is None else console
        name = TextColumn("{task.description}", table_column=Column(overflow="fold"))  # long: it may take two lines
        columns = (BarColumn(20), MofNCompleteColumn(), TextColumn("{task.fields[rate]}"), name)
        self._progress = Progress(*columns, console=self._console, auto_refresh=False)
        self._tasks: dict[str, TaskID] = {}
        self._begun: dict[str, tuple[float, int]] = {}
        self._drawn = self._console.is_terminal and self._console.width >= LEAST_WIDTH
        self._period_s = DRAW_PERIOD_S if self._drawn else line_period_s
        self._next_s = 0.0

    def __enter__(self) -> "Bars":
        if self._drawn:
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._drawn:
            self._progress.stop()

    def say(self, line: str) -> None:
        """Prints a line that stays."""
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    @property
    def due(self) -> bool:
        """Bars that are not complete are shown now, not passed over because others have just been."""
        return time.monotonic() >= self._next_s

    def show(self, bars: Sequence[Bar]) -> None:
        """Shows these bars and no others, when that is `due` or all of them are complete."""
        now_s = time.monotonic()
        for bar in bars:
            self._begun.setdefault(bar.name, (now_s, bar.done))
        if not self.due and any(bar.done < bar.total for bar in bars):
            return
        self._next_s = now_s + self._period_s
        if not self._drawn:
            for bar in bars if self._period_s < float("inf") else ():
                self.say(f"{bar.done:,}/{bar.total:,}  {self._rate(bar, now_s)}  {bar.text or bar.name}")
            return
        for name in self._tasks.keys() - {bar.name for bar in bars}:
            self._progress.remove_task(self._tasks.pop(name))
        for bar in bars:
            if bar.name not in self._tasks:
                self._tasks[bar.name] = self._progress.add_task("", total=bar.total, rate="")
            rate, text = self._rate(bar, now_s), bar.text or bar.name
            self._progress.update(self._tasks[bar.name], completed=bar.done, description=text, rate=rate)
        self._progress.refresh()

    def _rate(self, bar: Bar, now_s: float) -> str:
        """Since the bar was first shown: what came before, as the start of workers, is left out."""
        begun_s, begun = self._begun[bar.name]
        if bar.done <= begun:
            return f"- {bar.unit}/s  eta {format_duration(None)}"
        per_s = (bar.done - begun) / (now_s - begun_s)
        return f"{per_s:.2f} {bar.unit}/s  eta {format_duration((bar.total - bar.done) / per_s)}"
