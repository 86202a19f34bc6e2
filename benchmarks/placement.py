"""An actor and its engines on one core, against processes that may use every core.

The pool plays at random with 1, 2 and 4 actors of 4 games, alone; then with the network of `rainbow_quick` beside a
learner that does gradient steps all the time. Free and pinned alternate; each body begins with a fresh pool. A ratio
above 1 says that pinned is faster.
"""

import dataclasses
import time
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING

import msgspec

from benchmarks import workload
from benchmarks.rounds import Budget, Row, alternate, measured, rates, ratios

if TYPE_CHECKING:
    from actors.placement import PlacementKind
    from actors.pool import PoolConfig

GAMES = 4
FREE_AND_PINNED: "tuple[PlacementKind, PlacementKind]" = ("free", "pinned")


def measure(budget: Budget) -> list[Row]:
    """Decisions per second by placement and number of actors; beside the learner, also its gradient steps."""
    from actors.placement import actor_cores
    from gvz.run.config_files import load_config

    config = workload.run_config(budget) if budget.quick else load_config("rainbow_quick.py")
    config = dataclasses.replace(config, actors=dataclasses.replace(config.actors, num_actors=1, games_per_actor=GAMES))
    numbers = (1,) if budget.quick else (1, 2, 4)
    updates: dict[str, list[float]] = {}
    with workload.assembled(config) as parts:
        learner = workload.Learner(config, parts)

        def pool(kind: "PlacementKind", num_actors: int) -> "PoolConfig":
            cores = tuple(actor_cores(kind, num_actors))
            return msgspec.structs.replace(parts.pool_config, num_actors=num_actors, cores=cores)

        def alone(kind: "PlacementKind", num_actors: int) -> float:
            with workload.playing(workload.random_players(pool(kind, num_actors))) as players:
                return workload.decisions_per_s(players, budget.body_s)

        def beside(name: str, kind: "PlacementKind", num_actors: int) -> float:
            per_call = learner.sizes.num_updates_per_call
            learner.updates_per_s(per_call, 0.0)  # compiles
            with workload.playing(pool(kind, num_actors), learner.acting_params()) as players:
                workload.decisions_per_s(players, 0.0)
                num_updates, start, before = 0, time.perf_counter(), players.statistics().env_steps
                while time.perf_counter() - start < budget.body_s or players.statistics().env_steps == before:
                    learner.updates_per_s(per_call, 0.0)  # two calls: one before the clock of its own
                    num_updates += 2 * per_call
                    players.drain(256)
                    players.poll()
                seconds = time.perf_counter() - start
                updates.setdefault(name, []).append(num_updates / seconds)
                return (players.statistics().env_steps - before) / seconds

        bodies: dict[str, Callable[[], float]] = {}
        for count in numbers:
            for kind in FREE_AND_PINNED:
                bodies[_name(kind, count, "alone")] = partial(alone, kind, count)
        for count in numbers:
            for kind in FREE_AND_PINNED:
                name = _name(kind, count, "beside a learner")
                bodies[name] = partial(beside, name, kind, count)
        values = alternate(budget.rounds, bodies, warm_up=False)
    rows = [rates(name, decisions_per_s=found, updates_per_s=updates.get(name)) for name, found in values.items()]
    for where in ("alone", "beside a learner"):
        for count in numbers:
            free, pinned = (values[_name(kind, count, where)] for kind in FREE_AND_PINNED)
            text = f"pinned against free, {where}"
            rows.append(measured(text, "x", ratios(pinned, free), x=count, x_unit="actors"))
    return rows


def _name(kind: str, num_actors: int, where: str) -> str:
    return f"{num_actors} actor{'s' * (num_actors > 1)} of {GAMES} games, {kind}, {where}"
