"""Everything that a GPU changes, in one command of at most nine minutes: `python -m benchmarks gpu`.

The whole run of `rainbow_4task` with both kinds of `actors.inference`; gradient steps at batch 32, 256 and 1024 in
float32 and bfloat16, and by the number in one call; decisions of the network on the device; the device's memory against
the bill; the sum tree at batch 256; insertion and drawing with up to 4 million records. Sizes are those of
`rainbow_4task`; records of the large replays have small frames. Without a GPU nothing is measured, but `--quick` runs
each part once.
"""

import dataclasses
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks import growth, sum_tree, whole, workload
from benchmarks.rounds import Budget, Row, absent, alternate, measured, rates, seconds_per_call

BATCHES, SCANS, ACTED = (32, 256, 1024), (1, 4, 16, 64), (64, 256, 1024)
CAPACITIES = (100_000, 1_000_000, 4_000_000)
NUM_LEAVES = 1_000_000
RUN_UPDATES = 4_000
"""gradient steps of the whole run"""
LAST_START_S = 400.0
"""a part that comes later is left out: compilers take most of the time, and how long is not known before"""


def measure(budget: Budget) -> list[Row]:
    """The rows of each part, in the order of the text above."""
    import jax

    if jax.default_backend() == "cpu" and not budget.quick:
        return [absent("everything on this list", "JAX finds no GPU here")]
    few = dataclasses.replace(budget, rounds=min(budget.rounds, 3), body_s=budget.body_s / 2)
    parts: dict[str, Callable[[], list[Row]]] = {
        "the run": partial(_whole, few),
        "gradient steps by batch, float32": partial(_batches, few, "float32"),
        "gradient steps by their number in one call, decisions on the device, memory": partial(_calls, few),
        "gradient steps by batch, bfloat16": partial(_batches, few, "bfloat16"),
        "sum tree": partial(_tree, few),
        "insertion and drawing": lambda: growth.replay_rows(few, _few(CAPACITIES, few)),
    }
    start_s, rows = time.monotonic(), list[Row]()
    for name, part in parts.items():
        spent_s = time.monotonic() - start_s
        print(f"  after {spent_s:.0f} s: {name}", flush=True)
        rows += part() if spent_s < LAST_START_S else [absent(name, f"the parts before took {spent_s:.0f} s")]
    return [row for row in rows if row["kind"] != "goal"]  # those of growth are of other sizes


def _few(sizes: tuple[int, ...], budget: Budget) -> tuple[int, ...]:
    """The sizes; in a quick run a tiny one."""
    return (min(sizes[0], 1_000),) if budget.quick else sizes


def _batches(budget: Budget, dtype: str) -> list[Row]:
    """Gradient steps by batch, with activations of this dtype."""

    def change(config: Any, size: int) -> Any:
        agent = dataclasses.replace(config.agent, activation_dtype=dtype)
        learner = dataclasses.replace(config.learner, batch_size=size)
        return dataclasses.replace(config, agent=agent, learner=learner)

    seconds = growth.updates_by_size(budget, (8,) if budget.quick else BATCHES, change)
    return [
        rates(f"learner, batch {size:.0f}, {dtype}", updates_per_s=[1 / s for s in found], batch_size=int(size))
        for size, found in seconds.items()
    ]


def _calls(budget: Budget) -> list[Row]:
    """Gradient steps by their number in one call, decisions on the device, and what the learner takes of it."""
    import jax
    import jax.numpy as jnp

    from gvz.run.assemble import assemble

    config = workload.run_config(budget)
    learner = workload.Learner(config, assemble(config, Path()))
    agent, act = learner.sizes.agent, jax.jit(learner.sizes.agent.act)

    def decide(observation: Any) -> None:
        jax.block_until_ready(act(learner.state.params, jax.random.key(0), observation, jnp.float32(0)))

    learners: dict[str, Callable[[], float]] = {
        f"learner, {scan} to a call": partial(learner.updates_per_s, scan, budget.body_s)
        for scan in (SCANS[:1] if budget.quick else SCANS)
    }
    updates = alternate(budget.rounds, learners)
    players: dict[int, Callable[[], float]] = {
        games: partial(seconds_per_call, partial(decide, agent.spec.zeros(games)), budget.body_s)
        for games in _few(ACTED, budget)
    }
    seconds = alternate(budget.rounds, players)
    statistics = jax.devices()[0].memory_stats() or {}
    bill = learner.parts.footprint.replay_bytes + 4 * learner.parts.footprint.params_bytes
    rows = [rates(name, updates_per_s=found, batch_size=learner.sizes.batch_size) for name, found in updates.items()]
    rows += [
        rates(f"network on the device, {games} games a call", decisions_per_s=[games / s for s in found])
        for games, found in seconds.items()
    ]
    if "peak_bytes_in_use" in statistics:
        rows.append(measured("peak of the device's memory", "GB", [statistics["peak_bytes_in_use"] / 1e9]))
    return [*rows, measured("replay, parameters and optimizer on the bill", "GB", [bill / 1e9])]


def _tree(budget: Budget) -> list[Row]:
    """Draw and update of the sum tree."""
    (leaves,) = _few((NUM_LEAVES,), budget)
    call = sum_tree.steps_of(leaves, 256)
    seconds = [seconds_per_call(call, budget.body_s) for _ in range(budget.rounds)]
    found = [1e6 * s / sum_tree.STEPS_PER_CALL for s in seconds]
    return [measured(f"sum tree, batch 256, {leaves:,} leaves", "us a step", found)]


def _whole(budget: Budget) -> list[Row]:
    """The run with its actors, as a user starts it, and with actors that leave acting to the device."""
    updates, period = (400, 100) if budget.quick else (RUN_UPDATES, 100)
    rows = []
    for inference in ("device",) if budget.quick else ("actors", "device"):
        with tempfile.TemporaryDirectory(prefix="gvz-benchmark-") as directory:
            run = whole.run_command(
                *(Path(directory) / "run", budget, updates, period, 2.0, whole.tree_bytes),
                *("--actors.inference", inference),
            )
        updates_per_s, decisions_per_s = whole.run_rates(run["rows"])
        name = f"actors.inference {inference}"
        rows += [
            rates(f"the run, {name}", decisions_per_s=[decisions_per_s], updates_per_s=[updates_per_s]),
            measured(f"from the command to the first gradient step, {name}", "s", [run["first_row_s"]]),
            measured(f"peak of the host's memory, {name}", "GB", [max(run["seen"], default=0) / 1e9]),
        ]
    return rows
