"""The pool of actor processes: starts them, watches them, takes their records.

`ActorPool` and `actors.inline.InlinePool` have one interface: `publish`, `drain`, `poll`, `state`, `statistics`,
`close`. Neither starts a thread: all watching happens in `poll`, which the learner calls in every round.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from actors.config import ActorsConfig
from actors.supervisor import SupervisedActor
from gvz.core import janitor
from gvz.core.errors import ConfigError, ResumeError
from gvz.transport.broadcast import BroadcastWriter, broadcast_bytes
from gvz.transport.messages import ActorSpec, EpisodeStats, Message, ParamsHeader, StepBlock
from gvz.transport.ring import WriterStatus, ring_bytes

STOP_TIMEOUT_S = 5.0
_WAIT_SLEEP_S = 0.001
_MIN_DRAIN_SHARE = 1 / 8
"""of what the rings hold: with fewer records than that a drain rather waits, since it costs the same for one as for
many (play at random on 2 cores: 12% more decisions/s than taking every record as it comes)"""


@dataclass(frozen=True, kw_only=True, slots=True)
class PoolConfig:
    """What a pool plays. Lane i is game i % games_per_actor of actor i // games_per_actor and plays task i % T."""

    tasks: tuple[str, ...]
    """ids of the run's tasks"""
    num_actors: int
    games_per_actor: int
    seed: int
    """the run's seed, at least 0"""
    env_entry_point: str
    """`module:callable`, called as f(task_id, env_config) -> gymnasium.Env"""
    env_config: dict[str, Any]
    """of plain types: it travels as msgpack; `recycle_episodes` is added to it"""
    frame_shape: tuple[int, int, int]
    """(H, W, C)"""
    stack_size: int
    num_actions: int
    policy: bytes
    """serialized acting function; empty for uniformly random play"""
    num_params: int
    """length of the flat float32 parameter vector; 0 for random play"""
    layout_hash: int
    """of the parameter tree; 0 for random play"""
    actors: ActorsConfig
    work_dir: Path
    """private directory for logs and the engines' files"""

    def __post_init__(self) -> None:
        if self.num_lanes < len(self.tasks):
            raise ConfigError(
                f"actors: got {self.num_actors} actors with {self.games_per_actor} games for {len(self.tasks)} tasks, "
                "want at least one game a task"
            )
        if self.num_lanes > 2**16:
            raise ConfigError(f"actors: got {self.num_lanes} games, want at most {2**16} (a lane is a u16)")

    @property
    def num_lanes(self) -> int:
        return self.num_actors * self.games_per_actor

    @property
    def ring_capacity(self) -> int:
        """Records of a ring: a whole number of an actor's steps, at least two, each of one record a game."""
        num_steps = max(2, -(-self.actors.ring_capacity // self.games_per_actor))
        return num_steps * self.games_per_actor

    def shared_memory_bytes(self) -> int:
        """Shared memory of an `ActorPool`: rings and parameter queue."""
        rings = self.num_actors * ring_bytes(self.ring_capacity, self.frame_shape)
        return rings + (broadcast_bytes(self.num_params) if self.policy else 0)

    def actor_specs(self, first_episodes: list[int]) -> list[ActorSpec]:
        """One spec an actor. `first_episodes` has an entry a lane."""
        # to the environment 0 means never, even where only a fresh engine plays an episode the same again
        recycle_episodes = None if self.actors.recycle_episodes == 0 else self.actors.recycle_episodes
        specs = []
        for actor in range(self.num_actors):
            lanes = list(range(actor * self.games_per_actor, (actor + 1) * self.games_per_actor))
            specs.append(
                ActorSpec(
                    actor=actor,
                    lanes=lanes,
                    lane_tasks=[lane % len(self.tasks) for lane in lanes],
                    tasks=list(self.tasks),
                    first_episodes=[first_episodes[lane] for lane in lanes],
                    seed=self.seed,
                    env_entry_point=self.env_entry_point,
                    env_config={**self.env_config, "recycle_episodes": recycle_episodes},
                    frame_shape=list(self.frame_shape),
                    stack_size=self.stack_size,
                    num_actions=self.num_actions,
                    policy=self.policy,
                    ring_capacity=self.ring_capacity,
                    num_params=self.num_params,
                    layout_hash=self.layout_hash,
                    work_dir=str(self.work_dir.absolute()),
                )
            )
        return specs


@dataclass(frozen=True, kw_only=True, slots=True)
class PoolStatistics:
    """Counters since the pool was made."""

    env_steps: int
    """records drained that hold a decision (all but an episode's last)"""
    episodes: int
    restarts: int
    actors_ready: int
    """actors that have started all their games and live"""
    waited_for_space_s: float
    """seconds actors waited for the learner to read, summed over actors"""
    waited_for_records_s: float
    """seconds the learner waited in `drain`"""


class ActorPool:
    """Actors in processes of their own. Use as a context manager, or `close` it."""

    def __init__(self, config: PoolConfig, state: dict[str, Any] | None = None):
        """Makes the segments and starts the processes; does not wait for them.

        Args:
            config: what to play.
            state: what `state()` returned in the run that is resumed.

        Raises:
            ResourceError: there is not enough memory.
            ResumeError: `state` is of a pool of another size.
        """
        specs = config.actor_specs(episodes_to_begin_with(config, state))
        self._config = config
        self._min_drain_records = max(1, int(_MIN_DRAIN_SHARE * config.num_actors * config.ring_capacity))
        self._actors: list[SupervisedActor] = []
        self._params: BroadcastWriter | None = None
        self._polled_at = time.monotonic()
        self._env_steps = self._episodes = 0
        self._waited_s = 0.0
        try:
            if config.policy:
                self._params = BroadcastWriter.create("gvz-params", config.num_params, config.layout_hash)
            for spec in specs:
                self._actors.append(SupervisedActor(spec, config.actors, self._params))
            for actor in self._actors:
                actor.start()
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "ActorPool":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def publish(self, params: np.ndarray, header: ParamsHeader) -> None:
        """Gives the actors `params` float32[P] to act by; they take them before their next step. Never waits."""
        if self._params is not None:
            self._params.publish(params, header)

    def drain(self, max_records: int, wait_s: float = 0.0) -> list[StepBlock]:
        """Takes up to `max_records` records, an equal share from every actor as far as it has them.

        Args:
            max_records: bound on the sum of the blocks' lengths.
            wait_s: how long to wait for a worthwhile number; the time is counted, the result may be empty.

        Raises:
            TransportError: a record was lost, repeated or torn.
        """
        start = time.monotonic()
        worthwhile = min(max_records, self._min_drain_records)
        while self._num_unread() < worthwhile and time.monotonic() - start < wait_s:
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

    def _num_unread(self) -> int:
        return sum(actor.ring.num_unread for actor in self._actors)

    def poll(self) -> list[Message]:
        """Watches the actors and returns what they said: episodes, faults, Ready. Never waits long.

        Dead and stuck actors are replaced; what they published stays in the ring, and their games go on with new
        episodes.

        Raises:
            WorkerError: an actor failed more often than its budget allows. What it said last came with the poll before.
        """
        for actor in self._actors:
            if actor.failure is not None:
                raise actor.failure
        now = time.monotonic()
        # our own sleep is not the actors' silence: a learner that compiled for a minute has not watched for a minute
        watched_s = min(now - self._polled_at, self._config.actors.heartbeat_timeout_s / 4)
        self._polled_at = now
        messages = [message for actor in self._actors for message in actor.watch(now, watched_s)]
        self._episodes += sum(isinstance(message, EpisodeStats) for message in messages)
        return messages

    def state(self) -> dict[str, Any]:
        """What the pool of a resumed run begins with: lanes go on with new episodes."""
        for actor in self._actors:
            actor.track_unread()
        return {"next_episodes": [episode for actor in self._actors for episode in actor.next_episodes]}

    def statistics(self) -> PoolStatistics:
        """Counters for the log."""
        return PoolStatistics(
            env_steps=self._env_steps,
            episodes=self._episodes,
            restarts=sum(actor.restarts for actor in self._actors),
            actors_ready=sum(actor.ready for actor in self._actors),
            waited_for_space_s=sum(status.waited_for_space_s for status in self.writer_statuses()),
            waited_for_records_s=self._waited_s,
        )

    def writer_statuses(self) -> list[WriterStatus]:
        """What each actor is at, in order."""
        return [actor.ring.writer_status() for actor in self._actors]

    def close(self, *, grace_s: float = STOP_TIMEOUT_S) -> None:
        """Ends every process and frees the shared memory. Can be repeated.

        Args:
            grace_s: how long actors may take over their last step, and as long again over SIGTERM before SIGKILL.
        """
        processes = [actor.process for actor in self._actors if actor.process is not None]
        try:
            for process in processes:
                process.ask_to_stop()
            deadline = time.monotonic() + grace_s
            for process in processes:
                process.wait(max(0.0, deadline - time.monotonic()))
        finally:  # also when a second Ctrl-C ends the wait
            deadline = time.monotonic() + grace_s
            for process in processes:
                process.end(grace_s=max(0.0, deadline - time.monotonic()))
            for actor in self._actors:
                actor.process = None
                actor.ring.close()
            if self._params is not None:
                self._params.close()
            janitor.clean_dead_instances()


def episodes_to_begin_with(config: PoolConfig, state: dict[str, Any] | None) -> list[int]:
    """Number of the first episode of every lane.

    Raises:
        ResumeError: `state` is of another number of lanes.
    """
    episodes = [0] * config.num_lanes if state is None else list(state["next_episodes"])
    if len(episodes) != config.num_lanes:
        raise ResumeError(
            f"state of the actor pool: got {len(episodes)} lanes, want {config.num_lanes} "
            f"({config.num_actors} actors with {config.games_per_actor} games)"
        )
    return episodes


def num_decisions(steps: np.ndarray) -> int:
    """Records of STEP_DTYPE[N] that hold a decision: all but the last of an episode."""
    return int(np.count_nonzero((steps["terminated"] | steps["truncated"]) == 0))
