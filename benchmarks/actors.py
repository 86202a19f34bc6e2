"""Decisions per second: the engine's limit, our actor pool with random play, EnvPool, LevDoom.

The limit is the rate of N bare processes that only call `make_action` and `get_state` at the same render size, with
the best N. The pool does everything that a run does except the network: resize, stack, ring, drain in the learner's
process. EnvPool runs asynchronously with one thread per core, LevDoom bare (without its wrappers) under gymnasium's
AsyncVectorEnv. Of every group the better of two or three sizes counts. Goals: the pool reaches 0.85 of the limit, 4
times EnvPool (6 times with the tuned engine), 8 times LevDoom at its default of 320x240 and 6 times at our 256x144.
"""

import contextlib
import dataclasses
import os
from functools import partial

from benchmarks import workload
from benchmarks.candidates import Candidates, engine_is_tuned
from benchmarks.rounds import Budget, Row, alternate, rates


def measure(budget: Budget) -> list[Row]:
    """Rates of all candidates in alternating rounds, and the ratios of the goals."""
    cores = len(os.sched_getaffinity(0))
    config = workload.run_config(budget)
    with contextlib.ExitStack() as stack:
        candidates = Candidates(budget, stack)
        candidates.add_limit((1,) if budget.quick else (cores, 2 * cores))
        for games in (4,) if budget.quick else (1, 2, 4):
            actors = dataclasses.replace(config.actors, games_per_actor=games)
            parts = stack.enter_context(workload.assembled(dataclasses.replace(config, actors=actors)))
            pool = stack.enter_context(workload.playing(workload.random_players(parts.pool_config)))
            name = f"actor pool, random play, {games} games an actor"
            candidates.add("actor pool", name, partial(workload.decisions_per_s, pool, budget.body_s))
        candidates.add_peers((1,) if budget.quick else (cores, 4 * cores))
        values = alternate(budget.rounds, candidates.bodies)
        profiled = [name for name in candidates.bodies if name.startswith(("bare", "actor"))]
        profile = workload.processor_times(budget.rounds, {name: candidates.bodies[name] for name in profiled})
    wanted = {
        "limit": 0.85,
        "EnvPool": 6.0 if engine_is_tuned() else 4.0,
        "LevDoom 320x240": 8.0,
        "LevDoom 256x144": 6.0,
    }
    return [
        *(rates(name, decisions_per_s=found) for name, found in values.items()),
        *candidates.rows,
        *profile,
        *candidates.goals(1, "actor pool", values, wanted),
    ]
