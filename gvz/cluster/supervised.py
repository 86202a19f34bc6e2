"""One host over its incarnations, as the learner knows it: what it plays, owes and has sent."""

import dataclasses
from dataclasses import dataclass, field

import numpy as np

from actors.pool import LaneState, PoolConfig
from gvz.cluster.backend import Remote
from gvz.cluster.config import ClusterConfig
from gvz.cluster.host import HostSpec
from gvz.cluster.wire import Batch, BatchHeader
from gvz.core.errors import TransportError
from gvz.transport.messages import EpisodeStats

_FIRST_BACKOFF_S, _LONGEST_BACKOFF_S = 0.5, 30.0
STABLE_S = 10.0
"""a host that has played for this time was started well"""


@dataclass(kw_only=True, slots=True)
class Incarnation:
    """A life of a host, on one machine."""

    number: int
    machine: str
    name: str
    """of the machine"""
    remote: Remote
    first_episodes: list[int]
    heard_s: float
    """when it last answered, or was first asked"""
    playing_s: float | None = None
    """since when it plays"""
    num_asked: int = 0
    """calls for batches that are under way"""
    next_batch: int = 0
    early: dict[int, Batch] = field(default_factory=dict[int, Batch])
    """number -> batch that came before one with a lower number"""
    params_version: int = -1
    """newest parameters that it was given"""
    taking_params: bool = False
    params_asked_s: float = 0.0
    """when it was last given parameters"""
    newest: BatchHeader | None = None

    def was_stable(self, now_s: float) -> bool:
        """It was started well."""
        return self.playing_s is not None and now_s - self.playing_s > STABLE_S


class SupervisedHost:
    """A host of the run.

    Attributes:
        pool: its actors.
        lanes: what its lanes play next, as far as is known here.
        incarnation: its present life; None while it waits for the next.
        start_at_s: when the next life may begin.
        num_lives: incarnations so far.
        waiting_batches: batches that have come and were not taken by the learner yet.
        assigned: tasks of lanes that are to be sent.
        avoid: the machine where its last life ended.
        waits_for_room: no machine has the cores for its next life.
    """

    def __init__(self, index: int, pool: PoolConfig, lanes: LaneState, config: ClusterConfig):
        self.index, self.pool, self.lanes, self._config = index, pool, lanes, config
        self.incarnation: Incarnation | None = None
        self.start_at_s, self.num_lives, self.waiting_batches = 0.0, 0, 0
        self.assigned: list[tuple[int, int]] = []
        self.avoid, self.waits_for_room = "", False
        self.params_age_s = 0.0
        self.actor_restarts, self.waited_for_space_s = 0, 0.0  # of earlier incarnations
        self._in_episode = np.zeros(len(pool.lanes), bool)
        self._backoff_s = _FIRST_BACKOFF_S

    @property
    def is_playing(self) -> bool:
        return self.incarnation is not None and self.incarnation.playing_s is not None

    @property
    def free_credits(self) -> int:
        """Batches that may be asked for now."""
        life = self.incarnation
        asked = 0 if life is None else life.num_asked + len(life.early)
        return self._config.credits - asked - self.waiting_batches

    def spec(self, run_id: str, incarnation: int) -> HostSpec:
        """What the next incarnation plays."""
        return HostSpec(
            run_id=run_id,
            host=self.index,
            incarnation=incarnation,
            pool=self.pool,
            state=dataclasses.asdict(self.lanes),
            batch_records=self._config.batch_records,
            compress=self._config.compress,
        )

    def assign(self, lane: int, task: int) -> None:
        """The next episodes of a lane are of this task, also of an incarnation to come."""
        self.lanes.tasks[self.pool.lanes.index(lane)] = task
        self.assigned.append((lane, task))

    def in_order(self, batch: Batch, run_id: str) -> list[Batch]:
        """The batches that are to be taken now, the oldest first; answers of calls under way can overtake each other.

        Raises:
            TransportError: it is not of this incarnation, or one before it is lost.
        """
        life, header = self.incarnation, batch.header
        assert life is not None
        got = (header.run_id, header.host, header.incarnation, header.number)
        want = (run_id, self.index, life.number, life.next_batch)
        ahead = header.number - life.next_batch
        if got[:3] != want[:3] or not 0 <= ahead < self._config.credits or (ahead and not life.num_asked):
            raise TransportError(f"got batch {got} (run, host, incarnation, number), want {want}; a batch was lost")
        life.early[header.number] = batch
        found: list[Batch] = []
        while (number := life.next_batch + len(found)) in life.early:
            found.append(life.early.pop(number))
        return found

    def take(self, batch: Batch) -> None:
        """Keeps track of episodes and batches.

        Raises:
            TransportError: it is not of this host's games.
        """
        life, header = self.incarnation, batch.header
        assert life is not None
        self._check(batch)
        life.next_batch += 1
        life.newest = header
        for message in batch.messages:
            if isinstance(message, EpisodeStats):
                self._saw(message.lane - self.pool.lanes.start, message.episode)
        steps = batch.block.steps
        lanes, first = np.unique(steps["lane"], return_index=True)
        last = np.append(first[1:], len(steps)) - 1  # records are sorted by lane
        is_last = (steps["terminated"] | steps["truncated"])[last[: len(lanes)]]
        for lane, at, ended in zip(lanes.tolist(), last.tolist(), is_last.tolist(), strict=False):
            index = lane - self.pool.lanes.start
            self._saw(index, int(steps["episode"][at]))
            self._in_episode[index] = not ended

    def end(self, now_s: float) -> int:
        """Its present life is over; returns how many episodes that cuts. The next one plays new episodes: also in lanes
        that have sent nothing, for the seed of such an episode may be what their engine cannot start with.
        """
        life, self.incarnation = self.incarnation, None
        assert life is not None
        self._backoff_s = _FIRST_BACKOFF_S if life.was_stable(now_s) else min(2 * self._backoff_s, _LONGEST_BACKOFF_S)
        self.start_at_s = now_s + self._backoff_s
        self.avoid = life.machine
        if life.newest is not None:
            self.actor_restarts += life.newest.restarts
            self.waited_for_space_s += life.newest.waited_for_space_s
        if life.playing_s is not None:
            begun = [first + 1 for first in life.first_episodes]
            self.lanes.next_episodes = [max(pair) for pair in zip(self.lanes.next_episodes, begun, strict=True)]
        cut = int(self._in_episode.sum())
        self._in_episode[:] = False
        return cut

    def _saw(self, index: int, episode: int) -> None:
        self.lanes.next_episodes[index] = max(self.lanes.next_episodes[index], episode + 1)

    def _check(self, batch: Batch) -> None:
        """What the learner would take for a damage of its own run."""
        lanes, tasks, steps = self.pool.lanes, len(self.pool.tasks), batch.block.steps
        newest = 0 if self.incarnation is None else max(0, self.incarnation.params_version)
        if len(steps):
            if (got := int(steps["params_version"].max())) > newest:
                raise TransportError(f"got actions of parameters version {got}, but it was given {newest}")
            for name, want in (("lane", lanes), ("task", range(tasks)), ("action", range(self.pool.num_actions))):
                low, high = int(steps[name].min()), int(steps[name].max())
                if not (low in want and high in want):
                    raise TransportError(f"got records of {name} {low}..{high}, want {want.start}..{want.stop - 1}")
            lane_steps = np.diff(steps["lane"].astype(np.int32))
            if (lane_steps < 0).any():
                raise TransportError("got records that are not sorted by lane")
            ended = (steps["terminated"] | steps["truncated"]) != 0
            continues = self._in_episode[steps["lane"] - lanes.start]
            continues[1:] = np.where(lane_steps == 0, ~ended[:-1], continues[1:])
            if (lost := steps["lane"][(steps["first"] == 0) & ~continues]).size:
                raise TransportError(f"got a record of lane {lost[0]} that neither begins an episode nor continues one")
            for name in ("reward", "vector", "extras"):
                if not np.isfinite(steps[name]).all():
                    raise TransportError(f"got a {name} that is not finite")
        for message in batch.messages:
            if isinstance(message, EpisodeStats) and not (message.lane in lanes and message.task < tasks):
                raise TransportError(f"got an episode of lane {message.lane}, task {message.task}")
