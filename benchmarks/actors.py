"""Decisions per second: the engine's limit, our actor pool with random play, EnvPool, LevDoom.

The limit is the rate of N bare processes that only call `make_action` and `get_state` at the same render size, with
the best N. The pool does everything that a run does except the network: resize, stack, ring, drain in the learner's
process. EnvPool runs asynchronously with one thread per core, LevDoom bare (without its wrappers) under gymnasium's
AsyncVectorEnv; for both the better of two sizes counts. Goals: the pool reaches 0.85 of the limit, 4 times EnvPool, 8
times LevDoom at its default of 320x240 and 6 times at our 256x144.
"""

import contextlib
import os
import tempfile
from collections.abc import Callable

from benchmarks import workload
from benchmarks.remote import Remote, count_per_s, start_peer
from benchmarks.rounds import Budget, Row, absent, alternate, goal, rates, ratios


def measure(budget: Budget) -> list[Row]:
    """Rates of all candidates in alternating rounds, and the ratios of the goals."""
    from gvz.run.assemble import assemble

    cores = len(os.sched_getaffinity(0))
    config = workload.run_config(budget)
    rows: list[Row] = []
    with contextlib.ExitStack() as stack:
        bodies: dict[str, Callable[[], float]] = {}
        groups: dict[str, list[str]] = {"limit": [], "envpool": [], "levdoom 320x240": [], "levdoom 256x144": []}

        def bare(count: int) -> None:
            size = (str(config.env.render_width), str(config.env.render_height))
            remotes = [stack.enter_context(Remote("bare_engine", workload.TASK, *size)) for _ in range(count)]
            name = f"bare engines x{count}, 256x144"
            groups["limit"].append(name)
            bodies[name] = lambda: count_per_s(remotes, {"seconds": budget.body_s})

        def peer(group: str, name: str, script: str, *arguments: str) -> None:
            remote = start_peer(script, budget.peers, *arguments)
            if isinstance(remote, str):
                rows.append(absent(name, remote))
                return
            stack.enter_context(remote)
            groups[group].append(name)
            bodies[name] = lambda: count_per_s([remote], {"seconds": budget.body_s})

        for count in (1,) if budget.quick else (cores, 2 * cores, 4 * cores):
            bare(count)
        directory = stack.enter_context(tempfile.TemporaryDirectory(prefix="gvz-benchmark-"))
        parts = assemble(config, workload.work_directory(directory))
        pool = stack.enter_context(workload.playing(workload.random_players(parts.pool_config)))
        ours = "actor pool, random play, 256x144"
        bodies[ours] = lambda: workload.decisions_per_s(pool, budget.body_s)
        for count in (1,) if budget.quick else (cores, 4 * cores):
            peer(
                "envpool",
                f"EnvPool, {count} games, {cores} threads",
                "envpool_doom",
                str(count),
                str(min(count, cores)),
            )
            peer("levdoom 320x240", f"LevDoom, {count} games, 320x240", "levdoom_async", str(count))
            peer("levdoom 256x144", f"LevDoom, {count} games, 256x144", "levdoom_async", str(count), "256X144")
        values = alternate(budget.rounds, bodies)
        profile = workload.processor_times(budget.rounds, {name: bodies[name] for name in (groups["limit"][0], ours)})
    rows = [*(rates(name, decisions_per_s=found) for name, found in values.items()), *rows, *profile]
    best = {
        group: [max(found) for found in zip(*(values[n] for n in names), strict=True)]
        for group, names in groups.items()
    }
    for group, text, at_least in (
        ("limit", "actor pool against the engine's limit", 0.85),
        ("envpool", "actor pool against EnvPool", 4.0),
        ("levdoom 320x240", "actor pool against LevDoom at its default size", 8.0),
        ("levdoom 256x144", "actor pool against LevDoom at equal size", 6.0),
    ):
        if best[group]:
            rows.append(goal(1, text, ratios(values[ours], best[group]), at_least=at_least, unit="x"))
    return rows
