"""The checkpoints of a run over its life: at their periods, again after a failure, and the last one."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from gvz.core.durable import saved_steps
from gvz.core.errors import CheckpointError
from gvz.run.config import CheckpointConfig
from gvz.run.group import Group
from gvz.run.monitor import Counts
from gvz.run.rundir import RunDir, disk_checked
from learner.checkpoint import Checkpointer

SAVE_RETRY_S, LONGEST_SAVE_RETRY_S = 60, 3600
"""a failed checkpoint is tried again after this time, doubled each time, or at the next period; whole numbers: a float
has no 1,024th double
"""
_LAST_ATTEMPTS = 2


class Snapshot(NamedTuple):
    """What a checkpoint holds."""

    arrays: Any
    params: Any
    """what evaluation reads"""
    host: dict[str, Any]


class Saver:
    """Writes checkpoints beside training; a failure is reported and tried again."""

    def __init__(
        self,
        run: RunDir,
        config: CheckpointConfig,
        counts: Counts,
        take: Callable[[], Snapshot],
        report: Callable[[str, float], None],
    ):
        """Removes what a killed run was still writing.

        Args:
            run, config: where checkpoints go, their periods, and how many are kept.
            counts: of the run; `saved_updates` is kept here.
            take: gives the state of the run now.
            report: is told why a save failed, and the seconds until it is tried again.

        Raises:
            ResumeError: the folders of checkpoints and policies cannot be made.
        """
        self._checkpoints, self._config, self._counts = run.checkpoints, config, counts
        with disk_checked(run.path):
            self._checkpointer = Checkpointer(run.path, keep=config.keep)
        self._take, self._report = take, report
        self._num_failed, self._retry_at_s, self._begun_at_s = 0, 0.0, time.monotonic()
        self.num_saved = counts.saved_updates
        """gradient steps of the newest whole checkpoint"""

    @property
    def busy(self) -> bool:
        """A checkpoint is being written."""
        return self._checkpointer.busy

    @property
    def behind(self) -> bool:
        """There are gradient steps that no whole checkpoint has."""
        return self.busy or self._counts.saved_updates != self._counts.updates or self._num_failed > 0

    def save_when_due(self, group: Group) -> None:
        """Begins a checkpoint at every multiple of `period_updates`, `period_s` after the last one, and again some time
        after one failed.

        With other processes only at the multiples, and only when all do.
        """
        if self.busy:
            return
        self._hear()
        counts, period = self._counts, self._config.period_updates
        due = counts.updates // period > counts.saved_updates // period
        if group.num_common_saved is None and self.behind:
            due_at_s = self._retry_at_s if self._num_failed else self._begun_at_s + self._config.period_s
            due = due or time.monotonic() > due_at_s
        if due and group.may_save():
            self._begin(group.num_common_saved)

    def save_last(self, group: Group, begun: Callable[[], None]) -> None:
        """Writes the last checkpoint and waits for it; if it fails it is tried once more. The one that all have stays.

        Args:
            begun: called when the checkpoint's content is fixed, before it is waited for.

        Raises:
            CheckpointError: it failed again. WaitTimeoutError: the disk does not answer.
            NonFiniteError: the learner's numbers went wrong since they were last read.
        """
        failure = self.wait()
        for _ in range(_LAST_ATTEMPTS):
            if not self.behind:
                break
            self._begin(group.num_common_saved)
            begun()
            failure = self.wait()
        begun()
        if self._num_failed:
            newest = max(saved_steps(self._checkpoints), default=0)
            raise CheckpointError(
                f"the last checkpoint, at update {self._counts.updates}, could not be written: {failure}. The newest "
                f"one is of update {newest}; mend this and give the same command to go on from there"
            )

    def abandon(self) -> None:
        """Gives up the checkpoint that is being written; for a process that exits at once."""
        self._checkpointer.abandon()

    def wait(self) -> str:
        """Waits until nothing is being written; returns why the last save failed, if it is told for the first time.

        Raises:
            WaitTimeoutError: the disk does not answer.
        """
        self._checkpointer.wait()
        return self._hear()

    def _begin(self, keep_from: int | None) -> None:
        self._begun_at_s = time.monotonic()
        self._counts.saved_updates = self._counts.updates
        self._checkpointer.save(self._counts.updates, *self._take(), keep_from=keep_from)

    def _hear(self) -> str:
        """Takes note of how a save ended, if one did; returns why it failed."""
        failure = self._checkpointer.outcome()
        if failure is None:
            return ""
        if not failure:
            self._num_failed, self.num_saved = 0, self._counts.saved_updates
            return ""
        retry_s = min(SAVE_RETRY_S * 2**self._num_failed, LONGEST_SAVE_RETRY_S)
        self._num_failed += 1
        self._retry_at_s = time.monotonic() + retry_s
        self._report(failure, retry_s)
        return failure
