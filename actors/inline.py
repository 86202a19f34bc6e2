"""The `Pool` of sync mode: the same acting loop in the learner's own process.

A game is played only inside `drain`, so a run is a function of its seed, and `state` holds all that is needed to go
on bit for bit.
"""

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from actors.loop import ActorLoop
from actors.pool import Pool, PoolConfig, PoolStatistics, lanes_to_begin_with, num_decisions
from gvz.core.errors import ResumeError
from gvz.transport.messages import Message, ParamsHeader, StepBlock, decode, encode
from gvz.transport.ring import RingReader


class InlinePool(Pool):
    """One loop that plays every lane."""

    def __init__(self, config: PoolConfig, state: dict[str, Any] | None = None):
        """Starts every game; `state` is what `state()` returned in the run that is resumed.

        Raises:
            ValueError: more than one actor, or one that would ask for its actions.
            ResumeError: a game does not come to where `state` left it.
        """
        if config.num_actors != 1:
            raise ValueError(f"num_actors: got {config.num_actors}, want 1: inline, all games are one actor's")
        if config.actors.inference != "actors":
            raise ValueError(
                f"actors.inference: got {config.actors.inference!r}, want 'actors': here is no other process"
            )
        (spec,) = config.actor_specs(lanes_to_begin_with(config, None))
        self._messages: list[Message] = []
        self._ring = RingReader.create("gvz-ring-inline", spec.ring_capacity, config.frame_shape, config.record_dtype)
        self._writer = self._ring.writer()
        self._published: tuple[np.ndarray, ParamsHeader] | None = None
        self._rest = StepBlock(np.empty(0, config.record_dtype), np.empty((0, *config.frame_shape), np.uint8))
        """played, but not yet asked for"""
        self._num_games = len(spec.lanes)
        self._needs_params = bool(spec.policy)
        self._env_steps = 0
        self._loop = ActorLoop(spec, self._writer, self._messages.append)
        try:
            if state is None:
                self._loop.begin()
            else:
                self._restore(state)
        except BaseException:
            self.close()
            raise

    def publish(self, params: ArrayLike, header: ParamsHeader) -> None:
        if self._needs_params:
            self._published = (np.array(params), header)
            self._loop.set_params(*self._published)

    def assign(self, lane: int, task: int) -> None:
        self._loop.assign(lane, task)

    def drain(self, max_records: int, wait_s: float = 0.0) -> list[StepBlock]:
        """Plays until there are `max_records` records and returns exactly these; it never waits.

        Raises:
            ValueError: no parameters were published.
        """
        assert wait_s >= 0.0
        if self._needs_params and self._published is None:
            raise ValueError("drain: publish parameters first")
        blocks: list[StepBlock] = []
        while max_records > 0:
            if not len(self._rest):
                while self._ring.num_unread < max_records and self._writer.free >= self._num_games:
                    self._loop.step()
                self._rest = self._ring.read(self._ring.capacity)
            steps, frames = self._rest.steps, self._rest.frames
            blocks.append(StepBlock(steps[:max_records], frames[:max_records]))
            self._rest = StepBlock(steps[max_records:], frames[max_records:])
            self._env_steps += num_decisions(blocks[-1].steps)
            max_records -= len(blocks[-1])
        return blocks

    def poll(self) -> list[Message]:
        messages = list(self._messages)
        self._messages.clear()
        return messages

    def state(self) -> dict[str, Any]:
        """All that a pool of the same configuration needs to go on from here bit for bit, as msgpack types."""
        published = None
        if self._published is not None:
            params, header = self._published
            published = {"params": params.tobytes(), "header": asdict(header)}
        return {
            "loop": self._loop.state(),
            "published": published,
            "rest_steps": self._rest.steps.tobytes(),
            "rest_frames": self._rest.frames.tobytes(),
            "messages": [encode(message) for message in self._messages],
        }

    def statistics(self) -> PoolStatistics:
        return PoolStatistics(
            env_steps=self._env_steps,
            restarts=0,
            actors_ready=1,
            waited_for_space_s=0.0,
            waited_for_records_s=0.0,
        )

    def close(self, *, grace_s: float = 0.0) -> None:
        """Closes every game, now: `grace_s` is for processes, of which there are none. Can be repeated."""
        self._loop.close()
        self._writer.close()
        self._ring.close()

    def _restore(self, state: dict[str, Any]) -> None:
        if (got := len(state["loop"]["games"])) != self._num_games:
            raise ResumeError(f"state of the inline pool: got {got} games, want {self._num_games}")
        self._loop.begin(state["loop"])
        if state["published"] is not None:
            header = ParamsHeader(**state["published"]["header"])
            self.publish(np.frombuffer(state["published"]["params"], np.float32), header)
        steps = np.frombuffer(state["rest_steps"], self._ring.dtype)
        frames = np.frombuffer(state["rest_frames"], np.uint8).reshape(len(steps), *self._ring.frame_shape)
        self._rest = StepBlock(steps, frames)
        self._messages += [decode(data) for data in state["messages"]]
