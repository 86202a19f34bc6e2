"""The observations of many games in one piece of shared memory.

Layout of the payload: a counter u64 for each worker, then for each part of the observation uint8[2, N, H, W, C], then,
if games begin their next episode within the step that ends one, uint8[N, H, W, C] for the last observations.

There are two halves, and a game's observations go into them in turn. So the last observation is whole while the next
one is being written, also if the writer is killed in the middle.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from gymnasium.spaces import Dict

from gvz.core.env_config import EnvConfig
from gvz.observation import Observation, observation_space
from gvz.transport.segment import Segment, aligned, hash_layout

_SCREEN = "screen"


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameLayout:
    """Sizes of the shared memory, on which the environment and its workers agree."""

    env: EnvConfig
    num_envs: int
    num_workers: int
    same_step: bool
    """there are last observations, too"""

    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Part of an observation -> (H, W, C)."""
        space = observation_space(self.env)
        parts = dict(space.spaces) if isinstance(space, Dict) else {_SCREEN: space}
        return {name: part.shape for name, part in parts.items() if part.shape is not None}

    def num_bytes(self) -> int:
        """Size of the payload."""
        rows = [2 * self.num_envs] + [self.num_envs] * self.same_step
        arrays = [aligned(count * math.prod(shape)) for count in rows for shape in self.shapes().values()]
        return aligned(8 * self.num_workers) + sum(arrays)

    def hash(self) -> int:
        """u64"""
        return hash_layout("vector", self.shapes(), self.num_envs, self.num_workers, self.same_step)


class Frames:
    """The arrays, in the environment's process or in a worker's.

    Attributes:
        halves: part of the observation -> uint8[2, N, H, W, C].
        final: part -> uint8[N, H, W, C], the last observation of an episode; empty if the layout has none.
        progress: u64[workers], counts what each worker has done.
    """

    def __init__(self, segment: Segment, layout: FrameLayout):
        """`create` and `attach` call this."""
        self._segment = segment
        self._single = not layout.env.buffers
        self._offset = 0
        self.progress = self._take(np.uint64, layout.num_workers)
        shapes = layout.shapes().items()
        self.halves = {name: self._take(np.uint8, 2, layout.num_envs, *shape) for name, shape in shapes}
        self.final = {name: self._take(np.uint8, layout.num_envs, *shape) for name, shape in shapes if layout.same_step}

    @classmethod
    def create(cls, layout: FrameLayout) -> "Frames":
        """Raises ResourceError: there is not enough memory."""
        advice = "lower num_envs or the frame's size"
        frames = cls(Segment.create("gvz-vector", layout.num_bytes(), layout_hash=layout.hash(), advice=advice), layout)
        frames.progress[:] = 0
        return frames

    @classmethod
    def attach(cls, descriptor: int, layout: FrameLayout) -> "Frames":
        """Raises TransportError: the descriptor is not of such memory."""
        return cls(Segment.attach(descriptor, layout.num_bytes(), layout_hash=layout.hash()), layout)

    @property
    def descriptor(self) -> int:
        """File descriptor with which a worker attaches."""
        return self._segment.descriptor

    def write(self, game: int, half: int, observation: Observation) -> None:
        """Puts an observation into a half."""
        for name, part in self._parts(observation).items():
            self.halves[name][half, game] = part

    def write_final(self, game: int, observation: Observation) -> None:
        """Keeps the last observation of an episode."""
        for name, part in self._parts(observation).items():
            self.final[name][game] = part

    def repeat(self, game: int, half: int) -> None:
        """The other half's observation into this half, too."""
        for part in self.halves.values():
            part[half, game] = part[1 - half, game]

    def repeat_final(self, game: int, half: int) -> None:
        """The observation in this half is the last of its episode."""
        for name, part in self.halves.items():
            self.final[name][game] = part[half, game]

    def copy(self, games: np.ndarray, halves: np.ndarray) -> Observation:
        """Copies of the observations of some games, uint8[B, H, W, C]; `halves` int[B] says where each one is."""
        return self._observation({name: part[halves, games] for name, part in self.halves.items()})

    def view(self, half: int) -> Observation:
        """A half itself, uint8[N, H, W, C]."""
        return self._observation({name: part[half] for name, part in self.halves.items()})

    def final_copy(self, game: int) -> Observation:
        """A copy of the last observation of an episode, uint8[H, W, C]."""
        return self._observation({name: part[game].copy() for name, part in self.final.items()})

    def close(self) -> None:
        """Releases the memory; views of it keep it. Can be repeated."""
        self.halves, self.final, self.progress = {}, {}, np.empty(0, np.uint64)
        self._segment.close()

    def _take(self, dtype: type[np.generic], *shape: int) -> np.ndarray:
        """The next array of the payload."""
        array = np.frombuffer(self._segment.payload, dtype, math.prod(shape), self._offset).reshape(shape)
        self._offset += aligned(array.nbytes)
        return array

    def _parts(self, observation: Observation) -> Mapping[str, np.ndarray]:
        return observation if isinstance(observation, dict) else {_SCREEN: observation}

    def _observation(self, parts: dict[str, np.ndarray]) -> Observation:
        return parts[_SCREEN] if self._single else parts
