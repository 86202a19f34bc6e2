"""Decisions per second with the full network acting, against the limit of engine and arithmetic.

The limit of a core is 1 / (engine time + inference FLOPs / matmul rate). The engine time is measured with bare
processes, the rate with float32 products in a process with an actor's settings, on all cores at once, both in the same
rounds. The FLOPs are those of a decision whose noise is folded into the weights. A batch reads all weights once, so
pools of several sizes are measured, with a draw of noise for each decision and for a stretch of 16; the best one of
each round counts, as for the peers of `actors`. Goal: 0.6 of the limit.
"""

import contextlib
import dataclasses
import os
from functools import partial

import numpy as np

from benchmarks import workload
from benchmarks.remote import Remote, count_per_s
from benchmarks.rounds import Budget, Row, alternate, goal, measured, rates, ratios

_POOLS = ((8, 1), (8, 16), (16, 16))
"""games of an actor, and decisions of each for which it keeps a draw of noise"""
_NOISE_OF = {1: "each decision", 16: "16 decisions"}


def measure(budget: Budget) -> list[Row]:
    """Rates of pools with the network, of engines and of products, and the goal's ratio."""
    import jax
    import jax.numpy as jnp

    from gvz.transport.child import one_core
    from learner.agents.rainbow import Rainbow
    from learner.export import flatten_params

    cores, config = len(os.sched_getaffinity(0)), workload.run_config(budget)
    num_engines = 1 if budget.quick else 2 * cores
    with contextlib.ExitStack() as stack:
        parts = {}
        for games, steps in ((4, 1),) if budget.quick else _POOLS:
            actors = dataclasses.replace(config.actors, games_per_actor=games)
            agent = dataclasses.replace(config.agent, noisy_period_steps=steps)
            changed = dataclasses.replace(config, actors=actors, agent=agent)
            parts[games, steps] = stack.enter_context(workload.assembled(changed))
        agent = workload.direct(next(iter(parts.values())).learner.agent)
        assert isinstance(agent, Rainbow)
        params = agent.init(jax.random.key(0))
        flat = np.asarray(jax.jit(flatten_params)(params))
        size = (str(config.env.render_width), str(config.env.render_height))
        engines = [stack.enter_context(Remote("bare_engine", workload.TASK, *size)) for _ in range(num_engines)]
        products = [stack.enter_context(Remote("cpu_matmul", environment=one_core())) for _ in range(cores)]
        acting = {key: stack.enter_context(workload.playing(own.pool_config, flat)) for key, own in parts.items()}
        plays = {
            f"actor pool, full network, {games} games an actor, noise of {_NOISE_OF[steps]}": partial(
                workload.decisions_per_s, pool, budget.body_s
            )
            for (games, steps), pool in acting.items()
        }
        values = alternate(
            budget.rounds,
            {
                "engines": lambda: count_per_s(engines, {"seconds": budget.body_s}),
                "flops": lambda: count_per_s(products, {"seconds": budget.body_s}),
                **plays,
            },
        )
        profile = workload.processor_times(budget.rounds, plays)
    folded = jax.eval_shape(agent.fold, params, jax.random.key(0))
    flops = workload.flops(agent.act, folded, jax.random.key(0), agent.spec.zeros(), jnp.float32(0))
    limits = [1 / (1 / e + flops / f) for e, f in zip(values["engines"], values["flops"], strict=True)]
    bests = [max(each) for each in zip(*(values[name] for name in plays), strict=True)]
    return [
        rates(f"bare engines x{num_engines}", decisions_per_s=values["engines"]),
        rates("limit: engine and arithmetic", decisions_per_s=limits),
        *(rates(name, decisions_per_s=values[name]) for name in plays),
        *profile,
        measured("float32 products, all cores", "GFLOP/s", [f / 1e9 for f in values["flops"]]),
        measured("arithmetic of one decision", "MFLOP", [flops / 1e6]),
        goal(2, "acting pool against the limit", ratios(bests, limits), at_least=0.6, unit="x"),
    ]
