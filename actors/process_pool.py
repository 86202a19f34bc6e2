"""The pool of actor processes: starts them, watches them, takes their records."""

import os
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from actors.inference import InferenceServer
from actors.loop import derive_seed
from actors.placement import cores_left, give_back, keep_to
from actors.policy import Policy
from actors.pool import STOP_TIMEOUT_S, Pool, PoolConfig, PoolStatistics, lanes_to_begin_with, num_decisions
from actors.preprocess import ObservationBatch
from actors.supervisor import SupervisedActor
from gvz.core import janitor
from gvz.core.errors import ResourceError
from gvz.core.watchdog import AwakeClock
from gvz.transport.broadcast import BroadcastWriter
from gvz.transport.child import end_all
from gvz.transport.messages import Message, ParamsHeader, StepBlock
from gvz.transport.ring import WriterStatus

_WAIT_SLEEP_S = 0.001
_MIN_DRAIN_SHARE = 1 / 8
"""of what the rings hold: with fewer records than that a drain rather waits, since it costs the same for one as for
many (play at random on 2 cores: 12% more decisions/s than taking every record as it comes)"""


class ProcessPool(Pool):
    """The `Pool` whose actors are processes."""

    def __init__(
        self,
        config: PoolConfig,
        state: dict[str, Any] | None = None,
        make_policy: Callable[[int], Policy] | None = None,
    ):
        """Makes the segments and starts the processes; does not wait for them.

        Args:
            config: what is played.
            state: what `state()` returned in the run that is resumed.
            make_policy: seed of 31 bits -> what chooses the actions in this process, if `actors.inference` is "device".

        Raises:
            ValueError: a policy is missing, or one too many.
            ResourceError: there is not enough memory.
            ResumeError: `state` is of a pool of another size.
        """
        if (config.actors.inference == "device") != (make_policy is not None):
            raise ValueError(f"make_policy: got {make_policy} for actors.inference {config.actors.inference!r}")
        self._lanes = lanes_to_begin_with(config, state)
        specs = config.actor_specs(self._lanes)
        self._config = config
        self._min_drain_records = max(1, int(_MIN_DRAIN_SHARE * config.num_actors * config.ring_capacity))
        self._actors: list[SupervisedActor] = []
        self._params: BroadcastWriter | None = None
        self._inference: InferenceServer | None = None
        self._clock = AwakeClock(config.actors.heartbeat_timeout_s / 4)
        self._env_steps, self._waited_s = 0, 0.0
        self._own_cores = os.sched_getaffinity(0)
        try:
            if config.policy:
                self._params = BroadcastWriter.create("gvz-params", config.num_params, config.layout_hash)
            for spec in specs:
                self._actors.append(SupervisedActor(spec, config.actors, self._params))
            keep_to(cores_left(spec.core for spec in specs))
            if make_policy is not None:
                policy = make_policy(derive_seed(config.seed, *self._lanes.next_episodes))
                requests = [actor.requests for actor in self._actors if actor.requests is not None]
                batch = ObservationBatch.of(config, config.num_lanes).arrays
                self._inference = InferenceServer(policy, requests, batch)
            for actor in self._actors:
                try:
                    actor.start()
                except OSError as error:
                    raise ResourceError(
                        f"an actor cannot be started: {error}; use fewer actors, or raise `ulimit -u` and `ulimit -n`"
                    ) from error
        except BaseException:
            self.close()
            raise

    def publish(self, params: ArrayLike, header: ParamsHeader) -> None:
        if self._params is not None:
            self._params.publish(np.asarray(params), header)
        elif self._inference is not None:
            self._inference.publish(params, header)

    def assign(self, lane: int, task: int) -> None:
        """As `Pool.assign`; a restarted actor begins the lane's next episode with this task."""
        index = self._config.lanes.index(lane)
        self._lanes.tasks[index] = task
        self._actors[index // self._config.games_per_actor].assign(lane, task)

    def drain(self, max_records: int, wait_s: float = 0.0) -> list[StepBlock]:
        """As `Pool.drain`: an equal share from every actor as far as it has one. The time of waiting is counted."""
        start = time.monotonic()
        worthwhile = min(max_records, self._min_drain_records)
        while sum(actor.ring.num_unread for actor in self._actors) < worthwhile and time.monotonic() - start < wait_s:
            time.sleep(_WAIT_SLEEP_S)
        if wait_s > 0.0:
            self._waited_s += time.monotonic() - start
        # the emptiest first: what they leave of their share goes to the others
        actors = sorted(self._actors, key=lambda actor: actor.ring.num_unread)
        blocks = []
        for index, actor in enumerate(actors):
            share = max_records // (len(actors) - index)
            block = actor.ring.read(share)
            if len(block):
                max_records -= len(block)
                actor.track_episodes(block.steps)
                self._env_steps += num_decisions(block.steps)
                blocks.append(block)
        return blocks

    def poll(self) -> list[Message]:
        """As `Pool.poll`. Dead and stuck actors are replaced; what they published stays in the ring, and their games go
        on with new episodes. What an actor that failed for good said last came with the poll before the error.
        """
        if self._inference is not None:
            self._inference.check()
        for actor in self._actors:
            if actor.failure is not None:
                raise actor.failure
        watched_s = -self._clock.now_s + self._clock.look()
        return [message for actor in self._actors for message in actor.watch(time.monotonic(), watched_s)]

    def state(self) -> dict[str, Any]:
        """As `Pool.state`: lanes go on with new episodes."""
        for actor in self._actors:
            actor.track_unread()
        next_episodes = [episode for actor in self._actors for episode in actor.next_episodes]
        return {"next_episodes": next_episodes, "tasks": list(self._lanes.tasks)}

    def statistics(self) -> PoolStatistics:
        return PoolStatistics(
            env_steps=self._env_steps,
            restarts=sum(actor.restarts for actor in self._actors),
            actors_ready=sum(actor.ready for actor in self._actors),
            waited_for_space_s=sum(status.waited_for_space_s for status in self.writer_statuses()),
            waited_for_records_s=self._waited_s,
        )

    def writer_statuses(self) -> list[WriterStatus]:
        """What each actor is at, in order."""
        return [actor.ring.writer_status() for actor in self._actors]

    def close(self, *, grace_s: float = STOP_TIMEOUT_S) -> None:
        try:
            end_all([actor.process for actor in self._actors if actor.process is not None], grace_s)
        finally:
            inference, self._inference = self._inference, None  # one that was abandoned is not waited for later
            try:
                if inference is not None:
                    inference.close(abandon=grace_s == 0.0)
            finally:
                for actor in self._actors:
                    actor.free()
                if self._params is not None:
                    self._params.close()
                keep_to(self._own_cores)
                give_back()
                janitor.clean_dead_instances()
