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
from learner.ingest import Staleness

STATUS_PERIOD_S = 0.5
"""seconds between looks at the counters for the live panel, while there are no log periods yet"""


@dataclass(kw_only=True, slots=True)
class Counts:
    """What a run has done so far; part of every checkpoint."""

    records: int = 0
    """step records put into the replay, overwritten ones included"""
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


class Monitor:
    """Looks at the counters of a run and says what they mean, to the panel, the records and the user."""

    def __init__(self, config: RunConfig, parts: RunParts, progress: Progress, telemetry: Telemetry):
        self._config, self._num_slots, self._progress = config, parts.learner.replay_spec.num_slots, progress
        self._telemetry = telemetry
        self._expected, self._warned = _expected(config, parts), set[str]()
        self._rates, self._last_look_s, self._loss = Rates(), 0.0, float("nan")

    def log(
        self,
        counts: Counts,
        statistics: PoolStatistics,
        staleness: Staleness,
        metrics: Mapping[str, float],
    ) -> None:
        """A row of records, its alarms, and the panel, once a log period.

        Args:
            counts: of the run.
            statistics: of its actors.
            staleness: since the last look.
            metrics: the learner's.
        """
        row = self._measure(counts, statistics, staleness)
        scalars = {**row, **metrics}
        self._telemetry.scalars(counts.updates, scalars)
        for condition, text in alarms(scalars, self._telemetry.task_statuses(), self._expected).items():
            if condition not in self._warned:  # each thing once
                self._warned.add(condition)
                self._progress.say(f"warning: {text}")
                self.fault("warning", text, counts.updates)
        self._loss = metrics["learner/loss"]
        self._progress.show(self._status(counts, row))

    def look(self, counts: Counts, statistics: PoolStatistics, take_staleness: Callable[[], Staleness]) -> None:
        """The panel alone, while there is nothing to log; does nothing if called again too soon."""
        now = time.monotonic()
        if now - self._last_look_s >= STATUS_PERIOD_S:
            self._last_look_s = now
            self._progress.show(self._status(counts, self._measure(counts, statistics, take_staleness())))

    def fault(self, kind: str, message: str, num_updates: int) -> None:
        """Records a fault of the learner itself, not of an actor."""
        self._telemetry.fault(Fault(actor=-1, lane=None, kind=kind, message=message), num_updates=num_updates)

    def _measure(self, counts: Counts, statistics: PoolStatistics, staleness: Staleness) -> dict[str, float]:
        """Rates and waits since the last look, and sizes."""
        rates = self._rates(
            {
                "learner/updates_per_s": counts.updates,
                "learner/samples_per_s": counts.updates * self._config.learner.batch_size,
                "actors/decisions_per_s": counts.env_steps,
                "actors/frames_per_s": counts.env_steps * self._config.env.frame_skip,
                "learner/wait_share": statistics.waited_for_records_s,
                "actors/wait_share": statistics.waited_for_space_s / self._config.num_actors,
            }
        )
        return {
            **rates,
            "actors/env_steps": counts.env_steps,
            "actors/restarts": statistics.restarts,
            "actors/staleness_mean_versions": staleness.mean,
            "actors/staleness_p95_versions": staleness.p95,
            "actors/staleness_max_versions": staleness.max,
            "replay/fill_share": min(1.0, counts.records / self._num_slots),
        }

    def _status(self, counts: Counts, row: Mapping[str, float]) -> Status:
        learner = self._config.learner
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
            env_steps=counts.env_steps,
            updates_per_s=row["learner/updates_per_s"],
            steps_per_s=row["actors/decisions_per_s"],
            frames_per_s=row["actors/frames_per_s"],
            replay_fill=row["replay/fill_share"],
            learner_wait=row["learner/wait_share"],
            actor_wait=row["actors/wait_share"],
            staleness_updates=row["actors/staleness_mean_versions"] * learner.publish_period_updates,
            loss=self._loss,
            restarts=int(row["actors/restarts"]),
            tasks=self._telemetry.task_statuses(),
        )


def _expected(config: RunConfig, parts: RunParts) -> Expected:
    tasks, spec, agent = parts.pool_config.tasks, parts.learner.agent.spec, config.agent
    v_min, v_max = agent.value_range(spec.v_min, spec.v_max)
    waiting = config.num_actors * parts.pool_config.ring_capacity + 2 * config.learner.step_tolerance
    played = Counter(tasks[lane % len(tasks)] for lane in range(config.num_lanes))
    return Expected(
        games={task: played[task] for task in tasks},
        timeout_steps=-(-config.resolved_scenario().timeout_frames(config.env.profile) // config.env.frame_skip),
        num_slots=parts.learner.replay_spec.num_slots,
        v_min=v_min,
        v_max=v_max,
        distributional=agent.distributional,
        staleness_versions=1 + waiting / config.learner.env_steps_per_update / config.learner.publish_period_updates,
    )
