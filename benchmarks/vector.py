"""Decisions per second of `gvz.make_vec`: `step`, and `send` and `recv`, beside the engine's limit and others.

The limit is the rate of N bare processes that only call `make_action` and `get_state` at the same render size, with
the best N. `recv` waits for half of the games. Gymnasium's AsyncVectorEnv plays the same environments with a process
for each game; EnvPool and LevDoom are those of `actors`. All play at random. Of every group the better of two sizes
counts. Goals: 0.85 of the limit, faster than AsyncVectorEnv, 4 times EnvPool (6 times with the tuned engine) and 8
times LevDoom at its default of 320x240.
"""

import contextlib
import os
import time
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from benchmarks import workload
from benchmarks.candidates import Candidates, engine_is_tuned
from benchmarks.remote import Remote
from benchmarks.rounds import Budget, Row, alternate, rates

if TYPE_CHECKING:
    from gvz.vector.env import DoomVectorEnv


def measure(budget: Budget) -> list[Row]:
    """Rates of all candidates in alternating rounds, and the ratios of the goals."""
    import gvz

    cores = len(os.sched_getaffinity(0))
    sizes = (2,) if budget.quick else (2 * cores, 4 * cores)
    with contextlib.ExitStack() as stack:
        candidates = Candidates(budget, stack)
        candidates.add_limit((1,) if budget.quick else (cores, 2 * cores))
        for games in (1,) if budget.quick else (cores, 4 * cores):
            remote = Remote("gymnasium_async", workload.TASK, str(games))
            candidates.add_remotes("AsyncVectorEnv", f"AsyncVectorEnv, {games} games", [remote])
        for games in sizes:
            for group, batch_size, play in (("step", games, _step_per_s), ("send and recv", games // 2, _recv_per_s)):
                envs = gvz.make_vec(workload.TASK, games, batch_size=batch_size)
                stack.enter_context(contextlib.closing(envs))
                envs.reset(seed=0)
                candidates.add(group, f"make_vec, {group}, {games} games", partial(play, envs, budget.body_s))
        candidates.add_peers((1,) if budget.quick else (4 * cores,))
        values = alternate(budget.rounds, candidates.bodies)
        profiled = [name for name in candidates.bodies if name.startswith(("bare", "make_vec"))]
        profile = workload.processor_times(1, {name: candidates.bodies[name] for name in profiled})
    wanted = {
        "limit": 0.85,
        "AsyncVectorEnv": 1.0,
        "EnvPool": 6.0 if engine_is_tuned() else 4.0,
        "LevDoom 320x240": 8.0,
    }
    return [
        *(rates(name, decisions_per_s=found) for name, found in values.items()),
        *candidates.rows,
        *profile,
        *(row for group in ("step", "send and recv") for row in candidates.goals(10, group, values, wanted)),
    ]


def _step_per_s(envs: "DoomVectorEnv", seconds: float) -> float:
    """Decisions per second of all games in step."""
    actions, count, start = _random_actions(envs), 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        envs.step(actions[count % len(actions)])
        count += 1
    return count * envs.num_envs / (time.perf_counter() - start)


def _recv_per_s(envs: "DoomVectorEnv", seconds: float) -> float:
    """Decisions per second of the games that are ready. Ends with none on its way."""
    actions, count = _random_actions(envs), 0
    envs.send(actions[0])
    start = time.perf_counter()
    while time.perf_counter() - start < seconds:
        games = envs.recv()[4]["env_id"]
        count += 1
        envs.send(actions[count % len(actions)][games], games)
    rate = count * envs.batch_size / (time.perf_counter() - start)
    while envs.num_playing:
        envs.recv()
    return rate


def _random_actions(envs: "DoomVectorEnv") -> np.ndarray:
    """int[1000, N]"""
    return np.array([envs.action_space.sample() for _ in range(1000)])
