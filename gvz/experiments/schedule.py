"""Runs jobs where there is room, shows their progress, and stops them so that they save their runs."""

import time
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass

from gvz.core import records
from gvz.core.errors import exit_text
from gvz.core.stop import StopRequest
from gvz.core.watchdog import AwakeClock
from gvz.experiments import inventory
from gvz.experiments.jobs import Command, Job
from gvz.experiments.places import Places
from gvz.experiments.process import LOST, TAKEN, Process
from gvz.run.bars import Bar, Bars

POLL_S = 0.5
PLAIN_PERIOD_S = 60.0
"""seconds between lines about the running jobs when the output is not a terminal"""
STOP_TIMEOUT_S = 300.0
"""a job that has not saved itself by then is killed; a checkpoint of a full replay takes a minute on a slow disk"""
LOCKED_TIMEOUT_S = 60.0
"""how long to wait for a job that another process runs, when nothing else is left to do"""
LOST_TIMEOUT_S = 300.0
"""likewise when a machine was lost: a file server takes up to minutes to give back the locks of a dead machine"""
MAX_LOSSES = 3
"""a job that loses this number of machines, one after the other, without any progress, has failed"""


@dataclass(frozen=True, kw_only=True, slots=True)
class RunningJob:
    """A command of a job at work."""

    job: Job
    command: Command
    process: Process


def run_jobs(jobs: Sequence[Job], places: Places) -> int:
    """Runs all jobs that are not done. A job that fails does not stop the others.

    Returns: 0 when all are done, 1 when some failed, 130, 143 or 129 when a signal stopped us; what ran is saved.
    """
    with StopRequest() as stop, Bars(PLAIN_PERIOD_S) as bars:
        schedule = Schedule(jobs, places, bars)
        try:
            while schedule.step() and not stop.requested:
                time.sleep(POLL_S)
            if stop.requested:
                schedule.stop()
                return stop.exit_code
            return schedule.summary()
        except KeyboardInterrupt:  # a second signal
            return stop.exit_code
        except Exception:  # such as a cluster without its head: what runs saves itself first
            schedule.stop()
            raise
        finally:
            schedule.kill()


class Schedule:
    """Jobs that wait, run and have failed. `kill` leaves nothing running."""

    def __init__(self, jobs: Sequence[Job], places: Places, bars: Bars):
        self._waiting = deque(jobs)
        self._places = places
        self._running: list[RunningJob] = []
        self._failed: list[Job] = []
        self._losses: Counter[tuple[str, str]] = Counter()
        self._settling_since_s: dict[str, float] = {}
        self._bars, self._total, self._ended_jobs = bars, len(jobs), 0
        self._locked_since_s: float | None = None

    def step(self) -> bool:
        """Looks for commands that have ended, and starts others; False when nothing is left."""
        self._places.room()  # raises if there will be none any more, also when nothing waits
        for running in list(self._running):
            code = running.process.poll()
            if code is not None and not (code == 0 and self._settles(running)):
                self._running.remove(running)
                self._places.end(running.process)
                self._ended(running, code)
        for _ in range(len(self._waiting)):
            if not self._places.room() or not self._begin(self._waiting.popleft()):
                break
        if self._bars.due:
            self._show()
        if self._waiting and not self._running and self._places.room():  # other processes run all that is left
            now = time.monotonic()
            self._locked_since_s = now if self._locked_since_s is None else self._locked_since_s
            return now - self._locked_since_s < (LOST_TIMEOUT_S if self._losses else LOCKED_TIMEOUT_S)
        self._locked_since_s = None
        return bool(self._running or self._waiting)

    def _begin(self, job: Job) -> bool:
        """Starts the job's next command if the job is not done, nor run by another process; False for want of room."""
        log = inventory.log_file(job.results, job.id)
        if records.is_locked(log):
            self._waiting.append(job)
            return True
        outlook = job.outlook()
        if outlook.next is None:
            self._end(job, "done")
            return True
        if not self._places.room(outlook.next.step):
            self._waiting.appendleft(job)
            return False
        process = self._places.start(log, outlook.next)
        if process is None:  # another process took it just now
            self._waiting.append(job)
            return True
        self._running.append(RunningJob(job=job, command=outlook.next, process=process))
        self._bars.say(f"{outlook.next.step}: {job.id} ({outlook.text})")
        return True

    def _settles(self, running: RunningJob) -> bool:
        """Whether what a command has written may not be visible here yet."""
        following = running.job.outlook().next
        if following is None or following.step != running.command.step:
            return False
        since_s = self._settling_since_s.setdefault(running.job.id, time.monotonic())
        return time.monotonic() - since_s < self._places.settle_s

    def _ended(self, running: RunningJob, code: int) -> None:
        job = running.job
        self._settling_since_s.pop(job.id, None)
        if code == TAKEN:
            self._waiting.append(job)
            return
        outlook = job.outlook()
        if code == LOST:
            self._losses[job.id, outlook.text] += 1
            if self._losses[job.id, outlook.text] < MAX_LOSSES:
                self._bars.say(f"lost with its machine {running.process.where}, goes on elsewhere: {job.id}")
                self._waiting.appendleft(job)
                return
            why = f"lost {MAX_LOSSES} machines without progress, the last was {running.process.where}"
        elif code == 0 and (outlook.next is None or outlook.next.step != running.command.step):
            self._waiting.appendleft(job)
            return
        else:
            ended = exit_text(code) if code else f"it ended as if all were done, but it has {outlook.text}"
            why = running.process.problem or ended
        log = inventory.log_file(job.results, job.id)
        self._failed.append(job)
        self._end(job, f"FAILED ({running.command.step}: {why}; log {log})")
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
            name = f"{step} {one.job.id}"
            where = f"{name} on {one.process.where}" if one.process.where else name
            shown.append(Bar(name=name, done=done, total=total, unit=one.command.unit, text=where))
        self._bars.show(shown)

    def stop(self) -> None:
        """Asks the running jobs to save themselves and waits for that."""
        for running in self._running:
            running.process.stop()
        self._bars.say(f"stopping: {len(self._running)} jobs save themselves; once more to end at once")
        clock = AwakeClock(2 * POLL_S)
        while any(running.process.poll() is None for running in self._running):
            if clock.look() > STOP_TIMEOUT_S:
                self._bars.say(f"waited {STOP_TIMEOUT_S:.0f} s for jobs to save themselves; they are killed")
                return
            time.sleep(POLL_S)

    def kill(self) -> None:
        """Ends whatever still runs."""
        for running in self._running:
            running.process.kill()

    def summary(self) -> int:
        """Says what is not done; returns the exit code."""
        for job in self._waiting:
            self._bars.say(f"left alone: {job.id}, which another process runs")
        if self._failed:
            self._bars.say(f"{len(self._failed)} jobs failed; the same command tries them again:")
        for job in self._failed:
            self._bars.say(f"    {job.id}: {inventory.log_file(job.results, job.id)}")
        return 1 if self._failed or self._waiting else 0
