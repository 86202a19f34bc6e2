"""Measures on this machine what `plan` counts with: one actor plays, its records are compressed and stored."""

import dataclasses
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jax

from actors.pool import Pool
from gvz.cluster.plan import Costs
from gvz.cluster.wire import BatchHeader, pack, unpack
from gvz.core.errors import WaitTimeoutError
from gvz.run.assemble import assemble
from gvz.run.config import RunConfig, off_policy
from gvz.run.machine import cpu_model, processor_s
from gvz.transport.messages import ParamsHeader, StepBlock
from learner.learner import Learner

FIRST_S = 2.0
PLAY_S = 10.0
START_TIMEOUT_S = 300.0
BATCH_RECORDS = 256
DRAIN_RECORDS = 256


def measure(config: RunConfig) -> Costs:
    """Plays for ten seconds with one actor and a new network; half a minute in all.

    Raises:
        GvzError: the run does not fit this machine, or its actor does not start.
    """
    actors = dataclasses.replace(config.actors, num_actors=1, inference="actors")  # those of hosts act by themselves
    replay = dataclasses.replace(off_policy(config)[1], capacity=50_000)
    small = dataclasses.replace(config, mode="async", actors=actors, replay=replay)
    with tempfile.TemporaryDirectory(prefix="gvz-measure-") as directory:
        parts = assemble(small, Path(directory) / "work")
        learner = parts.learner.make(jax.random.key(0), parts.table.ids, Path(directory))
        with parts.make_pool(small, None) as pool:
            header = ParamsHeader(version=1, num_updates=0, layout_hash=parts.pool_config.layout_hash)
            pool.publish(learner.acting_params(), header)
            _await_actor(pool, small)
            first = _drain(pool, FIRST_S)  # some of it was played before the clock starts
            begin_s, own_s = processor_s(), time.process_time()
            blocks = _drain(pool, PLAY_S)
            spent_s = (processor_s() - begin_s) - (time.process_time() - own_s)
        _store(learner, first)  # compiles
        ingest_s = _timed(lambda: _store(learner, blocks))
    batches, packed = list(_batches(blocks)), list[bytes]()
    num_records, dtype = sum(map(len, blocks)), blocks[0].steps.dtype
    header = BatchHeader(run_id="", host=0, incarnation=0, number=0)
    pack_s = _timed(lambda: packed.extend(pack(header, [], batch, compress=True) for batch in batches))
    shape = parts.pool_config.frame_shape
    unpack_s = _timed(lambda: [unpack(data, dtype, shape, num_records) for data in packed])
    plain = sum(block.frames.nbytes for block in blocks)
    return Costs(
        decision_s=spent_s / num_records,
        pack_s=pack_s / num_records,
        unpack_s=unpack_s / num_records,
        ingest_s=ingest_s / num_records,
        ratio=plain / (sum(map(len, packed)) - num_records * dtype.itemsize),
        source=f"measured now: {num_records} records of {config.name}, one core of {cpu_model()}",
    )


def _await_actor(pool: Pool, config: RunConfig) -> None:
    deadline_s = time.monotonic() + START_TIMEOUT_S
    while pool.statistics().actors_ready < config.num_actors:
        if time.monotonic() > deadline_s:
            raise WaitTimeoutError(f"waited {START_TIMEOUT_S:.0f} s for the actor's start")
        pool.poll()
        time.sleep(0.05)


def _drain(pool: Pool, seconds: float) -> list[StepBlock]:
    blocks: list[StepBlock] = []
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        blocks += pool.drain(DRAIN_RECORDS, wait_s=0.02)
        pool.poll()
    return blocks


def _store(learner: Learner, blocks: Sequence[StepBlock]) -> None:
    for batch in _batches(blocks):
        learner.add(batch, 1)
    jax.block_until_ready(learner.arrays())


def _batches(blocks: Sequence[StepBlock]) -> Iterator[list[StepBlock]]:
    """The blocks in groups of some BATCH_RECORDS records, in order."""
    waiting: list[StepBlock] = []
    for block in blocks:
        waiting.append(block)
        if sum(map(len, waiting)) >= BATCH_RECORDS:
            yield waiting
            waiting = []
    if waiting:
        yield waiting


def _timed(work: Callable[[], object]) -> float:
    begin_s = time.process_time()
    work()
    return time.process_time() - begin_s
