"""Slow, plain oracles of the replay: whole streams in Python lists, float64, no arithmetic shared with the code."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from gvz.transport.messages import STEP_DTYPE, StepBlock
from learner.replay import ReplaySpec


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

    @property
    def last(self) -> bool:
        return self.terminated or self.truncated


@dataclass
class Expected:
    """The transition of one anchor."""

    obs_tm1: np.ndarray
    a_tm1: int
    r_t: float
    discount_t: float
    obs_t: np.ndarray
    task: int


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
                oldest_frame = max(self.episode_start(lane, t), t - self.spec.stack_size + 1)
                if oldest_frame >= oldest and self.window(lane, t) is not None:
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
            obs_tm1=stream[t].observation,
            a_tm1=stream[t].action,
            r_t=sum(self.spec.discount**k * stream[t + 1 + k].reward for k in range(m)),
            discount_t=0.0 if stream[t + m].terminated else self.spec.discount**m,
            obs_t=stream[t + m].observation,
            task=stream[t].task,
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
        task = int(rng.integers(spec.num_tasks))
        num_steps = int(rng.geometric(1 / mean_steps)) - 1
        end = rng.choice(["terminated", "truncated", "both", "cut"])
        for t in range(num_steps + 1):
            frame = rng.integers(0, 256, spec.frame_shape, dtype=np.uint8)
            stack.extend([frame] * (1 if t else spec.stack_size))
            is_last = t == num_steps and end != "cut"
            yield Record(
                frame=frame,
                observation=np.concatenate(stack, axis=-1),
                action=0 if is_last else int(rng.integers(100)),
                reward=0.0 if t == 0 else float(np.float32(rng.normal())),
                lane=lane,
                task=task,
                episode=episode,
                first=t == 0,
                terminated=is_last and end in ("terminated", "both"),
                truncated=is_last and end in ("truncated", "both"),
            )
        episode += 1


def step_block(records: list[Record], *, sequence: int = 0) -> StepBlock:
    """The records as a ring would hand them over."""
    steps = np.zeros(len(records), STEP_DTYPE)
    for name in STEP_DTYPE.names or ():
        if name not in ("sequence", "pad"):
            steps[name] = [getattr(record, name) for record in records]
    steps["sequence"] = sequence + np.arange(len(records))
    return StepBlock(steps=steps, frames=np.stack([record.frame for record in records]))
