"""THE data flow of training, an arrow a line: drain -> replay.add -> limiter -> train_step -> broadcast.

What is laid round it (supervision, records, checkpoints, resume) calls into the modules that do the work. Nothing
here waits for the device between log periods but a publication, which copies the parameters to the host, and a
checkpoint.
"""

import contextlib
import dataclasses
import time
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from actors.inline import InlinePool
from actors.pool import STOP_TIMEOUT_S, ActorPool
from gvz import bill, janitor, machine
from gvz.assemble import Parts, Pool, assemble
from gvz.cache import xla_cache_directory
from gvz.config import RunConfig
from gvz.errors import CheckpointError, GvzError, WaitTimeoutError, WorkerError
from gvz.monitor import Counts, Monitor
from gvz.progress import Progress
from gvz.rundir import START_RECORDS, RunDir
from gvz.stop import StopRequest
from gvz.telemetry import Telemetry
from gvz.transport.messages import EpisodeStats, Fault, ParamsHeader
from gvz.watchdog import Watchdog
from learner import replay, train_step
from learner.checkpoint import Checkpointer, Restored, checkpoint_steps, restore_newest
from learner.ingest import Ingest
from learner.limiter import RateLimiter
from learner.memory import keep_freed_memory
from learner.metrics import TaskKpis
from learner.policy import flatten_params

DRAIN_RECORDS = 256
"""most records taken between two looks at the limiter"""
DRAIN_WAIT_S = 0.02
"""longest wait for a record before the loop looks after its actors again"""
NO_RECORDS_TIMEOUT_S = 900.0
"""a run whose actors deliver nothing for so long is stopped; a stuck actor is replaced long before"""
LONGEST_ROUND_S = 1800.0
"""a learner that is at one round for so long (it compiles in one, too) is stuck in the device, and ended"""
SAVE_RETRY_S, LONGEST_SAVE_RETRY_S = 60.0, 3600.0
"""a failed checkpoint is tried again after so long, twice as long each time, or at the next period"""


class Trainer:
    """One run, from its first update or its newest checkpoint to its last. `close` ends all that it started."""

    def __init__(self, config: RunConfig, run: RunDir, parts: Parts, progress: Progress, restored: Restored | None):
        learner, spec, key = config.learner, parts.replay_spec, jax.random.key(config.seed)
        self._config, self._run, self._parts, self._progress = config, run, parts, progress
        self._add = jax.jit(partial(replay.add, spec), donate_argnums=0)
        self._flatten = jax.jit(flatten_params)
        self._train_steps: dict[int, train_step.TrainStep] = {}
        if restored is None:
            self._state = jax.jit(partial(train_step.init, parts.agent, spec, learner))(key)
            self._replay = replay.init(spec)
            self._acting = np.asarray(self._flatten(self._state.params))
        else:
            arrays = jax.tree.map(jnp.array, restored.arrays)  # copies: a borrowed buffer cannot be donated
            self._state, self._replay = arrays["learner"], arrays["replay"]
            self._acting = np.asarray(arrays["acting"])
        host = None if restored is None else restored.host
        self._counts = Counts() if host is None else Counts(**host["counts"])
        self._ingest = Ingest(spec)
        self._limiter = RateLimiter(
            learner.env_steps_per_update, learner.warmup_steps, learner.step_tolerance, parts.num_updates_per_call
        )
        self._kpis = TaskKpis(spec.num_tasks, learner)
        self._telemetry = Telemetry(
            run,
            tasks=parts.pool_config.tasks,
            upper_bound=config.resolved_scenario().upper_bound(config.env.profile),
            tensorboard=config.log.tensorboard,
            num_updates=self._counts.updates,
            wandb=config.log.wandb,
        )
        if host is not None:
            self._ingest.restore(host["ingest"])
            self._limiter.restore(host["limiter"])
            self._kpis.restore({name: np.asarray(values) for name, values in host["kpis"].items()})
            self._telemetry.restore(host["telemetry"])
        self._checkpointer = Checkpointer(run.path, keep=config.checkpoint.keep)
        self._failed_saves, self._retry_save_s = 0, 0.0
        self._monitor = Monitor(config, parts, progress, self._telemetry)
        self._collected_s, self._without_records_s = time.monotonic(), 0.0
        pool = InlinePool if config.mode == "sync" else ActorPool
        self._pool: Pool = pool(parts.pool_config, None if host is None else host["pool"])
        self._send()

    def run(self, stop: StopRequest) -> None:
        """Trains until the last update, or until asked to stop; then writes a checkpoint.

        Raises:
            WorkerError, WaitTimeoutError: the actors failed for good; a checkpoint is written first.
            NonFiniteError: the learner's numbers went wrong; the checkpoints before it stand.
            CheckpointError: the last checkpoint could not be written.
        """
        self._monitor.look(self._counts, self._pool.statistics(), self._ingest.take_staleness)  # rates count from here
        try:
            with Watchdog("the learner", LONGEST_ROUND_S) as watchdog:
                while self._counts.updates < self._config.learner.total_updates and not stop.requested:
                    watchdog.beat()
                    self._collect()
                    self._supervise()
                    self._learn()
                    self._broadcast()
                    self._record()
                    self._save()
        except (WorkerError, WaitTimeoutError):
            with contextlib.suppress(CheckpointError, WaitTimeoutError):  # it is reported; this is the worse news
                self._save_last()
            raise
        self._progress.say("stopping: writing a checkpoint" if stop.requested else "done: writing the last checkpoint")
        self._save_last()

    def close(self, *, abandon_save: bool = False) -> None:
        """Ends every actor, waits for the checkpoint (or abandons both), closes the records. Can be repeated."""
        if abandon_save:
            self._checkpointer.abandon()
        self._pool.close(grace_s=0.0 if abandon_save else STOP_TIMEOUT_S)
        try:
            self._checkpointer.wait()
            self._report_save()
        finally:
            self._telemetry.close()

    # ------------------------------------------------------------------------------------- the arrows

    def _collect(self) -> None:
        """Rings -> replay, as far as the limiter allows."""
        ready_to_learn = self._limiter.num_updates_allowed() > 0
        allowed = min(self._limiter.num_steps_allowed(), DRAIN_RECORDS)
        blocks = self._pool.drain(allowed, wait_s=0.0 if ready_to_learn else DRAIN_WAIT_S)
        for arrays in self._ingest.arrays(blocks, self._counts.version):
            self._replay = self._add(self._replay, arrays)
        self._counts.records += sum(map(len, blocks))
        steps = self._ingest.take_env_steps()
        self._limiter.insert(steps)
        self._counts.env_steps += steps
        # a round's length at most: the time in which this process was stopped is not the actors' silence
        waited_s, self._collected_s = min(time.monotonic() - self._collected_s, 1.0), time.monotonic()
        self._without_records_s = 0.0 if blocks or ready_to_learn else self._without_records_s + waited_s
        if self._without_records_s > NO_RECORDS_TIMEOUT_S:
            raise WaitTimeoutError(
                f"learner waited {self._without_records_s:.0f} s for the actors' next step record; their logs are in "
                f"{self._run.work}, what was done about them in faults.jsonl"
            )

    def _supervise(self) -> None:
        """Actors' messages -> records; dead and stuck actors are replaced by the pool."""
        for message in self._pool.poll():
            if isinstance(message, EpisodeStats):
                self._telemetry.episode(message, num_updates=self._counts.updates, env_steps=self._counts.env_steps)
                if not message.cut:
                    self._kpis.add(message.task, message.score)
            elif isinstance(message, Fault):
                self._telemetry.fault(message, num_updates=self._counts.updates)
                self._progress.say(f"fault: {message.message}")

    def _learn(self) -> None:
        """Replay -> gradient steps -> priorities, as far as the limiter allows."""
        per_call = self._parts.num_updates_per_call
        per_call = min(per_call, self._config.learner.total_updates - self._counts.updates)
        if self._limiter.num_updates_allowed() < per_call:
            return
        if per_call not in self._train_steps:
            replay.check_can_sample(self._parts.replay_spec, self._replay)
            self._train_steps[per_call] = train_step.make_train_step(
                self._parts.agent, self._parts.replay_spec, self._config.learner, self._config.replay, per_call
            )
        weights = jnp.asarray(self._kpis.weights())
        self._state, self._replay = self._train_steps[per_call](self._state, self._replay, weights)
        self._limiter.update(per_call)
        self._counts.updates += per_call

    def _broadcast(self) -> None:
        """Parameters -> actors, every period, and once when warm-up ends: actors then act by the agent."""
        counts, learner = self._counts, self._config.learner
        warmed_up = counts.published_env_steps < learner.warmup_steps <= counts.env_steps
        if warmed_up or counts.updates >= counts.published_updates + learner.publish_period_updates:
            self._acting = np.asarray(self._flatten(self._state.params))
            counts.version += 1
            counts.published_updates, counts.published_env_steps = counts.updates, counts.env_steps
            self._send()

    def _send(self) -> None:
        header = ParamsHeader(
            version=self._counts.version,
            num_updates=self._counts.published_updates,
            epsilon=self._epsilon(),
            layout_hash=self._parts.pool_config.layout_hash,
        )
        self._pool.publish(self._acting, header)

    def _epsilon(self) -> float:
        """1 during warm-up, whatever the agent. Then 0 with noise, else linear from start to end.

        It is a function of the decisions at the last publication, so a resumed run sends what was sent before.
        """
        agent = self._config.agent
        since_warmup = self._counts.published_env_steps - self._config.learner.warmup_steps
        if since_warmup < 0:
            return 1.0
        if agent.noisy != "off":
            return 0.0
        progress = min(1.0, since_warmup / agent.epsilon_decay_steps)
        return agent.epsilon_start + progress * (agent.epsilon_end - agent.epsilon_start)

    # ------------------------------------------------------------------- records, checkpoints, the end

    def _record(self) -> None:
        """Counters -> panel; metrics -> records every log period and at the last update."""
        counts, period = self._counts, self._config.log.period_updates
        due = counts.updates // period > counts.logged_updates // period  # at its multiples, also after an interruption
        if due or counts.updates == self._config.learner.total_updates:
            self._record_row()
        elif counts.updates == 0:
            self._monitor.look(counts, self._pool.statistics(), self._ingest.take_staleness)

    def _record_row(self) -> None:
        """A row of what came since the last one, if anything did. Waits for the device."""
        counts = self._counts
        if counts.updates == counts.logged_updates:
            return
        counts.logged_updates = counts.updates
        tasks = self._parts.pool_config.tasks
        means, self._state = train_step.read_metrics(self._state, tasks, self._run.path)
        stored = np.asarray(replay.records_per_task(self._parts.replay_spec, self._replay))
        shares = dict(zip(tasks, (stored / stored.sum()).tolist(), strict=True))
        self._monitor.log(counts, self._pool.statistics(), self._ingest.take_staleness(), means, shares)

    def _save(self) -> None:
        """Whole state -> checkpoint, every period; a failed one is reported and tried again."""
        if self._checkpointer.busy:
            return
        self._report_save()
        counts, period = self._counts, self._config.checkpoint.period_updates
        due = counts.updates // period > counts.saved_updates // period  # at its multiples, also after an interruption
        if due or (self._failed_saves and time.monotonic() > self._retry_save_s):
            self._begin_save()

    def _save_last(self) -> None:
        """The last checkpoint, waited for; if it fails it is tried once more. Then the last row of metrics.

        The row of an interrupted run stands after what its checkpoint vouches for: a resumed run sets it aside, and its
        next row has the whole log period.

        Raises:
            CheckpointError: it failed again. WaitTimeoutError: the disk does not answer.
            NonFiniteError: the learner's numbers went wrong since they were last read.
        """
        failure = ""
        for attempt in range(3):
            if attempt > 0:
                self._begin_save()
                self._record_row()  # before the wait, which is no part of its rates
            self._checkpointer.wait()
            failure = self._report_save()
            if self._counts.saved_updates == self._counts.updates and not self._failed_saves:
                self._record_row()
                return
        newest = max(checkpoint_steps(self._run.checkpoints), default=0)
        raise CheckpointError(
            f"the last checkpoint, at update {self._counts.updates}, could not be written: {failure}. The newest one "
            f"is of update {newest}; mend this and give the same command to go on from there"
        )

    def _begin_save(self) -> None:
        train_step.check_finite(self._state, self._run.path)
        self._counts.saved_updates = self._counts.updates
        arrays = {"learner": self._state, "replay": self._replay, "acting": self._acting}
        self._checkpointer.save(self._counts.updates, arrays, self._state.params, self._host_state())

    def _report_save(self) -> str:
        """Notes how a save ended, if one did; returns why it failed."""
        failure = self._checkpointer.outcome()
        if failure is None:
            return ""
        if not failure:
            self._failed_saves = 0
            return ""
        wait_s = min(SAVE_RETRY_S * 2**self._failed_saves, LONGEST_SAVE_RETRY_S)
        self._failed_saves += 1
        self._retry_save_s = time.monotonic() + wait_s
        self._progress.say(f"checkpoint failed, tried again within {wait_s:.0f} s: {failure}")
        self._monitor.fault("checkpoint", failure, self._counts.updates)
        return failure

    def _host_state(self) -> dict[str, Any]:
        """What a checkpoint holds beside arrays, msgpack types."""
        return {
            "counts": dataclasses.asdict(self._counts),
            "ingest": self._ingest.state(),
            "limiter": self._limiter.state(),
            "kpis": {name: array.tolist() for name, array in self._kpis.state().items()},
            "telemetry": self._telemetry.state(),
            "pool": self._pool.state(),
            "records": self._run.record_lengths(),
        }


def _template(config: RunConfig, parts: Parts) -> dict[str, Any]:
    """Shapes and dtypes of a checkpoint's arrays."""
    spec = parts.replay_spec
    return {
        "learner": jax.eval_shape(
            lambda: train_step.init(parts.agent, spec, config.learner, jax.random.key(config.seed))
        ),
        "replay": jax.eval_shape(lambda: replay.init(spec)),
        "acting": jax.ShapeDtypeStruct((parts.pool_config.num_params,), jnp.float32),
    }


def train(config: RunConfig, run: RunDir, stop: StopRequest) -> int:
    """Trains, resuming if the run directory holds a checkpoint.

    Args:
        config: of the run.
        run: where it is kept.
        stop: entered; from when there is a trainer on, the first signal no longer ends things at once.

    Returns: 0 when all updates are done; 130 or 143 when a signal stopped the run, which is then saved.

    Raises:
        ResourceError: the machine is too small. GvzError: what a user can do something about.
        KeyboardInterrupt: a second signal, or a first one before the trainer was there; nothing is left running.
    """
    keep_freed_memory()
    jax.config.update("jax_compilation_cache_dir", str(xla_cache_directory()))
    with Progress() as progress:
        for line in janitor.clean_dead_instances():
            progress.say(f"removed what a dead run left: {line}")
        parts = assemble(config, run.work)
        for line in parts.bill.lines():
            progress.say(line)
        bill.check(parts.bill)
        restored = restore_newest(run.checkpoints, _template(config, parts))
        if restored is None:
            progress.say(f"new run in {run.path}")
            run.truncate_records(dict.fromkeys(run.record_lengths(), 0))
        else:
            for damage in restored.damage:
                progress.say(f"damaged checkpoint passed over: {damage}")
            progress.say(f"run in {run.path} goes on from update {restored.num_updates}")
        run.write_config(config)
        started_from = 0 if restored is None else restored.num_updates
        run.append(START_RECORDS, {"num_updates": started_from, "time_s": time.time(), **machine.describe()})
        stop.at_once = False
        try:
            if restored is not None:
                run.truncate_records(restored.host["records"])
            trainer = Trainer(config, run, parts, progress, restored)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            if restored is None or isinstance(error, GvzError):
                raise
            raise CheckpointError(
                f"{run.checkpoints / str(started_from)}: its host state is not one of a run ({error!r}); move it "
                "aside, and the run goes on from the checkpoint before it"
            ) from error
        del restored
        with contextlib.closing(trainer):
            try:
                trainer.run(stop)
            except KeyboardInterrupt:
                trainer.close(abandon_save=True)
                raise
        return stop.exit_code if stop.requested else 0
