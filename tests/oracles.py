"""Slow, plain oracles of the replay: whole streams in Python lists, float64, no arithmetic shared with the code."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from gvz.transport.messages import StepBlock, step_dtype
from learner.replay import ReplaySpec, Transitions


@dataclass
class Record:
    """A step record, and the observation that the actor acted on when it wrote it."""

    frame: np.ndarray
    observation: np.ndarray
    action: int
    reward: float
    lane: int
    task: int
    episode: int
    first: bool
    terminated: bool
    truncated: bool
    params_version: int = 0
    vector: tuple[float, ...] = ()
    extras: tuple[float, ...] = ()
    sight: tuple[int, ...] = ()
    past_actions: tuple[int, ...] = ()
    """oldest first"""

    @property
    def last(self) -> bool:
        return self.terminated or self.truncated


@dataclass
class Expected:
    """The transition of one anchor; what was observed is that of the records."""

    record_tm1: Record
    r_t: float
    discount_t: float
    record_t: Record


class ReplayOracle:
    """Every record of every lane since the beginning; each question is answered by walking the stream."""

    def __init__(self, spec: ReplaySpec):
        self.spec = spec
        self.streams: list[list[Record]] = [[] for _ in range(spec.num_lanes)]
        self.completed: list[int] = []
        """slots of all transitions in the order they became complete"""
        self._known: set[tuple[int, int]] = set()

    def add(self, record: Record) -> None:
        stream = self.streams[record.lane]
        if record.first and stream and not stream[-1].last:
            stream[-1].truncated = True
            self._note_completed(record.lane)
        stream.append(replace(record))  # a copy: what the stream learns later must not reach the replay
        self._note_completed(record.lane)

    def window(self, lane: int, t: int) -> int | None:
        """Length of the complete window of the anchor at index t of a lane's stream; None if there is none."""
        stream = self.streams[lane]
        if stream[t].last:
            return None
        for m in range(1, self.spec.n_steps + 1):
            if t + m == len(stream):
                return None
            if stream[t + m].last:
                return m
        return self.spec.n_steps

    def episode_start(self, lane: int, t: int) -> int:
        while not self.streams[lane][t].first:
            t -= 1
        return t

    def drawable(self) -> set[int]:
        """The slots of all transitions that are complete and still stored."""
        found = set()
        L = self.spec.lane_capacity
        for lane, stream in enumerate(self.streams):
            oldest = max(0, len(stream) - L)
            for t in range(oldest, len(stream)):
                records = max(self.spec.stack_size, self.spec.num_past_actions + 1)
                oldest_read = max(self.episode_start(lane, t), t - records + 1)
                if oldest_read >= oldest and self.window(lane, t) is not None:
                    found.add(lane * L + t % L)
        return found

    def transition(self, slot: int) -> Expected:
        """What the newest record in a slot is the anchor of."""
        lane, position = divmod(slot, self.spec.lane_capacity)
        stream = self.streams[lane]
        t = len(stream) - 1
        while t % self.spec.lane_capacity != position:
            t -= 1
        m = self.window(lane, t)
        assert m is not None, f"slot {slot} holds no complete transition"
        return Expected(
            record_tm1=stream[t],
            r_t=sum(self.spec.discount**k * stream[t + 1 + k].reward for k in range(m)),
            discount_t=0.0 if stream[t + m].terminated else self.spec.discount**m,
            record_t=stream[t + m],
        )

    def _note_completed(self, lane: int) -> None:
        length = len(self.streams[lane])
        for t in range(max(0, length - self.spec.n_steps - 1), length):
            if (lane, t) not in self._known and self.window(lane, t) is not None:
                self._known.add((lane, t))
                self.completed.append(lane * self.spec.lane_capacity + t % self.spec.lane_capacity)


def play(rng: np.random.Generator, spec: ReplaySpec, lane: int, *, mean_steps: float) -> Iterator[Record]:
    """One lane's endless stream of random episodes, with the stack an actor keeps.

    Episodes terminate, time out, do both at once, or are cut without a last record; some are cut at once. Every
    episode is of another task.
    """
    episode = 0
    while True:
        stack: deque[np.ndarray] = deque(maxlen=spec.stack_size)
        past = [-1] * spec.num_past_actions
        task = int(rng.integers(spec.num_tasks))
        num_steps = int(rng.geometric(1 / mean_steps)) - 1
        end = rng.choice(["terminated", "truncated", "both", "cut"])
        for t in range(num_steps + 1):
            frame = rng.integers(0, 256, spec.frame_shape, dtype=np.uint8)
            stack.extend([frame] * (1 if t else spec.stack_size))
            is_last = t == num_steps and end != "cut"
            action = 0 if is_last else int(rng.integers(100))
            yield Record(
                frame=frame,
                observation=np.concatenate(stack, axis=-1),
                action=action,
                reward=0.0 if t == 0 else float(np.float32(rng.normal())),
                lane=lane,
                task=task,
                episode=episode,
                first=t == 0,
                terminated=is_last and end in ("terminated", "both"),
                truncated=is_last and end in ("truncated", "both"),
                vector=tuple(np.float32(rng.normal(size=spec.num_variables)).tolist()),
                extras=tuple(np.float32(rng.normal(size=spec.num_extras)).tolist()),
                sight=tuple(rng.integers(0, 2, spec.num_sights).tolist()),
                past_actions=tuple(past),
            )
            past = [*past, action][1:] if past else past
        episode += 1


def check_batch(batch: Transitions, want: list[Expected]) -> None:
    """Asserts that a batch holds these transitions."""
    for observed, records in (
        (batch.obs_tm1, [one.record_tm1 for one in want]),
        (batch.obs_t, [one.record_t for one in want]),
    ):
        np.testing.assert_array_equal(observed.frames, [record.observation for record in records])
        np.testing.assert_array_equal(observed.vector, np.float32([record.vector for record in records]))
        np.testing.assert_array_equal(observed.actions, np.array([record.past_actions for record in records], int))
        np.testing.assert_array_equal(observed.task, [record.task for record in records])
    if not want[0].record_tm1.sight:
        assert batch.sight_tm1 is None
    else:
        np.testing.assert_array_equal(batch.sight_tm1, [one.record_tm1.sight for one in want])
    np.testing.assert_array_equal(batch.a_tm1, [one.record_tm1.action for one in want])
    np.testing.assert_array_equal(batch.discount_t, np.float32([one.discount_t for one in want]))
    np.testing.assert_allclose(batch.r_t, [one.r_t for one in want], rtol=1e-5, atol=1e-6)


def step_block(records: list[Record], *, sequence: int = 0) -> StepBlock:
    """The records as a ring would hand them over."""
    steps = np.zeros(len(records), step_dtype(len(records[0].vector), len(records[0].extras), len(records[0].sight)))
    for name in steps.dtype.names or ():
        if name not in ("sequence", "pad"):
            steps[name] = [getattr(record, name) for record in records]
    steps["sequence"] = sequence + np.arange(len(records))
    return StepBlock(steps=steps, frames=np.stack([record.frame for record in records]))
