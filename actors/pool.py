"""What a pool of actors is: its configuration, its counters, and what every pool can do."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike

from actors.config import MAX_LANES, ActorsConfig
from actors.preprocess import ObservationBatch
from gvz.core.errors import ConfigError, ResumeError
from gvz.transport.broadcast import broadcast_bytes
from gvz.transport.inference import request_bytes
from gvz.transport.messages import ActorSpec, Message, ParamsHeader, Play, StepBlock
from gvz.transport.ring import ring_bytes

STOP_TIMEOUT_S = 5.0


class PoolConfig(Play, frozen=True, kw_only=True):
    """What a pool plays; its actors' environments get `recycle_episodes`, too.

    Lane i is game i % games_per_actor of actor i // games_per_actor. It plays its first task until
    `Pool.assign` gives it another. A pool may have some of a run's actors only, if other machines have the others.
    """

    first_tasks: tuple[int, ...] = ()
    """indices of the tasks that lanes begin with, in turn; empty: all of them"""
    num_actors: int
    games_per_actor: int
    first_actor: int = 0
    """number of the pool's first actor in the run"""
    run_actors: int | None = None
    """actors of the whole run; default: the pool's"""
    actors: ActorsConfig
    cores: tuple[int | None, ...] = ()
    """the core of each actor and its engines (actors.placement), None: any; empty: any for all"""
    work_dir: Path
    """private directory for logs and the engines' files"""

    def __post_init__(self) -> None:
        run_actors = self.num_actors if self.run_actors is None else self.run_actors
        if self.cores and len(self.cores) != self.num_actors:
            raise ConfigError(f"actors: got cores {self.cores}, want one for each of {self.num_actors} actors, or none")
        if run_actors * self.games_per_actor > MAX_LANES:
            got = run_actors * self.games_per_actor
            raise ConfigError(f"actors: got {got} games, want at most {MAX_LANES} (a lane is a u16)")

    @property
    def num_lanes(self) -> int:
        return self.num_actors * self.games_per_actor

    @property
    def lanes(self) -> range:
        """The lanes that this pool plays, of all lanes of the run."""
        first = self.first_actor * self.games_per_actor
        return range(first, first + self.num_lanes)

    @property
    def ring_capacity(self) -> int:
        """Records of a ring: a whole number of an actor's steps, at least two, each of one record a game."""
        num_steps = max(2, -(-self.actors.ring_capacity // self.games_per_actor))
        return num_steps * self.games_per_actor

    def shared_memory_bytes(self) -> int:
        """Shared memory of a `ProcessPool`: rings, and the parameter queue or the actors' requests."""
        rings = self.num_actors * ring_bytes(self.ring_capacity, self.frame_shape, self.record_dtype)
        if self.actors.inference == "device":
            observation = ObservationBatch.of(self, self.games_per_actor).arrays
            return rings + self.num_actors * request_bytes(observation, self.num_extras)
        return rings + (broadcast_bytes(self.num_params) if self.policy else 0)

    def actor_specs(self, lanes: "LaneState") -> list[ActorSpec]:
        """One spec an actor, whose lanes begin with these episodes and tasks."""
        shared = {name: getattr(self, name) for name in Play.__struct_fields__}
        # to the environment 0 means never, even where only a fresh engine plays an episode the same again
        shared["env_config"] = {**self.env_config, "recycle_episodes": self.actors.recycle_episodes or None}
        specs = []
        for actor in range(self.num_actors):
            own = slice(actor * self.games_per_actor, (actor + 1) * self.games_per_actor)
            specs.append(
                ActorSpec(
                    **shared,
                    actor=self.first_actor + actor,
                    lanes=list(self.lanes[own]),
                    lane_tasks=lanes.tasks[own],
                    first_episodes=lanes.next_episodes[own],
                    ring_capacity=self.ring_capacity,
                    core=self.cores[actor] if self.cores else None,
                    inference=self.actors.inference,
                    work_dir=str(self.work_dir.absolute()),
                )
            )
        return specs


@dataclass(frozen=True, kw_only=True, slots=True)
class PoolStatistics:
    """Counters since the pool was made."""

    env_steps: int
    """records drained that hold a decision (all but an episode's last)"""
    restarts: int
    actors_ready: int
    """actors that have started all their games and live"""
    waited_for_space_s: float
    """seconds actors waited for the learner to read, summed over actors"""
    waited_for_records_s: float
    """seconds the learner waited in `drain`"""
    more: Mapping[str, float] = field(default_factory=dict[str, float])
    """further scalars of this kind of pool, by their name in the records"""


class Pool(Protocol):
    """Games that are played: step records and messages come out, parameters and tasks of lanes go in.

    `actors.process_pool.ProcessPool` plays in processes of its own, `actors.inline.InlinePool` in this one,
    `gvz.cluster.pool.ClusterPool` on other machines. All
    watching happens in `poll`, which the learner calls in every round; a thread there is only to answer actors that ask
    for their actions. Use one as a context manager, or `close` it.
    """

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def publish(self, params: ArrayLike, header: ParamsHeader) -> None:
        """Has the actions of each actor's next steps chosen by `params` float32[P], which nobody may change any more.

        Never waits for an actor. Waits for the device if `params` are on it and the actors need them on the host.
        """
        ...

    def assign(self, lane: int, task: int) -> None:
        """The next episodes of a lane are of the task with this index; the present one ends first."""
        ...

    def drain(self, max_records: int, wait_s: float = 0.0) -> list[StepBlock]:
        """Takes at most `max_records` records.

        Args:
            max_records: bound on the sum of the blocks' lengths.
            wait_s: how long to wait for a worthwhile number; the result may be empty.

        Raises:
            TransportError: a record was lost, repeated or torn.
        """
        ...

    def poll(self) -> list[Message]:
        """Watches the actors and returns what they said since the last call. Never waits long.

        Raises:
            WorkerError: an actor failed more often than its budget allows, or choosing the actors' actions failed.
        """
        ...

    def state(self) -> dict[str, Any]:
        """What the pool of a resumed run begins with: msgpack types."""
        ...

    def statistics(self) -> PoolStatistics:
        """Counters for the log."""
        ...

    def close(self, *, grace_s: float = STOP_TIMEOUT_S) -> None:
        """Ends every game and frees the memory. Can be repeated.

        Args:
            grace_s: how long actors may take over their last step, and as long again over SIGTERM before SIGKILL.
        """
        ...


@dataclass(kw_only=True, slots=True)
class LaneState:
    """What each lane plays next."""

    next_episodes: list[int]
    """number of the lane's next episode"""
    tasks: list[int]
    """task index"""


def lanes_to_begin_with(config: PoolConfig, state: dict[str, Any] | None) -> LaneState:
    """What every lane begins with: its first episode, or where `state` says.

    Raises:
        ResumeError: `state` is of another number of lanes.
    """
    if state is None:
        first = config.first_tasks or tuple(range(len(config.tasks)))
        tasks = [first[lane % len(first)] for lane in config.lanes]
        return LaneState(next_episodes=[0] * config.num_lanes, tasks=tasks)
    lanes = LaneState(next_episodes=list(state["next_episodes"]), tasks=list(state["tasks"]))
    if len(lanes.next_episodes) != config.num_lanes or len(lanes.tasks) != config.num_lanes:
        raise ResumeError(
            f"state of the actor pool: got {len(lanes.next_episodes)} lanes, want {config.num_lanes} "
            f"({config.num_actors} actors with {config.games_per_actor} games)"
        )
    return lanes


def num_decisions(steps: np.ndarray) -> int:
    """Records of STEP_DTYPE[N] that hold a decision: all but the last of an episode."""
    return int(np.count_nonzero((steps["terminated"] | steps["truncated"]) == 0))
