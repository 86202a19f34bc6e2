"""Rollouts: the lanes' streams cut into windows of T steps, in the order in which they are complete.

A window is T + 1 records of one lane in a row, with the records before them that its first observation reads. The last
record of a window is the first of the lane's next one: it ends step T - 1 there, and begins step 0 here.

A rollout is as many complete windows as the run has lanes, whichever lanes they are of. Where all lanes are played
in step (sync mode, or one actor) it is one window of each. Where actors are faster or slower, a fast lane has more
windows in a rollout, no lane waits for another, and a lane whose actor died holds nobody up.

Windows are gathered in numpy, in the records' own form, and go to the device as a `Store` whose lanes are windows.
"""

import math
from collections import deque
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from gvz.transport.messages import StepBlock, step_dtype
from learner import store
from learner.agents.base import RolloutSteps
from learner.store import Store, StoreSpec


class RolloutSpec(StoreSpec):
    """Sizes of a rollout: a store whose lanes are windows of `history` records and T more."""

    __slots__ = ()

    @property
    def num_steps(self) -> int:
        """T."""
        return self.lane_capacity - self.history

    @property
    def num_windows(self) -> int:
        """Two for each lane: one that is being filled and one that is complete."""
        return 2 * self.num_lanes


class Rollout(NamedTuple):
    """Windows on their way to the device."""

    windows: Store
    """arrays of numpy that nobody writes to again"""
    ages: np.ndarray
    """int64[N]: of every decision of the rollout, how many versions behind the newest its parameters were"""


class Rollouts:
    """Gathers the lanes' windows, at most `num_windows`."""

    def __init__(self, spec: RolloutSpec):
        L, W = spec.num_lanes, spec.lane_capacity
        self._spec, self._begin = spec, spec.history - 1
        self._steps = np.zeros((spec.num_windows, W), step_dtype(spec.num_variables, spec.num_extras))
        self._frames = np.zeros((spec.num_windows, W, *spec.frame_shape), np.uint8)
        self._open, self._fill = list(range(L)), [self._begin] * L
        self._complete, self._free = deque[int](), list(range(L, spec.num_windows))

    def add(self, blocks: Sequence[StepBlock]) -> None:
        """Takes records that `Ingest.check` has passed, at most `num_records_allowed` of them.

        A record that is `first` after one that was not last says that the stream broke off there: the earlier one
        becomes the last of its episode, truncated.
        """
        last_place = self._spec.lane_capacity - 1
        for block in blocks:
            steps = block.steps.copy()
            steps["sequence"] = 0  # the ring's own count, which a resumed run begins again
            lanes, firsts = steps["lane"].tolist(), steps["first"].tolist()
            for i, (lane, first) in enumerate(zip(lanes, firsts, strict=True)):
                row, place = self._open[lane], self._fill[lane]
                if first and place > self._begin and not self._steps["terminated"][row, place - 1]:
                    self._steps["truncated"][row, place - 1] = 1
                self._steps[row, place], self._frames[row, place] = steps[i], block.frames[i]
                self._fill[lane] = place + 1
                if place == last_place:
                    self._close(lane)

    def _close(self, lane: int) -> None:
        """The lane's window is complete; the next one begins with its last records."""
        row, new, kept = self._open[lane], self._free.pop(), self._begin + 1
        self._steps[new, :kept], self._frames[new, :kept] = self._steps[row, -kept:], self._frames[row, -kept:]
        self._complete.append(row)
        self._open[lane], self._fill[lane] = new, kept

    @property
    def num_missing(self) -> int:
        """Windows that a rollout still lacks."""
        return self._spec.num_lanes - len(self._complete)

    def num_records_allowed(self) -> int:
        """The fewest records that can complete the rollout: more are not asked for, so none is ever in the way."""
        missing = sorted(min(self._spec.lane_capacity - fill, self._spec.num_steps) for fill in self._fill)
        return sum(missing[: self.num_missing])

    def take(self, params_version: int) -> Rollout:
        """The rollout; its windows are free again.

        Args:
            params_version: the newest that was published.

        Raises:
            ValueError: it is not complete.
        """
        if self.num_missing > 0:
            raise ValueError(f"Rollouts.take: {self.num_missing} of {self._spec.num_lanes} windows are not complete")
        rows = list(self._complete)
        self._complete.clear()
        self._free += rows
        steps, frames = self._steps[rows], self._frames[rows]  # copies
        begun = steps[:, self._begin : -1]
        decisions = begun[(begun["terminated"] | begun["truncated"]) == 0]
        return Rollout(
            self._store(steps.ravel(), frames), params_version - decisions["params_version"].astype(np.int64)
        )

    def _store(self, steps: np.ndarray, frames: np.ndarray) -> Store:
        terminated = steps["terminated"] != 0
        fields: dict[str, Any] = {
            "frames": frames.reshape(len(steps), -1),
            "action": steps["action"].astype(np.int32),
            "reward": steps["reward"].astype(np.float32),
            "task": steps["task"].astype(np.int32),
            "first": steps["first"] != 0,
            "last": terminated | (steps["truncated"] != 0),
            "terminated": terminated,
            "vector": steps["vector"].copy(),
            "extras": steps["extras"].copy(),
            "heads": np.zeros(self._spec.num_lanes, np.int32),
        }
        return Store(**fields)

    def fill_share(self) -> float:
        """Share of the windows' slots that hold records."""
        num_records = sum(self._fill) + len(self._complete) * self._spec.lane_capacity
        return num_records / (self._spec.num_windows * self._spec.lane_capacity)

    def arrays(self) -> dict[str, np.ndarray]:
        """All records, for a checkpoint; views."""
        raw = np.ascontiguousarray(self._steps).view(np.uint8)
        return {"steps": raw.reshape(*self._steps.shape, -1), "frames": self._frames}

    def state(self) -> dict[str, Any]:
        """Where they belong, for a checkpoint."""
        return {
            "open": list(self._open),
            "fill": list(self._fill),
            "complete": list(self._complete),
            "free": list(self._free),
        }

    def restore(self, arrays: dict[str, np.ndarray], state: dict[str, Any]) -> None:
        """Goes on from what `arrays` and `state` gave."""
        for name, mine in self.arrays().items():
            mine[...] = arrays[name]
        self._open, self._fill = list(state["open"]), list(state["fill"])
        self._complete, self._free = deque(state["complete"]), list(state["free"])


def array_shapes(spec: RolloutSpec) -> dict[str, jax.ShapeDtypeStruct]:
    """Shapes and dtypes of `Rollouts.arrays()`; allocates nothing."""
    slots = (spec.num_windows, spec.lane_capacity)
    record_bytes = step_dtype(spec.num_variables, spec.num_extras).itemsize
    return {
        "steps": jax.ShapeDtypeStruct((*slots, record_bytes), np.uint8),
        "frames": jax.ShapeDtypeStruct((*slots, *spec.frame_shape), np.uint8),
    }


def memory_bytes(spec: RolloutSpec) -> int:
    """Bytes of all windows; allocates nothing."""
    return sum(math.prod(array.shape) for array in array_shapes(spec).values())


def steps_of(spec: RolloutSpec, windows: Store) -> tuple[RolloutSteps, Int[Array, "T B"]]:
    """The steps of a rollout, and the slots of the records where they begin."""
    first_slot = jnp.arange(spec.num_lanes) * spec.lane_capacity + spec.history - 1
    slots = first_slot[None, :] + jnp.arange(spec.num_steps + 1)[:, None]  # [T + 1, B]
    extras, terminated = jnp.asarray(windows.extras)[slots], windows.terminated[slots[1:]]
    steps = RolloutSteps(
        r_t=store.rewards(spec, windows, slots[1:]),
        terminated=terminated,
        truncated=windows.last[slots[1:]] & ~terminated,
        extras_tm1=extras[:-1],
        extras_t=extras[1:],
    )
    return steps, slots[:-1]
