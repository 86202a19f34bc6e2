"""Decisions per second of `gvz.make_vec`: the engine's limit, `step`, `send` and `recv`, gymnasium's AsyncVectorEnv.

The limit is the rate of N bare processes that only call `make_action` and `get_state` at the same render size, with
the best N. The vector environments play at random with four games for each core. `recv` waits for half of the games.
AsyncVectorEnv plays the same environments with a process for each game, and with as many games as cores, too; the
better of the two counts. Goals: `step` and `recv` reach 0.85 of the limit and are faster than AsyncVectorEnv.
"""

import contextlib
import os
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from benchmarks import workload
from benchmarks.remote import Remote, count_per_s
from benchmarks.rounds import Budget, Row, alternate, goal, rates, ratios

if TYPE_CHECKING:
    from gvz.vector.env import DoomVectorEnv


def measure(budget: Budget) -> list[Row]:
    """Rates of all candidates in alternating rounds, and the ratios of the goals."""
    import gvz
    from gvz.core.env_config import EnvConfig

    cores = len(os.sched_getaffinity(0))
    games = 2 if budget.quick else 4 * cores
    size = (str(EnvConfig().render_width), str(EnvConfig().render_height))
    step, recv = f"make_vec, step, {games} games", f"make_vec, send and recv, {games} games"
    with contextlib.ExitStack() as stack:
        bodies: dict[str, Callable[[], float]] = {}
        groups: dict[str, list[str]] = {"limit": [], "gymnasium": []}

        def remote(group: str, name: str, count: int, *arguments: str) -> None:
            remotes = [stack.enter_context(Remote(*arguments)) for _ in range(count)]
            groups[group].append(name)
            bodies[name] = lambda: count_per_s(remotes, {"seconds": budget.body_s})

        for count in (1,) if budget.quick else (cores, 2 * cores, 4 * cores):
            remote("limit", f"bare engines x{count}", count, "bare_engine", workload.TASK, *size)
        for count in (1,) if budget.quick else (cores, games):
            name = f"AsyncVectorEnv, {count} games"
            remote("gymnasium", name, 1, "gymnasium_async", workload.TASK, str(count))
        for name, batch_size, play in ((step, games, _step_per_s), (recv, games // 2, _recv_per_s)):
            envs = stack.enter_context(contextlib.closing(gvz.make_vec(workload.TASK, games, batch_size=batch_size)))
            envs.reset(seed=0)
            bodies[name] = lambda envs=envs, play=play: play(envs, budget.body_s)
        values = alternate(budget.rounds, bodies)
    best = {
        group: [max(found) for found in zip(*(values[name] for name in names), strict=True)]
        for group, names in groups.items()
    }
    rows = [rates(name, decisions_per_s=found) for name, found in values.items()]
    for name, text in ((step, "step"), (recv, "send and recv")):
        against = (("limit", "the engine's limit", 0.85), ("gymnasium", "AsyncVectorEnv", 1.0))
        for group, other, at_least in against:
            found = ratios(values[name], best[group])
            rows.append(goal(10, f"{text} against {other}", found, at_least=at_least, unit="x"))
    return rows


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
