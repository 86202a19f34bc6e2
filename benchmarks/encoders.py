"""What each encoder costs: gradient steps of 32 and decisions of eight games, on grey frames of 48x84.

The agent is that of `rainbow_quick` with the thesis's sizes of convolutions, which `nature`, `layer_norm` and the
pooling encoders take; `small` and all forms of IMPALA have sizes of their own. A gradient step draws, learns and
writes priorities; a decision is the network's part of it, for eight games in one call. There is no goal.
"""

import dataclasses
from collections.abc import Callable
from functools import partial
from pathlib import Path

from benchmarks import workload
from benchmarks.rounds import Budget, Row, alternate, rates, seconds_per_call

GAMES = 8
CAPACITY = 10_000
"""of the replay; its size hardly matters for the speed"""
QUICK_NAMES = ("small",)


def measure(budget: Budget) -> list[Row]:
    """A row of rates for each encoder."""
    from gvz.core.registry import discover

    names = [name for name, module in discover("learner.encoders").items() if hasattr(module, "ENCODER")]
    learners: dict[str, Callable[[], float]] = {}
    players: dict[str, Callable[[], float]] = {}
    for name in QUICK_NAMES if budget.quick else names:
        learner = _learner(name)
        learners[name] = partial(learner.updates_per_s, 1, budget.body_s)
        players[name] = partial(seconds_per_call, _decide(learner), budget.body_s)
    updates = alternate(budget.rounds, learners)
    seconds = alternate(budget.rounds, players)
    return [
        rates(name, decisions_per_s=[GAMES / s for s in seconds[name]], updates_per_s=updates[name]) for name in updates
    ]


def _learner(encoder: str) -> workload.Learner:
    from gvz.run.assemble import assemble
    from gvz.run.config_files import load_config
    from learner.agents.configs.rainbow import RainbowConfig

    config = load_config("rainbow_quick")
    assert config.replay is not None
    config = dataclasses.replace(
        config,
        agent=RainbowConfig(encoder=encoder, hidden_units=config.agent.hidden_units),
        replay=dataclasses.replace(config.replay, capacity=CAPACITY),
    )
    return workload.Learner(config, assemble(config, Path()))


def _decide(learner: workload.Learner) -> Callable[[], None]:
    """A compiled and warm function that chooses an action for each of GAMES games."""
    import jax
    import jax.numpy as jnp

    agent = learner.sizes.agent
    act = jax.jit(agent.act)
    arguments = jax.random.key(0), agent.spec.zeros(GAMES), jnp.float32(0)

    def decide() -> None:
        jax.block_until_ready(act(learner.state.params, *arguments))

    decide()
    return decide
