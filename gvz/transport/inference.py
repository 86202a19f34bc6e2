"""Requests for actions: one actor shows its games' observations in shared memory, the learner's process answers.

Layout of the payload: control words, then an array for each part of the observation, a row a game, then the answer,
int32[G] actions and float32[G, E] extras.

The actor numbers its requests. It changes nothing from `ask` on until the answer has the same number. The successor of
a dead actor asks with the next number, so that an answer to its predecessor is none to it.
"""

import time
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from gvz.core.errors import WaitTimeoutError
from gvz.core.watchdog import AwakeClock
from gvz.transport.segment import Fence, Segment, aligned, hash_layout

# u64 control words; the actor's and the learner's are in separate cache lines
_REQUESTED, _ANSWERED, _VERSION, _NUM_WORDS = 0, 8, 9, 16
_FIRST_SLEEP_S, _LONGEST_SLEEP_S = 20e-6, 1e-3


class Answer(NamedTuple):
    """What the games of an actor do next."""

    action: np.ndarray
    """int32[G]"""
    extras: np.ndarray
    """float32[G, E], what the learner wants recorded with each action"""
    params_version: int
    """of the parameters that chose the actions"""


class _Requests:
    """The mapped arrays of both ends.

    Attributes:
        observation: the parts of the observation by name, a row a game.
    """

    def __init__(self, segment: Segment, observation: Mapping[str, np.ndarray], num_extras: int):
        self._segment = segment
        self._words = segment.payload[: 8 * _NUM_WORDS].cast("Q")
        arrays, _ = _arrays(observation, num_extras)
        views = {
            name: np.frombuffer(segment.payload, array.dtype, array.size, start).reshape(array.shape)
            for name, (start, array) in arrays.items()
        }
        self._action, self._extras = views.pop("answer.action"), views.pop("answer.extras")
        self.observation = views
        self._fence = Fence()

    def close(self) -> None:
        """Releases the memory; views of it keep it. Can be repeated."""
        self._words = memoryview(bytearray(8 * _NUM_WORDS)).cast("Q")
        self.observation = {}
        self._action, self._extras = np.empty(0, np.int32), np.empty((0, 0), np.float32)
        self._segment.close()


class RequestReader(_Requests):
    """The learner's end, which makes the memory and outlives the actor's processes."""

    @classmethod
    def create(cls, name: str, observation: Mapping[str, np.ndarray], num_extras: int) -> "RequestReader":
        """Makes the memory for observations of these shapes and dtypes; nothing is asked yet.

        Raises:
            ResourceError: there is not enough memory.
        """
        num_bytes = request_bytes(observation, num_extras)
        segment = Segment.create(name, num_bytes, layout_hash=_layout_hash(observation, num_extras))
        requests = cls(segment, observation, num_extras)
        for index in range(_NUM_WORDS):
            requests._words[index] = 0
        return requests

    @property
    def descriptor(self) -> int:
        """File descriptor with which another process attaches its `RequestWriter`."""
        return self._segment.descriptor

    def pending(self) -> int | None:
        """The number of the request that has no answer yet, if there is one: its observations are complete."""
        number = self._words[_REQUESTED]
        self._fence()
        return None if number == self._words[_ANSWERED] else number

    def answer(self, number: int, answer: Answer) -> None:
        """Answers the request with this number."""
        self._action[:], self._extras[:] = answer.action, answer.extras
        self._words[_VERSION] = answer.params_version
        self._fence()
        self._words[_ANSWERED] = number


class RequestWriter(_Requests):
    """The actor's end."""

    @classmethod
    def attach(cls, descriptor: int, observation: Mapping[str, np.ndarray], num_extras: int) -> "RequestWriter":
        """Becomes the one that asks; goes on after the last request of a predecessor.

        Raises:
            TransportError: the descriptor does not belong to such memory, or its observations have other shapes.
        """
        num_bytes = request_bytes(observation, num_extras)
        segment = Segment.attach(descriptor, num_bytes, layout_hash=_layout_hash(observation, num_extras))
        return cls(segment, observation, num_extras)

    def ask(self) -> None:
        """Asks for actions: `observation` is complete, and nobody changes it before the answer."""
        self._fence()
        self._words[_REQUESTED] = (self._words[_REQUESTED] + 1) % 2**64

    def wait(self, timeout_s: float, *, beat: Callable[[], None], cancelled: Callable[[], bool]) -> bool:
        """Waits for the answer, with a heartbeat. Time in which this process was stopped does not count.

        Returns:
            False if `cancelled()` became true first.

        Raises:
            WaitTimeoutError: there was no answer in time.
        """
        clock, sleep_s = AwakeClock(), _FIRST_SLEEP_S
        while not (answered := self._words[_ANSWERED] == self._words[_REQUESTED]) and not cancelled():
            beat()
            time.sleep(sleep_s)
            sleep_s = min(2 * sleep_s, _LONGEST_SLEEP_S)
            if clock.look() > timeout_s:
                raise WaitTimeoutError(
                    f"{self._segment.name}: the actor waited {timeout_s:.0f} s for the learner to choose its actions"
                )
        return answered

    def answer(self) -> Answer:
        """A copy of the answer to the last request, which `wait` has seen."""
        self._fence()
        return Answer(self._action.copy(), self._extras.copy(), self._words[_VERSION])


def request_bytes(observation: Mapping[str, np.ndarray], num_extras: int) -> int:
    """Bytes of shared memory for observations of these shapes, without the segment's header."""
    return _arrays(observation, num_extras)[1]


def _arrays(observation: Mapping[str, np.ndarray], num_extras: int) -> tuple[dict[str, tuple[int, np.ndarray]], int]:
    """Offset in the payload and example of every array, and the offset of the end, bytes."""
    num_games = len(next(iter(observation.values())))
    answer = {
        "answer.action": np.empty(num_games, np.int32),
        "answer.extras": np.empty((num_games, num_extras), np.float32),
    }
    found, offset = {}, aligned(8 * _NUM_WORDS)
    for name, array in {**observation, **answer}.items():
        found[name] = (offset, array)
        offset += aligned(array.nbytes)
    return found, offset


def _layout_hash(observation: Mapping[str, np.ndarray], num_extras: int) -> int:
    shapes = [(name, array.dtype.str, array.shape) for name, array in observation.items()]
    return hash_layout("requests", shapes, num_extras)
