"""From the actors' blocks to the learner's: checked and counted, for a replay in blocks of one fixed size.

What is handed on stands in fresh memory that nothing writes to again. JAX on a CPU may use an aligned numpy array as
it is, without a copy, and runs behind its caller; a staging buffer filled again with the next records would change the
frames of the last. Fresh memory costs the one copy that joins the blocks anyway, and no waiting.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from gvz.core.errors import TransportError
from gvz.transport.messages import StepBlock, step_dtype
from learner.replay import ReplaySpec
from learner.store import StepArrays, StoreSpec

BLOCK_SIZE = 64
"""records of one `replay.add`, which takes 0.5 ms with frames of 84x84x3 (2026-11-21, 2-core AMD EPYC)"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Staleness:
    """How old the parameters were that chose the actions, in versions behind the newest; all 0 of no decisions."""

    mean: float
    p95: int
    max: int


class Ingest:
    """Packs step records, and counts the decisions in them and the age of the parameters that made these."""

    def __init__(self, spec: StoreSpec, block_size: int = BLOCK_SIZE):
        """Packs `block_size` records at a time, or as many as the replay takes at once if those are fewer."""
        self._spec = spec
        self._block_size = min(block_size, spec.max_block) if isinstance(spec, ReplaySpec) else block_size
        self._dtype = step_dtype(spec.num_variables, spec.num_extras, spec.num_sights)
        self._in_episode = [False] * spec.num_lanes
        self._env_steps = 0
        self._ages: Counter[int] = Counter()

    def arrays(self, blocks: Sequence[StepBlock], params_version: int) -> Iterator[StepArrays]:
        """Yields all records of `blocks`, in order, as padded arrays of one shape.

        Args:
            blocks: from the rings.
            params_version: the newest that was published.

        Raises:
            TransportError: a record does not belong to this run, or does not continue its lane's stream.
        """
        self.check(blocks, params_version)
        size = self._block_size
        num_records = sum(map(len, blocks))
        num_padded = -(-num_records // size) * size
        steps = np.zeros(num_padded, self._dtype)
        frames = np.empty((num_padded, *self._spec.frame_shape), np.uint8)
        end = 0
        for block in blocks:
            start, end = end, end + len(block)
            steps[start:end], frames[start:end] = block.steps, block.frames
        for start in range(0, num_padded, size):
            part = slice(start, start + size)
            yield _step_arrays(steps[part], frames[part], np.array(min(size, num_records - start), np.int32))

    def shards(self, blocks: Sequence[StepBlock], params_version: int, num_shards: int) -> Iterator[StepArrays]:
        """Yields all records as `arrays` does, those of each shard of the lanes apart.

        A shard is `num_lanes / num_shards` lanes in a row, which are counted from its first one. The arrays of all
        shards stand one after another, each padded to the block size: [num_shards * block, ...]; `num_valid` is
        int32[num_shards].
        """
        self.check(blocks, params_version)
        if not blocks:
            return
        size, num_lanes = self._block_size, self._spec.num_lanes // num_shards
        steps = np.concatenate([block.steps for block in blocks])
        frames = np.concatenate([block.frames for block in blocks])
        shard = steps["lane"] // num_lanes
        steps["lane"] %= num_lanes
        of_shard = [np.flatnonzero(shard == d) for d in range(num_shards)]
        for start in range(0, max(map(len, of_shard)), size):
            padded_steps = np.zeros(num_shards * size, self._dtype)
            padded_frames = np.empty((num_shards * size, *self._spec.frame_shape), np.uint8)
            num_valid = np.zeros(num_shards, np.int32)
            for d, all_rows in enumerate(of_shard):
                rows = all_rows[start : start + size]
                place = slice(d * size, d * size + len(rows))
                padded_steps[place], padded_frames[place], num_valid[d] = steps[rows], frames[rows], len(rows)
            yield _step_arrays(padded_steps, padded_frames, num_valid)

    def check(self, blocks: Sequence[StepBlock], params_version: int) -> None:
        """Checks and counts the records of `blocks`, which `arrays` does itself; arguments and errors are the same."""
        for block in blocks:
            self._check(block)
        for block in blocks:
            self._count(block.steps, params_version)

    def take_env_steps(self) -> int:
        """Decisions since the last call: every record but the last of an episode is one."""
        count, self._env_steps = self._env_steps, 0
        return count

    def take_staleness(self) -> Staleness:
        """The distribution of staleness over the decisions since the last call."""
        ages, self._ages = self._ages, Counter()
        num_decisions = ages.total()
        if num_decisions == 0:
            return Staleness(mean=0.0, p95=0, max=0)
        values = sorted(ages)
        up_to = np.cumsum([ages[value] for value in values])
        p95 = values[int(np.searchsorted(up_to, 0.95 * num_decisions))]
        mean = sum(value * count for value, count in ages.items()) / num_decisions
        return Staleness(mean=mean, p95=p95, max=values[-1])

    def state(self) -> list[bool]:
        """What a checkpoint keeps: whether each lane is in the middle of an episode."""
        return list(self._in_episode)

    def restore(self, state: list[bool]) -> None:
        """Goes on from `state`: lanes may continue the episodes they were in."""
        self._in_episode = list(state)

    def _check(self, block: StepBlock) -> None:
        steps, spec = block.steps, self._spec
        if block.frames.dtype != np.uint8 or block.frames.shape[1:] != spec.frame_shape:
            shape = list(block.frames.shape[1:])
            raise TransportError(
                f"ingest: got frames {block.frames.dtype}{shape}, want uint8{list(spec.frame_shape)}; actors and "
                "learner were started with different sizes"
            )
        if steps.dtype != self._dtype:
            raise TransportError(
                f"ingest: got records of {steps.dtype.itemsize} bytes, want {self._dtype.itemsize}; actors and learner "
                "were started with different observations"
            )
        for name, limit in (("lane", spec.num_lanes), ("task", spec.num_tasks)):
            if (wrong := np.flatnonzero(steps[name] >= limit)).size:
                record = steps[wrong[0]]
                raise TransportError(
                    f"ingest: record {record['sequence']}: got {name} {record[name]}, want less than {limit}; actors "
                    "and learner were started with different runs"
                )
        for name in ("reward", "vector", "extras"):
            finite = np.isfinite(steps[name])
            if (wrong := np.flatnonzero(~finite.all(axis=tuple(range(1, finite.ndim))))).size:
                record = steps[wrong[0]]
                raise TransportError(
                    f"ingest: record {record['sequence']} of lane {record['lane']}: got the {name} {record[name]}, "
                    "want a finite one"
                )
        is_last = (steps["terminated"] | steps["truncated"]).tolist()
        for sequence, lane, first, last in zip(
            steps["sequence"].tolist(), steps["lane"].tolist(), steps["first"].tolist(), is_last, strict=True
        ):
            if not (first or self._in_episode[lane]):
                raise TransportError(
                    f"ingest: record {sequence} of lane {lane} neither begins an episode nor continues one; records "
                    "before it were lost"
                )
            self._in_episode[lane] = not last

    def _count(self, steps: np.ndarray, params_version: int) -> None:
        decisions = steps[(steps["terminated"] | steps["truncated"]) == 0]
        versions, counts = np.unique(decisions["params_version"], return_counts=True)
        if versions.size and versions[-1] > params_version:
            raise TransportError(
                f"ingest: got an action of parameters version {versions[-1]}, but {params_version} is the newest that "
                "was published; a ring of another run is being read"
            )
        self._env_steps += len(decisions)
        for version, count in zip(versions.tolist(), counts.tolist(), strict=True):
            self._ages[params_version - version] += count


def _step_arrays(steps: np.ndarray, frames: np.ndarray, num_valid: np.ndarray) -> StepArrays:
    return StepArrays(
        frames=frames,
        action=steps["action"].astype(np.int32),
        reward=steps["reward"].astype(np.float32),
        lane=steps["lane"].astype(np.int32),
        task=steps["task"].astype(np.int32),
        first=steps["first"] != 0,
        terminated=steps["terminated"] != 0,
        truncated=steps["truncated"] != 0,
        vector=steps["vector"] if steps["vector"].size else None,
        extras=steps["extras"] if steps["extras"].size else None,
        sight=steps["sight"] if steps["sight"].size else None,
        num_valid=num_valid,
    )
