"""One actor over the lives of its processes: watched, ended when stuck, replaced within a budget."""

from collections import deque

import msgspec
import numpy as np

from actors.config import ActorsConfig
from actors.preprocess import ObservationBatch
from actors.process import log_path, start_actor
from gvz.core import janitor, records
from gvz.core.errors import TransportError, WorkerError
from gvz.transport.broadcast import BroadcastWriter
from gvz.transport.child import ChildProcess
from gvz.transport.inference import RequestReader
from gvz.transport.messages import ActorSpec, Assign, EpisodeStats, Fault, Message, Ready
from gvz.transport.ring import RingReader, WriterState

_DUMP_S = 0.5
"""time given to a stuck actor to write its stacks before it is killed"""
_STABLE_S = 10.0
"""an actor that has played for this time is restarted soon; others wait longer each time"""
_LOG_TAIL_BYTES = 4000
_FIRST_BACKOFF_S, _LONGEST_BACKOFF_S = 0.25, 15.0


class SupervisedActor:
    """An actor as the pool knows it. Its ring outlives its processes; each process goes on where the last published.

    Attributes:
        ring: the reading end of its ring.
        requests: the end that answers its requests for actions; None if it acts by itself.
        process: its present process; None while it waits to be started.
        next_episodes: per game, one more than the largest episode number seen.
        ready: its present process has started all its games.
        restarts: processes that were replaced.
        failure: why no process will follow the last one; None while all is well.
    """

    def __init__(self, spec: ActorSpec, limits: ActorsConfig, params: BroadcastWriter | None):
        """`params` is the queue that the actor takes its parameters from; None if it needs none."""
        name = f"gvz-ring-{spec.actor}"
        self.ring = RingReader.create(name, spec.ring_capacity, spec.frame_shape, spec.record_dtype)
        self.requests: RequestReader | None = None
        if spec.inference == "device":
            observation = ObservationBatch.of(spec, len(spec.lanes)).arrays
            self.requests = RequestReader.create(f"gvz-requests-{spec.actor}", observation, spec.num_extras)
        self.process: ChildProcess | None = None
        self.next_episodes = list(spec.first_episodes)
        self.restarts = 0
        self.failure: WorkerError | None = None
        self._spec = spec
        self._limits = limits
        self._shared = params if self.requests is None else self.requests
        self._start_at = 0.0
        self._ready_at: float | None = None
        self._silent_s = 0.0  # without a sign of life (or, before Ready, since the start) while we watched
        self._heartbeat_ns = 0
        self._kill_at: float | None = None  # set when it is stuck and was asked for its stacks
        self._ended_at: deque[float] = deque()  # ends of its processes that count
        self._backoff_s = _FIRST_BACKOFF_S  # before the last start

    @property
    def ready(self) -> bool:
        return self.process is not None and self._ready_at is not None

    def start(self) -> None:
        """Starts a process; does not wait for it."""
        self.process = start_actor(self._spec, self.ring, self._shared)
        self._ready_at, self._kill_at, self._silent_s = None, None, 0.0

    def free(self) -> None:
        """Releases the shared memory; the process has ended. Can be repeated."""
        self.process = None
        self.ring.close()
        if self.requests is not None:
            self.requests.close()

    def assign(self, lane: int, task: int) -> None:
        """The next episodes of a lane are of the task with this index; processes that follow begin with it."""
        tasks = [task if own == lane else old for own, old in zip(self._spec.lanes, self._spec.lane_tasks, strict=True)]
        self._spec = msgspec.structs.replace(self._spec, lane_tasks=tasks)
        if self.process is not None:
            self.process.channel.send(Assign(lane=lane, task=task))

    def watch(self, now: float, watched_s: float) -> list[Message]:
        """Looks after the process once.

        Args:
            now: `time.monotonic()`.
            watched_s: time since the last look that counts as silence if there was no sign of life.

        Returns:
            What the process said, and a Fault if it has ended. If it failed more often than its budget allows, that
            is a fatal one, and `failure` is set.
        """
        if self.process is None:
            return self._start_again(now) if now >= self._start_at and self.failure is None else []
        exit_text = self.process.exit_text()  # first: what it said before its end is then all there
        messages: list[Message] = []
        try:
            received = self.process.channel.receive()
            self._check(received)
            messages += received
        except TransportError as error:  # this actor's stream is corrupt; the others are fine
            exit_text = f"sent what is no message of its own ({error})"
        if any(isinstance(message, Ready) for message in messages):
            self._ready_at, self._silent_s = now, 0.0
        if self._kill_at is not None:
            if exit_text is not None or now >= self._kill_at:
                messages.append(self._replace(now, "stuck", self._silence()))
        elif exit_text is not None:
            messages.append(self._replace(now, "died", exit_text))
        elif self._is_stuck(watched_s):
            self.process.dump_stacks()
            self._kill_at = now + _DUMP_S
        return messages

    def track_episodes(self, steps: np.ndarray) -> None:
        """Keeps track of the episodes that have begun, from records of the ring."""
        for game, lane in enumerate(self._spec.lanes):
            episodes = steps["episode"][steps["lane"] == lane]
            if episodes.size:
                self.next_episodes[game] = max(self.next_episodes[game], int(episodes[-1]) + 1)

    def track_unread(self) -> None:
        """As `track_episodes`, from what is still in the ring."""
        self.track_episodes(self.ring.peek(self.ring.capacity).steps)

    def _check(self, received: list[Message]) -> None:
        """Raises TransportError: an episode of a game that is not this actor's, or of no task of the run."""
        lanes, num_tasks = self._spec.lanes, len(self._spec.tasks)
        for message in received:
            if isinstance(message, EpisodeStats) and not (message.lane in lanes and message.task < num_tasks):
                raise TransportError(
                    f"got an episode of lane {message.lane}, task {message.task}, want one of lanes {lanes} and a task "
                    f"below {num_tasks}"
                )

    def _start_again(self, now: float) -> list[Message]:
        try:
            self.start()
        except OSError as error:  # no room for another process, or it did not take its spec
            return [self._replace(now, "died", f"could not be started ({error})")]
        return []

    def _is_stuck(self, watched_s: float) -> bool:
        status = self.ring.writer_status()
        moved = self.ready and status.heartbeat_ns != self._heartbeat_ns
        self._silent_s = 0.0 if moved else self._silent_s + watched_s
        self._heartbeat_ns = status.heartbeat_ns
        return self._silent_s > getattr(self._limits, self._patience(status.state))

    def _patience(self, state: WriterState) -> str:
        """Which setting bounds its silence: to start an engine takes its time, also in mid-run."""
        acting = self.ready and state != WriterState.RESETTING
        return "heartbeat_timeout_s" if acting else "start_timeout_s"

    def _silence(self) -> str:
        what = "gave no sign of life for" if self.ready else "had not started its games after"
        state = self.ring.writer_status().state
        return f"{what} {self._silent_s:.1f} s (actors.{self._patience(state)}); it was {state.name.lower()}"

    def _replace(self, now: float, kind: str, what: str) -> Fault:
        """Ends what is left of the process and plans the next, if the budget allows."""
        was_ready = self.ready
        stable = was_ready and self._ready_at is not None and now - self._ready_at > _STABLE_S
        process, self.process = self.process, None
        if process is not None:
            process.end(grace_s=0.0)
        log_tail = "\n".join(records.last_lines(log_path(self._spec), _LOG_TAIL_BYTES))
        janitor.clean_dead_instances()
        actor, limits = self._spec.actor, self._limits
        self._ended_at.append(now)
        while was_ready and now - self._ended_at[0] > limits.restart_window_s:  # starts that fail may take as long
            self._ended_at.popleft()
        if len(self._ended_at) > limits.max_restarts:
            within_s = max(limits.restart_window_s, now - self._ended_at[0])
            message = (
                f"actor {actor} {what}; that was end {len(self._ended_at)} within {within_s:.0f} s, "
                f"and actors.max_restarts allows {limits.max_restarts} restarts."
            )
            self.failure = WorkerError(f"{message} The end of {log_path(self._spec)}:\n{log_tail}")
            return Fault(actor=actor, lane=None, kind="gave_up", message=message, traceback=log_tail)
        self._backoff_s = _FIRST_BACKOFF_S if stable else min(2 * self._backoff_s, _LONGEST_BACKOFF_S)
        self._start_at = now + self._backoff_s
        self.restarts += 1
        self._renumber()
        which = f"restart {len(self._ended_at)} of {limits.max_restarts}"
        message = f"actor {actor} {what}; {which} in {self._backoff_s:.2f} s"
        return Fault(actor=actor, lane=None, kind=kind, message=message, traceback=log_tail)

    def _renumber(self) -> None:
        """The next process plays new episodes: also in lanes that have written nothing, for the seed of such an
        episode may be what their engine cannot start with."""
        self.track_unread()
        begun = [first + 1 for first in self._spec.first_episodes]
        self.next_episodes = [max(pair) for pair in zip(self.next_episodes, begun, strict=True)]
        self._spec = msgspec.structs.replace(self._spec, first_episodes=list(self.next_episodes))
