"""THE data flow of training, an arrow a line: pool -> learner -> pool, round after round.

What is laid round it (supervision, records, checkpoints, resume) calls into the modules that do the work. How records
become gradient steps is the learner's matter (`learner.learner`), where games are played is the pool's. Nothing here
waits for the device between log periods but a checkpoint, and a publication to actors that act by themselves.
"""

import contextlib
import dataclasses
import shutil

import jax

from actors.pool import STOP_TIMEOUT_S
from gvz.core import janitor, records
from gvz.core.cache import xla_cache_directory
from gvz.core.errors import CheckpointError, ConfigError, WaitTimeoutError, WorkerError
from gvz.core.stop import StopRequest
from gvz.core.watchdog import AwakeClock, Watchdog
from gvz.run import footprint, machine
from gvz.run.assemble import RunParts, assemble
from gvz.run.config import RunConfig
from gvz.run.curriculum import Curriculum
from gvz.run.group import Group, join
from gvz.run.monitor import Counts, Monitor
from gvz.run.progress import Progress
from gvz.run.restore import note_start, restore, state_checked
from gvz.run.rundir import RunDir, disk_checked
from gvz.run.saver import Saver, Snapshot
from gvz.run.telemetry import Telemetry
from gvz.segmentation import KEPT_SEGMENTERS, check_installed, keep_segmenters, with_kept_segmenters
from gvz.transport.messages import EpisodeStats, Fault, ParamsHeader
from learner.checkpoint import Restored
from learner.memory import keep_freed_memory

DRAIN_RECORDS = 256
"""most records taken between two looks at the limiter"""
DRAIN_WAIT_S = 0.02
"""longest wait for a record before the loop looks after its actors again"""
LONGEST_WAIT_S = 1.0
"""most of a round that counts as waiting for records; a longer one was stopped or busy"""
NO_RECORDS_TIMEOUT_S = 900.0
"""a run whose actors deliver nothing for this time is stopped; a stuck actor is replaced long before"""
LONGEST_ROUND_S = 1800.0
"""a learner whose round takes longer is stuck in the device and is ended (a round may compile)"""


class Trainer:
    """One run, from its first update or its newest checkpoint to its last. `close` ends all that it started."""

    def __init__(
        self,
        config: RunConfig,
        run: RunDir,
        parts: RunParts,
        group: Group,
        progress: Progress,
        restored: Restored | None,
    ):
        host = None if restored is None else restored.host
        self._config, self._run, self._parts, self._group, self._progress = config, run, parts, group, progress
        self._counts = Counts() if host is None else Counts(**host["counts"])
        self._processor_start_s = machine.processor_s() - self._counts.processor_s
        self._learner = parts.learner.make(jax.random.key(config.seed), parts.table.ids, run.path, restored)
        self._published_params = self._learner.acting_params() if restored is None else restored.arrays["acting"]
        self._telemetry = Telemetry(run, parts.table, config.log, self._counts.logged_updates)
        if host is not None:
            self._telemetry.restore(host["telemetry"])
        self._curriculum = Curriculum(config.curriculum, parts.table, config.games_seed, host and host["curriculum"])
        self._monitor = Monitor(config, parts, progress, self._telemetry, self._counts)
        self._saver = Saver(run, config.checkpoint, self._counts, self._snapshot, self._monitor.failed_save)
        self._clock, self._collected_s = AwakeClock(LONGEST_WAIT_S), 0.0
        self._pool = parts.make_pool(config, None if host is None else host["pool"])
        try:
            self._send()
        except BaseException:
            self._pool.close(grace_s=0.0)
            raise

    def run(self, stop: StopRequest) -> None:
        """Trains until the last update, the end of its processor time, or a stop; then writes a checkpoint.

        The last row of metrics of an interrupted run stands after what its checkpoint vouches for: a resumed run sets
        it aside, and the means of its learner in the next row are of the whole log period.

        Raises:
            WorkerError, WaitTimeoutError: the actors failed for good; a checkpoint is written first.
            ConfigError: what the user gave does not work, for example an agent's epsilon; likewise.
            NonFiniteError: the learner's numbers went wrong; the checkpoints before it stand.
            CheckpointError: the last checkpoint could not be written.
        """
        self._monitor.look(self._pool.statistics(), self._learner.take_staleness)  # rates count from here
        try:
            with Watchdog("the learner", LONGEST_ROUND_S) as watchdog:
                while not self.is_done() and not self._group.stops(stop):
                    watchdog.beat()
                    self._collect()
                    self._supervise()
                    if self._group.may_update(self._learner.can_update(), self._saver.busy, self._saver.num_saved):
                        self._counts.updates += self._learner.update()
                    self._broadcast()
                    self._record()
                    self._saver.save_when_due(self._group)
        except (ConfigError, WorkerError, WaitTimeoutError):
            with contextlib.suppress(CheckpointError, WaitTimeoutError):  # already reported; the first error is raised
                self._saver.save_last(self._group, self._record_row)
            raise
        last = "writing the last checkpoint" if self._saver.behind else "no new gradient steps to save"
        self._progress.say(f"{self._ending()}: {last}")
        self._saver.save_last(self._group, self._record_row)
        self._record_used_up_time()

    def close(self, *, abandon_save: bool = False) -> None:
        """Ends every actor, waits for the checkpoint (or abandons both), closes the records. Can be repeated."""
        try:
            self._pool.close(grace_s=0.0 if abandon_save else STOP_TIMEOUT_S)
        finally:
            try:
                if abandon_save:  # last: the thread that writes says a lot about files that are gone
                    self._saver.abandon()
                self._saver.wait()
            finally:
                self._telemetry.close()

    def is_done(self) -> bool:
        """The run is complete. Processor time is looked at with every row of metrics: a row more or less is how exact
        its limit is.
        """
        config, counts = self._config, self._counts
        used_up = config.max_processor_s is not None and counts.processor_s >= config.max_processor_s
        return used_up or counts.updates >= config.learner.total_updates

    def _ending(self) -> str:
        limit_s, counts = self._config.max_processor_s, self._counts
        if not self.is_done():
            return "stopping"
        if limit_s is None or counts.updates >= self._config.learner.total_updates:
            return "done"
        return f"done, with {counts.processor_s:,.0f} of {limit_s:,.0f} s of processor time (--max-processor-s) used up"

    def _collect(self) -> None:
        """Rings -> learner, as far as it allows."""
        ready_to_learn = self._learner.can_update()
        allowed = min(self._learner.num_steps_allowed(), DRAIN_RECORDS)
        blocks = self._pool.drain(allowed, wait_s=0.0 if ready_to_learn else DRAIN_WAIT_S)
        self._counts.env_steps += self._learner.add(blocks, self._counts.version)
        self._counts.records += sum(map(len, blocks))
        now_s = self._clock.look()
        if blocks or ready_to_learn:
            self._collected_s = now_s
        if (waited_s := now_s - self._collected_s) > NO_RECORDS_TIMEOUT_S:
            raise WaitTimeoutError(
                f"learner waited {waited_s:.0f} s for the actors' next step record; their logs are in "
                f"{self._run.work}, what was done about them in faults.jsonl"
            )

    def _supervise(self) -> None:
        """Actors' messages -> records; dead and stuck actors are replaced by the pool."""
        for message in self._pool.poll():
            if isinstance(message, EpisodeStats):
                self._telemetry.episode(message, num_updates=self._counts.updates, env_steps=self._counts.env_steps)
                if not message.cut:
                    percent = self._parts.table.percent(message.task, message.score)
                    self._learner.add_episode(message.task, percent)
                    if (task := self._curriculum.next_task(message, percent)) is not None:
                        self._pool.assign(message.lane, task)
            elif isinstance(message, Fault):
                self._telemetry.fault(message, num_updates=self._counts.updates)
                self._progress.say(f"fault: {message.message}")

    def _broadcast(self) -> None:
        """Parameters -> actors, every period, and once when warm-up ends: actors then act by the agent."""
        counts, learner = self._counts, self._config.learner
        warmed_up = counts.published_env_steps < learner.warmup_steps <= counts.env_steps
        period = learner.publish_period_updates  # a mean: a call makes several gradient steps on a GPU
        if warmed_up or counts.updates // period > counts.published_updates // period:
            self._published_params = self._learner.acting_params()
            counts.version += 1
            counts.published_updates, counts.published_env_steps = counts.updates, counts.env_steps
            self._send()

    def _send(self) -> None:
        """Epsilon follows from the decisions at the publication, so a resumed run sends what was sent before.

        Raises:
            ConfigError: it is no probability.
        """
        epsilon = float(self._learner.epsilon(self._counts.published_env_steps))  # of a schedule of optax, an array
        if not 0 <= epsilon <= 1:
            raise ConfigError(
                f"agent.name: the `epsilon` of {self._config.agent.name!r} gives {epsilon} after "
                f"{self._counts.published_env_steps} decisions of the run; want 0..1: keep its schedule within them, "
                "and give the same command to go on"
            )
        header = ParamsHeader(
            version=self._counts.version,
            num_updates=self._counts.published_updates,
            epsilon=epsilon,
            layout_hash=self._parts.pool_config.layout_hash,
        )
        self._pool.publish(self._published_params, header)

    def _record(self) -> None:
        """Counters -> panel; metrics -> records every log period and at the last update."""
        counts, period = self._counts, self._config.log.period_updates
        due = counts.updates // period > counts.logged_updates // period  # at its multiples, also after an interruption
        if due or counts.updates == self._config.learner.total_updates:
            self._record_row()
        elif counts.updates == 0:
            self._monitor.look(self._pool.statistics(), self._learner.take_staleness)

    def _record_row(self) -> None:
        """A row of what came since the last one, if anything did. Waits for the device."""
        counts = self._counts
        if counts.updates > counts.logged_updates:
            counts.logged_updates = counts.updates
            self._take_processor_time()
            learner = self._learner
            self._monitor.log(self._pool.statistics(), learner.take_staleness(), learner.take_metrics())

    def _record_used_up_time(self) -> None:
        """The last row again, with the processor time of the counts, if these alone have the limit: what a run has used
        is read from its rows. Earlier versions took the time of a checkpoint after that of its row.
        """
        limit_s, counts = self._config.max_processor_s, self._counts
        if limit_s is None or counts.processor_s < limit_s:
            return
        row = next(records.newest_rows(self._run.path / "metrics.jsonl"), {})
        if row.get("num_updates") == counts.updates and row.get("run/processor_s", 0.0) < limit_s:
            self._run.append("metrics.jsonl", {**row, "run/processor_s": counts.processor_s})

    def _take_processor_time(self) -> None:
        """Never less than before: a child may have ended without being waited for."""
        self._counts.processor_s = max(self._counts.processor_s, machine.processor_s() - self._processor_start_s)

    def _snapshot(self) -> Snapshot:
        """The whole state; raises NonFiniteError instead of saving numbers that went wrong."""
        self._learner.check_finite()
        if self._counts.updates > self._counts.logged_updates:  # else it has that of its row, by which others know it
            self._take_processor_time()
        host = {
            "counts": dataclasses.asdict(self._counts),
            "telemetry": self._telemetry.state(),
            "curriculum": self._curriculum.state(),
            "pool": self._pool.state(),
            "records": self._run.record_lengths(),
            **self._learner.state(),
        }
        return Snapshot({**self._learner.arrays(), "acting": self._published_params}, self._learner.params, host)


def with_own_segmenters(config: RunConfig, run: RunDir) -> RunConfig:
    """The configuration with the run's own copies of its segmentation networks. Other hosts have no copies; games there
    use the networks that are installed. Copies of a start that ended before the run had a configuration are replaced.

    Raises:
        ResumeError: those are not the run's.
    """
    own, scenarios = run.path / KEPT_SEGMENTERS, [scenario.id for scenario in config.table.scenarios]
    with disk_checked(run.path):
        if own.exists() and not (run.path / "config.json").exists():
            shutil.rmtree(own)
        keep_segmenters(scenarios, config.env, own)
    if config.cluster.hosts:
        check_installed(scenarios, config.env, own)
        return config
    return dataclasses.replace(config, env=with_kept_segmenters(config.env, own))


def train(config: RunConfig, run: RunDir, stop: StopRequest) -> int:
    """Trains, resuming if the run directory holds a checkpoint.

    `stop` is entered; from when there is a trainer on, the first signal no longer ends things at once.

    Returns: 0 when all updates are done, or the processor time is used up, whatever signal came then; 130, 143 or 129
    when a signal stopped the run before, which is then saved.

    Raises:
        ResourceError: the machine is too small. GvzError: what a user can do something about.
        KeyboardInterrupt: a second signal, or a first one before the trainer was there; nothing is left running.
    """
    keep_freed_memory()
    jax.config.update("jax_compilation_cache_dir", str(xla_cache_directory()))
    with Progress() as progress:
        for line in janitor.clean_dead_instances():
            progress.say(f"removed what a dead run left: {line}")
        group = join(config, progress.say)
        parts = assemble(with_own_segmenters(config, run), run.work)
        progress.say("\n".join(parts.footprint.lines()))
        footprint.check(parts.footprint, device_free=machine.free_device_memory())
        restored = restore(run, parts.array_shapes(), group, progress.say)
        run.write_config(config)
        note_start(run, restored)
        stop.at_once = False
        with state_checked(run, restored):
            trainer = Trainer(config, run, parts, group, progress, restored)
        del restored
        with contextlib.closing(trainer):
            try:
                with group.blamed():
                    trainer.run(stop)
                    group.leave()
            except KeyboardInterrupt:
                trainer.close(abandon_save=True)
                raise
        return 0 if trainer.is_done() else stop.exit_code
