"""Runs jobs on the machine's cores and GPUs, shows their progress, and stops them so that they save their runs."""

import os
import shutil
import subprocess
import time
from collections import deque
from collections.abc import Sequence

from gvz.core import records
from gvz.core.errors import ConfigError
from gvz.core.stop import StopRequest
from gvz.core.watchdog import AwakeClock
from gvz.experiments import inventory
from gvz.experiments.jobs import Job, RunningJob, Slot
from gvz.run.bars import Bar, Bars

POLL_S = 0.5
PLAIN_PERIOD_S = 60.0
"""seconds between lines about the running jobs when the output is not a terminal"""
STOP_TIMEOUT_S = 300.0
"""a job that has not saved itself by then is killed; a checkpoint of a full replay takes a minute on a slow disk"""
LOCKED_TIMEOUT_S = 60.0
"""how long to wait for a job that another process runs, when nothing else is left to do"""


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
    """Shares of these cores and GPUs for so many jobs at once; None: one a GPU, or without one a pair of cores.

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
    """Runs all jobs that are not done. A job that fails does not stop the others.

    Returns: 0 when all are done, 1 when some failed, 130 or 143 when a signal stopped us; what was running is saved.
    """
    with StopRequest() as stop, Bars(PLAIN_PERIOD_S) as bars:
        schedule = Schedule(jobs, slots, bars)
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

    def __init__(self, jobs: Sequence[Job], slots: Sequence[Slot], bars: Bars):
        self._waiting = deque(jobs)
        self._free = deque(slots)
        self._running: list[RunningJob] = []
        self._failed: list[Job] = []
        self._bars, self._total, self._ended_jobs = bars, len(jobs), 0
        self._locked_since_s: float | None = None

    def step(self) -> bool:
        """Looks for commands that have ended, and starts others; False when nothing is left."""
        for running in list(self._running):
            if (code := running.poll()) is not None:
                self._running.remove(running)
                self._free.append(running.slot)
                self._ended(running, code)
        for _ in range(len(self._waiting)):
            if not self._free:
                break
            self._begin(self._waiting.popleft())
        if self._bars.due:
            self._show()
        if self._waiting and not self._running:  # other processes run all that is left
            now = time.monotonic()
            self._locked_since_s = now if self._locked_since_s is None else self._locked_since_s
            return now - self._locked_since_s < LOCKED_TIMEOUT_S
        self._locked_since_s = None
        return bool(self._running)

    def _begin(self, job: Job) -> None:
        if records.is_locked(inventory.log_file(job.results, job.id)):
            self._waiting.append(job)
            return
        outlook = job.outlook()
        if outlook.next is None:
            self._end(job, "done")
            return
        running = RunningJob.start(job, outlook.next, self._free[0])
        if running is None:  # another process took it just now
            self._waiting.append(job)
            return
        self._free.popleft()
        self._running.append(running)
        self._bars.say(f"{outlook.next.step}: {job.id} ({outlook.text})")

    def _ended(self, running: RunningJob, code: int) -> None:
        following = running.job.outlook().next
        if code == 0 and (following is None or following.step != running.command.step):
            self._waiting.appendleft(running.job)
            return
        why = f"exit code {code}" if code else f"it ended as if all were done, but {following} is left"
        log = inventory.log_file(running.job.results, running.job.id)
        self._failed.append(running.job)
        self._end(running.job, f"FAILED ({running.command.step}: {why}; log {log})")
        for line in inventory.last_words(log):
            self._bars.say(f"    {line}")

    def _end(self, job: Job, how: str) -> None:
        self._ended_jobs += 1
        self._bars.say(f"{how}: {job.id}")

    def _show(self) -> None:
        shown = [Bar(name="jobs", done=self._ended_jobs, total=self._total, unit="jobs")]
        for one in self._running:
            step, total = one.command.step, one.command.total
            done = one.job.done_count(step)
            shown.append(Bar(name=f"{step} {one.job.id}", done=done, total=total, unit=one.command.unit))
        self._bars.show(shown)

    def stop(self) -> None:
        """Asks the running jobs to save themselves and waits for that."""
        self._bars.say(f"stopping: {len(self._running)} jobs save themselves; once more to end at once")
        for running in self._running:
            running.stop()
        clock = AwakeClock(2 * POLL_S)
        while any(running.poll() is None for running in self._running):
            if clock.look() > STOP_TIMEOUT_S:
                self._bars.say(f"waited {STOP_TIMEOUT_S:.0f} s for jobs to save themselves; they are killed")
                return
            time.sleep(POLL_S)

    def kill(self) -> None:
        """Ends whatever still runs."""
        for running in self._running:
            running.kill()

    def summary(self) -> int:
        """Says what is not done; returns the exit code."""
        for job in self._waiting:
            self._bars.say(f"left alone: {job.id}, which another process runs")
        if self._failed:
            self._bars.say(f"{len(self._failed)} jobs failed; the same command tries them again:")
        for job in self._failed:
            self._bars.say(f"    {job.id}: {inventory.log_file(job.results, job.id)}")
        return 1 if self._failed or self._waiting else 0
