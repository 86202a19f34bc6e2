"""Runs jobs over the machine's cores and GPUs, shows how far they are, and stops them in order."""

import os
import shutil
import subprocess
import sys
import time
from collections import deque
from collections.abc import Sequence
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeElapsedColumn
from rich.table import Column

from gvz.core.errors import ConfigError
from gvz.core.stop import StopRequest
from gvz.experiments import inventory as progress
from gvz.experiments.jobs import Job, RunningJob, Slot

POLL_S = 0.5
PLAIN_PERIOD_S = 60.0
"""seconds between lines about the running jobs when the output is not a terminal"""
STOP_TIMEOUT_S = 300.0
"""a job that has not saved itself by then is killed; a checkpoint of a full replay takes a minute on a slow disk"""
LOCKED_TIMEOUT_S = 60.0
"""how long to wait for a job that another process is at, when nothing else is left to do"""


def gpus() -> tuple[str, ...]:
    """Ids for CUDA_VISIBLE_DEVICES of the GPUs that are there and not hidden."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        return tuple(id for id in visible.split(",") if id and id != "-1")
    if shutil.which("nvidia-smi") is None:
        return ()
    listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=60, check=False).stdout
    return tuple(str(n) for n, line in enumerate(listed.splitlines()) if line.startswith("GPU "))


def make_slots(jobs: int | None, cores: Sequence[int], devices: Sequence[str]) -> tuple[Slot, ...]:
    """Shares of the machine.

    Args:
        jobs: how many run at once; None: one a GPU, or without one a pair of cores.
        cores: to be shared out.
        devices: GPUs to be shared out.

    Raises:
        ConfigError: fewer than one job.
    """
    if jobs is None:
        jobs = min(len(devices), len(cores)) if devices else max(1, len(cores) // 2)
    if jobs < 1:
        raise ConfigError(f"--jobs: got {jobs}, want at least 1")
    slots = []
    for n in range(jobs):
        share = tuple(cores[n::jobs]) or (cores[n % len(cores)],)
        environment = {}
        if devices:
            environment["CUDA_VISIBLE_DEVICES"] = devices[n % len(devices)]
            together = -(-jobs // len(devices))
            if together > 1:
                environment["XLA_PYTHON_CLIENT_MEM_FRACTION"] = f"{0.9 / together:.3f}"
        slots.append(Slot(cores=share, environment=environment))
    return tuple(slots)


def run_jobs(jobs: Sequence[Job], slots: Sequence[Slot]) -> int:
    """Does all the jobs that are not done. One that fails leaves the others alone.

    Returns: 0 when all are done, 1 when some failed, 130 or 143 when a signal stopped us; what was running is saved.
    """
    with StopRequest() as stop, Display(len(jobs)) as display:
        schedule = Schedule(jobs, slots, display)
        try:
            while schedule.step() and not stop.requested:
                time.sleep(POLL_S)
            if stop.requested:
                schedule.stop()
                return stop.exit_code
            return schedule.summary()
        except KeyboardInterrupt:  # a second signal
            return stop.exit_code
        finally:
            schedule.kill()


class Schedule:
    """Jobs that wait, run and have failed. `kill` leaves nothing running."""

    def __init__(self, jobs: Sequence[Job], slots: Sequence[Slot], display: "Display"):
        self._waiting = deque(jobs)
        self._free = deque(slots)
        self._running: list[RunningJob] = []
        self._failed: list[Job] = []
        self._display = display
        self._locked_since_s: float | None = None

    def step(self) -> bool:
        """Takes note of commands that have ended and starts others; False when nothing is left."""
        for running in list(self._running):
            if (code := running.poll()) is not None:
                self._running.remove(running)
                self._free.append(running.slot)
                self._ended(running, code)
        for _ in range(len(self._waiting)):
            if not self._free:
                break
            self._begin(self._waiting.popleft())
        self._display.show(self._running)
        if self._waiting and not self._running:  # only such as other processes are at
            now = time.monotonic()
            self._locked_since_s = now if self._locked_since_s is None else self._locked_since_s
            return now - self._locked_since_s < LOCKED_TIMEOUT_S
        self._locked_since_s = None
        return bool(self._running)

    def _begin(self, job: Job) -> None:
        if progress.is_locked(progress.log_file(job.results, job.id)):
            self._waiting.append(job)
            return
        outlook = job.outlook()
        if outlook.next is None:
            self._display.ended(job, "done")
            return
        running = RunningJob.start(job, outlook.next, self._free[0])
        if running is None:  # another process took it just now
            self._waiting.append(job)
            return
        self._free.popleft()
        self._running.append(running)
        self._display.say(f"{outlook.next.step}: {job.id} ({outlook.text})")

    def _ended(self, running: RunningJob, code: int) -> None:
        following = running.job.outlook().next
        if code == 0 and (following is None or following.step != running.command.step):
            self._waiting.appendleft(running.job)
            return
        why = f"exit code {code}" if code else f"it ended as if all were done, but {following} is left"
        log = progress.log_file(running.job.results, running.job.id)
        self._failed.append(running.job)
        self._display.ended(running.job, f"FAILED ({running.command.step}: {why}; log {log})")
        for line in progress.last_words(log):
            self._display.say(f"    {line}")

    def stop(self) -> None:
        """Asks the running jobs to save themselves and waits for that."""
        self._display.say(f"stopping: {len(self._running)} jobs save themselves; once more to end at once")
        for running in self._running:
            running.stop()
        deadline = time.monotonic() + STOP_TIMEOUT_S
        while any(running.poll() is None for running in self._running):
            if time.monotonic() > deadline:
                self._display.say(f"waited {STOP_TIMEOUT_S:.0f} s for jobs to save themselves; they are killed")
                return
            time.sleep(POLL_S)

    def kill(self) -> None:
        """Ends whatever still runs."""
        for running in self._running:
            running.kill()

    def summary(self) -> int:
        """Says what is not done; returns the exit code."""
        for job in self._waiting:
            self._display.say(f"left alone: {job.id}, which another process is at")
        if self._failed:
            self._display.say(f"{len(self._failed)} jobs failed; the same command tries them again:")
        for job in self._failed:
            self._display.say(f"    {job.id}: {progress.log_file(job.results, job.id)}")
        return 1 if self._failed or self._waiting else 0


class Display:
    """Bars on a terminal, plain lines elsewhere; on stderr."""

    def __init__(self, total: int):
        self._console = Console(file=sys.stderr)
        name = TextColumn("{task.description}", table_column=Column(overflow="fold"))  # long, so it may take two lines
        columns = (BarColumn(20), MofNCompleteColumn(), TimeElapsedColumn(), name)
        # without a thread of its own: children die with the thread that starts them, and there is to be one alone
        self._bars = Progress(*columns, console=self._console, auto_refresh=False)
        self._all = self._bars.add_task("jobs", total=total)
        self._bar_of: dict[str, TaskID] = {}
        self._next_line_s = time.monotonic() + PLAIN_PERIOD_S

    def __enter__(self) -> "Display":
        if self._console.is_terminal:
            self._bars.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, tb: TracebackType | None) -> None:
        if self._console.is_terminal:
            self._bars.stop()

    def say(self, line: str) -> None:
        """Prints a line that stays."""
        self._console.print(line, markup=False, highlight=False, soft_wrap=True)

    def ended(self, job: Job, how: str) -> None:
        """A job is at its end, `how` says it."""
        self._bars.advance(self._all)
        self.say(f"{how}: {job.id}")

    def show(self, running: Sequence[RunningJob]) -> None:
        """Draws how far the running jobs are."""
        if not self._console.is_terminal and time.monotonic() < self._next_line_s:
            return
        self._next_line_s = time.monotonic() + PLAIN_PERIOD_S
        shown = {f"{one.command.step} {one.job.id}": one for one in running}
        for name in self._bar_of.keys() - shown.keys():
            self._bars.remove_task(self._bar_of.pop(name))
        for name, one in shown.items():
            done, total = one.job.done_count(one.command.step), one.command.total
            if not self._console.is_terminal:
                self.say(f"{name}: {done:,}/{total:,}")
                continue
            if name not in self._bar_of:
                self._bar_of[name] = self._bars.add_task(name, total=total)
            self._bars.update(self._bar_of[name], completed=done)
        if self._console.is_terminal:
            self._bars.refresh()
