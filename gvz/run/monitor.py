"""A run watched from outside: counters -> panel, means -> records, alarms -> warnings."""

import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from actors.pool import PoolStatistics
from gvz.run.alarms import Expected, alarms
from gvz.run.assemble import RunParts
from gvz.run.config import RunConfig
from gvz.run.progress import Progress, Status
from gvz.run.telemetry import Rates, Telemetry
from gvz.transport.messages import Fault
from learner.config import LearnerConfig
from learner.ingest import Staleness

STATUS_PERIOD_S = 0.5
"""seconds between looks at the counters for the live panel, while there are no log periods yet"""


@dataclass(kw_only=True, slots=True)
class Counts:
    """What a run has done so far; part of every checkpoint."""

    records: int = 0
    """step records that the learner took, overwritten ones included"""
    env_steps: int = 0
    """decisions among them"""
    updates: int = 0
    """gradient steps"""
    version: int = 0
    """of the newest parameters on the broadcast queue"""
    published_updates: int = 0
    """gradient steps of that version"""
    published_env_steps: int = 0
    """decisions counted when it was published"""
    logged_updates: int = 0
    saved_updates: int = 0
    processor_s: float = 0.0
    """processor time of this run, over all its starts, when it was last looked at"""


class Monitor:
    """Looks at the counters of a run and says what they mean, to the panel, the records and the user."""

    def __init__(self, config: RunConfig, parts: RunParts, progress: Progress, telemetry: Telemetry, counts: Counts):
        self._config, self._progress, self._telemetry, self._counts = config, progress, telemetry, counts
        self._num_actors = config.num_actors  # before cores are kept for actors: it may follow from their number
        self._num_slots, self._batch_size = parts.learner.num_slots, parts.learner.batch_size
        self._publish_period_updates = _publish_period_updates(config, parts)
        self._expected, self._warned = _expected(config, parts), set[str]()
        self._rates, self._last_look_s, self._loss = Rates(), 0.0, float("nan")
        self._fill_share: float | None = None

    def log(self, statistics: PoolStatistics, staleness: Staleness, metrics: Mapping[str, float]) -> None:
        """A row of records, its alarms, and the panel, once a log period; `metrics` are the learner's."""
        scalars = {**self._measure(statistics, staleness), **metrics}
        self._fill_share = scalars["replay/fill_share"]
        self._telemetry.scalars(self._counts.updates, scalars)
        for condition, text in alarms(scalars, self._telemetry.task_statuses(), self._expected).items():
            if condition not in self._warned:  # each thing once
                self._warned.add(condition)
                self._progress.say(f"warning: {text}")
                self._fault("warning", text)
        self._loss = metrics["learner/loss"]
        self._progress.show(self._status(scalars))

    def look(self, statistics: PoolStatistics, take_staleness: Callable[[], Staleness]) -> None:
        """The panel alone, while there is nothing to log; does nothing if called again too soon."""
        now = time.monotonic()
        if now - self._last_look_s >= STATUS_PERIOD_S:
            self._last_look_s = now
            self._progress.show(self._status(self._measure(statistics, take_staleness())))

    def failed_save(self, failure: str, retry_s: float) -> None:
        """A checkpoint could not be written; it is tried again after this time at the latest."""
        self._progress.say(f"checkpoint failed, tried again within {retry_s:.0f} s: {failure}")
        self._fault("checkpoint", failure)

    def _fault(self, kind: str, message: str) -> None:
        """Records a fault of the learner itself, not of an actor."""
        fault = Fault(actor=-1, lane=None, kind=kind, message=message)
        self._telemetry.fault(fault, num_updates=self._counts.updates)

    def _measure(self, statistics: PoolStatistics, staleness: Staleness) -> dict[str, float]:
        """Rates and waits since the last look, and sizes."""
        counts, fill_share = self._counts, self._fill_share
        if fill_share is None:  # the learner has not counted yet
            fill_share = min(1.0, counts.records / self._num_slots)
        rates = self._rates(
            {
                "learner/updates_per_s": counts.updates,
                "learner/samples_per_s": counts.updates * self._batch_size,
                "actors/decisions_per_s": counts.env_steps,
                "actors/frames_per_s": counts.env_steps * self._config.env.frame_skip,
                "learner/wait_share": statistics.waited_for_records_s,
                "actors/wait_share": statistics.waited_for_space_s / self._num_actors,
            }
        )
        return {
            **rates,
            "actors/env_steps": counts.env_steps,
            "actors/restarts": statistics.restarts,
            "actors/staleness_mean_versions": staleness.mean,
            "actors/staleness_p95_versions": staleness.p95,
            "actors/staleness_max_versions": staleness.max,
            "run/processor_s": counts.processor_s,
            "replay/fill_share": fill_share,
            **statistics.more,
        }

    def _status(self, row: Mapping[str, float]) -> Status:
        counts, learner = self._counts, self._config.learner
        if counts.updates:
            phase = "training"
        elif counts.env_steps:
            phase = f"warm-up {counts.env_steps:,}/{learner.warmup_steps:,} decisions"
        else:
            phase = "starting actors"
        return Status(
            phase=phase,
            num_updates=counts.updates,
            total_updates=learner.total_updates,
            row=row,
            staleness_updates=row["actors/staleness_mean_versions"] * self._publish_period_updates,
            loss=self._loss,
            tasks=self._telemetry.task_statuses(),
        )


def _expected(config: RunConfig, parts: RunParts) -> Expected:
    tasks, learner = parts.table.ids, config.learner
    v_min, v_max = config.support or parts.table.return_range
    ahead = 2 * learner.step_tolerance if isinstance(learner, LearnerConfig) else 0
    cluster = config.cluster
    under_way = cluster.hosts * (cluster.credits + 1) * cluster.batch_records
    waiting = config.num_actors * parts.pool_config.ring_capacity + under_way + ahead
    played = Counter(tasks[lane % len(tasks)] for lane in range(config.num_lanes))
    return Expected(
        games={task: played[task] for task in tasks} if config.curriculum.kind == "fixed" else {},
        timeout_steps=-(-max(row.timeout_frames for row in parts.table.rows) // config.env.frame_skip),
        num_slots=parts.learner.num_slots,
        v_min=v_min,
        v_max=v_max,
        distributional=config.support is not None,
        staleness_versions=1 + waiting / config.env_steps_per_update / _publish_period_updates(config, parts),
    )


def _publish_period_updates(config: RunConfig, parts: RunParts) -> int:
    """Gradient steps between two publications, on average."""
    return max(config.learner.publish_period_updates, parts.learner.num_updates_per_call)
