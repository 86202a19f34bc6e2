"""How time grows with size: actors 1 to 2x cores, replay 10K to 1M, batch 32 to 1024, parameters x8, tasks 1 to 76.

Each curve's points are measured in alternating rounds. Goals: a gradient step's time grows no faster than its batch and
its parameters, a publication's time no faster than the vector. Insertion and drawing do not grow with the replay's
size, except for the logarithm of a tree. A decision's time grows no faster than the number of actors or tasks.
"""

import dataclasses
import math
import os
import tempfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from benchmarks import workload
from benchmarks.rounds import Budget, Row, alternate, goal, measured, ratios, seconds_per_call

_FRAME_SHAPE = (24, 24, 3)
"""frames of the replay curves: a million frames of 84x84x3 would be 21 GB"""
_SLACK = 0.1
"""tolerance of an exponent of growth above its ideal, because it is a measurement"""


def measure(budget: Budget) -> list[Row]:
    """The five curves and their goals."""
    few = dataclasses.replace(budget, rounds=min(budget.rounds, 3), body_s=budget.body_s / 2)
    capacities = (1_000, 4_000) if budget.quick else (10_000, 100_000, 1_000_000)
    return [*replay_rows(few, capacities), *_batch(few), *_parameters(few), *_actors(few), *_tasks(few)]


def _curve(
    name: str, unit: str, x_unit: str, values: Mapping[float, Sequence[float]], factor: float = 1.0
) -> list[Row]:
    return [measured(name, unit, [factor * v for v in found], x=x, x_unit=x_unit) for x, found in values.items()]


def exponent(values: Mapping[float, Sequence[float]]) -> list[float]:
    """b of y ~ x^b between the smallest and the largest x, a value a round: 0 is flat, 1 is linear."""
    low, high = min(values), max(values)
    return [math.log(grown, high / low) for grown in ratios(values[high], values[low])]


def replay_rows(budget: Budget, capacities: Sequence[int]) -> list[Row]:
    """Insertion of a block of 64 records and draw of a batch of 32, over the replay's size."""
    import jax

    from learner import replay
    from learner.ingest import BLOCK_SIZE
    from learner.replay import ReplaySpec
    from learner.store import StepArrays

    rng, inserts, draws = np.random.default_rng(0), {}, {}
    for capacity in capacities:
        spec = ReplaySpec(
            num_lanes=8,
            capacity=capacity,
            frame_shape=_FRAME_SHAPE,
            num_tasks=4,
            stack_size=4,
            n_steps=3,
            discount=0.99,
            priority_exponent=0.6,
            min_priority=0.01,
            prioritized=True,
            num_newest=0,
        )
        N = BLOCK_SIZE
        block = StepArrays(
            frames=rng.integers(0, 256, (N, *_FRAME_SHAPE), np.uint8),
            action=np.zeros(N, np.int32),
            reward=rng.random(N, np.float32),
            lane=np.arange(N, dtype=np.int32) % spec.num_lanes,
            task=np.zeros(N, np.int32),
            first=np.zeros(N, bool),
            terminated=np.zeros(N, bool),
            truncated=np.zeros(N, bool),
            num_valid=np.array(N, np.int32),
        )
        add = jax.jit(partial(replay.add, spec), donate_argnums=0)
        sample = jax.jit(lambda state, key, spec=spec: replay.sample(spec, state, key, 32, 0.5))
        state, keys = [workload.filled_replay(spec)], iter(jax.random.split(jax.random.key(1), 100_000))

        def insert(state: list[Any] = state, add: Any = add, block: StepArrays = block) -> None:
            state[0] = jax.block_until_ready(add(state[0], block))

        def draw(state: list[Any] = state, sample: Any = sample, keys: Any = keys) -> None:
            jax.block_until_ready(sample(state[0], next(keys)))

        inserts[capacity] = partial(seconds_per_call, insert, budget.body_s)
        draws[capacity] = partial(seconds_per_call, draw, budget.body_s)
    rows = []
    for name, bodies in (("insertion of 64 records", inserts), ("draw of a batch of 32", draws)):
        values = alternate(budget.rounds, bodies)
        low, high = min(values), max(values)
        grown = ratios(values[high], values[low])
        allowed = math.log(high) / math.log(low)
        rows += _curve(name, "ms", "records in the replay", values, 1e3)
        rows.append(goal(7, f"{name}, {high:,} against {low:,} records", grown, at_most=round(allowed, 2), unit="x"))
    return rows


def updates_by_size(
    budget: Budget, sizes: Sequence[int], change: Callable[[Any, int], Any]
) -> dict[float, list[float]]:
    """Seconds of a gradient step by size, with a replay of two thousand records of full frames."""
    from gvz.run.assemble import assemble
    from learner.config import ReplayConfig

    bodies = {}
    for size in sizes:
        config = workload.run_config(budget)
        config = dataclasses.replace(
            config,
            replay=ReplayConfig(capacity=4_000),
            learner=dataclasses.replace(config.learner, warmup_steps=2_000),
        )
        config = change(config, size)
        learner = workload.Learner(config, assemble(config, Path()))
        bodies[size] = lambda learner=learner: 1 / learner.updates_per_s(1, budget.body_s)
    return alternate(budget.rounds, bodies)


def _batch(budget: Budget) -> list[Row]:
    def change(config: Any, size: int) -> Any:
        return dataclasses.replace(config, learner=dataclasses.replace(config.learner, batch_size=size))

    values = updates_by_size(budget, (8, 16) if budget.quick else (32, 128, 1024), change)
    return [
        *_curve("gradient step over the batch", "ms", "transitions in a batch", values, 1e3),
        goal(7, "exponent of a gradient step in its batch", exponent(values), at_most=1 + _SLACK),
    ]


def _parameters(budget: Budget) -> list[Row]:
    """A gradient step by the number of parameters (set by the hidden units); a publication of as many numbers."""

    import jax

    from gvz.run.assemble import run_agent
    from gvz.transport.broadcast import BroadcastWriter
    from gvz.transport.messages import ParamsHeader

    def change(config: Any, size: int) -> Any:
        return dataclasses.replace(config, agent=dataclasses.replace(config.agent, hidden_units=size))

    hidden = (8, 16) if budget.quick else (512, 1448, 4096)
    counts = {}
    for size in hidden:
        params = jax.eval_shape(run_agent(change(workload.run_config(budget), size)).init, jax.random.key(0))
        counts[size] = sum(leaf.size for leaf in jax.tree.leaves(params))
    steps = {counts[size]: found for size, found in updates_by_size(budget, hidden, change).items()}
    writers = {n: BroadcastWriter.create("gvz-bench", n, 0) for n in counts.values()}
    try:
        bodies = {}
        for n, writer in writers.items():
            publish = partial(writer.publish, np.ones(n, np.float32), ParamsHeader(version=1, num_updates=0))
            bodies[n] = partial(seconds_per_call, publish, budget.body_s)
        publications = alternate(budget.rounds, bodies)
    finally:
        for writer in writers.values():
            writer.close()
    return [
        *_curve("gradient step over the parameters", "ms", "parameters", steps, 1e3),
        *_curve("publication", "ms", "parameters", publications, 1e3),
        goal(7, "exponent of a gradient step in its parameters", exponent(steps), at_most=1 + _SLACK),
        goal(7, "exponent of a publication in the parameters", exponent(publications), at_most=1 + _SLACK),
    ]


def _play(budget: Budget, config: Any) -> list[float]:
    with workload.playing(config) as pool:
        return alternate(budget.rounds, {"pool": lambda: workload.decisions_per_s(pool, budget.body_s)})["pool"]


def _actors(budget: Budget) -> list[Row]:
    """A pool's rate by its number of actors, each with four games; the pools run one after the other."""
    cores = len(os.sched_getaffinity(0))
    counts = (1, 2) if budget.quick else sorted({1, cores, cores + cores // 2, 2 * cores})
    with workload.assembled(workload.run_config(budget)) as parts:
        base = workload.random_players(parts.pool_config)
        pools = {n: msgspec.structs.replace(base, num_actors=n, cores=()) for n in counts}
        values: dict[float, list[float]] = {n: _play(budget, pool) for n, pool in pools.items()}
    return [
        *_curve("actor pool over actors", "decisions/s", "actors", values),
        goal(7, "exponent of a decision's time in the actors", exponent(_times(values)), at_most=1 + _SLACK),
    ]


def _times(per_s: Mapping[float, Sequence[float]]) -> dict[float, list[float]]:
    return {x: [1 / value for value in found] for x, found in per_s.items()}


def _tasks(budget: Budget) -> list[Row]:
    """A pool's rate by its number of tasks, of all scenarios; at least one game per task, one actor per core."""
    from actors.pool import PoolConfig
    from gvz.actions import action_buttons
    from gvz.core.env_config import EnvConfig
    from gvz.engine.probe import ensure_loads
    from gvz.scenarios.compiler import compile_task
    from gvz.tasks import named_tasks

    cores, tasks = (1 if budget.quick else len(os.sched_getaffinity(0))), named_tasks()
    env = EnvConfig(action_set="unified_v1")
    counts = (1, 2) if budget.quick else (1, 8, len(tasks))
    values: dict[float, list[float]] = {}
    with tempfile.TemporaryDirectory(prefix="gvz-benchmark-") as directory:
        for count in counts:
            # evenly spaced in the list, so that every point of the curve has its share of every scenario and level
            chosen = [tasks[i * len(tasks) // count] for i in range(count)]
            for task in chosen:
                compiled = compile_task(task, env.profile)
                ensure_loads(compiled.wad_path)
            config = PoolConfig(
                tasks=tuple(task.id for task in chosen),
                num_actors=cores,
                games_per_actor=max(4, -(-count // cores)),
                seed=1,
                env_entry_point="gvz.env:make_env",
                env_config=dataclasses.asdict(env),
                frame_shape=env.frame_shape,
                stack_size=4,
                num_actions=len(action_buttons(chosen[0].scenario, env.action_set)),
                policy=b"",
                num_params=0,
                layout_hash=0,
                actors=workload.run_config(budget).actors,
                work_dir=Path(directory),
            )
            values[count] = _play(budget, config)
    return [
        *_curve("actor pool over tasks", "decisions/s", "tasks", values),
        goal(7, "exponent of a decision's time in the tasks", exponent(_times(values)), at_most=1 + _SLACK),
    ]
