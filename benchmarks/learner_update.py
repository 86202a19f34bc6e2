"""Gradient steps per second (draw, loss, update, priorities) at batch 32, 84x84x12, beside Tianshou and Dopamine.

Candidates: our learner with a full replay of 100K records in one jitted, donated call; Tianshou's PyTorch Rainbow with
its own prioritized buffer of 100K, sampling included; Dopamine's JAX full Rainbow with its prioritized buffer. A
profile of our step follows, and the time that the arithmetic alone would take at the measured rate of matrix products.
Goals on a CPU: no slower than Tianshou, twice Dopamine. On a GPU: 5,000 steps/s, and 80% of that while actors play and
their records go into the same replay.
"""

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

from benchmarks import workload
from benchmarks.remote import start_peer
from benchmarks.rounds import Budget, Row, absent, alternate, goal, measured, rates, ratios, seconds_per_call

PEERS = {"Tianshou": ("tianshou_rainbow", 1.0), "Dopamine": ("dopamine_rainbow", 2.0)}
"""name -> (script, goal: our speed divided by the peer's)"""


def measure(budget: Budget) -> list[Row]:
    """Rates of all candidates, the goals, and our profile."""
    import jax

    from learner.train_step import default_num_updates

    on_cpu, config = jax.default_backend() == "cpu", workload.run_config(budget)
    rows: list[Row] = []
    with contextlib.ExitStack() as stack:
        parts = stack.enter_context(workload.assembled(config))
        learner = workload.Learner(config, parts)
        scans = (default_num_updates(learner.sizes.config), *(() if on_cpu else (64,)))
        bodies: dict[str, Callable[[], float]] = {
            f"learner, {scan} to a call": partial(learner.updates_per_s, scan, budget.body_s) for scan in scans
        }
        ours = next(reversed(bodies))
        if on_cpu:
            without_gpu = {"JAX_PLATFORMS": "cpu", "CUDA_VISIBLE_DEVICES": ""}
            for name, (script, _) in PEERS.items():
                size = (str(learner.sizes.replay_config.capacity), str(learner.sizes.batch_size))
                peer = start_peer(script, budget.peers, *size, environment=without_gpu)
                if isinstance(peer, str):
                    rows.append(absent(name, peer))
                    continue
                stack.enter_context(peer)
                bodies[name] = lambda peer=peer: 1 / peer(seconds=budget.body_s)["seconds_per_call"]
        else:
            pool = stack.enter_context(workload.playing(parts.pool_config, learner.acting_params()))
            bodies["learner with live actors"] = partial(learner.updates_per_s, scans[-1], budget.body_s, pool)
        bodies["products"] = partial(_products_per_s, 256 if budget.quick else 2048, budget.body_s)
        values = alternate(budget.rounds, bodies)
        products = values.pop("products")
        profile = _profile(learner, budget)
    batch_size = learner.sizes.batch_size
    rows = [*(rates(n, updates_per_s=found, batch_size=batch_size) for n, found in values.items()), *rows]
    for name, (_, factor) in PEERS.items():
        if name in values:
            rows.append(goal(5, f"against {name}", ratios(values[ours], values[name]), at_least=factor, unit="x"))
    if on_cpu:
        rows.append(absent("learner on a GPU", "JAX has none here; the same command measures it where there is one"))
    else:
        alive = ratios(values["learner with live actors"], values[ours])
        rows.append(goal(5, "learner on a GPU", values[ours], at_least=5000.0, unit="gradient steps/s"))
        rows.append(goal(5, "learner on a GPU with live actors, against without", alive, at_least=0.8, unit="x"))
    flops = learner.flops_per_update()
    return [
        *rows,
        measured("float32 products", "GFLOP/s", [rate / 1e9 for rate in products]),
        measured("arithmetic of one gradient step", "GFLOP", [flops / 1e9]),
        measured("the arithmetic alone at that rate", "ms", [1e3 * flops / rate for rate in products]),
        *profile,
    ]


def _products_per_s(size: int, seconds: float) -> float:
    """FLOP/s of square float32 matrix products on all cores or devices that the learner may use."""
    import jax
    import jax.numpy as jnp

    a = jnp.ones((size, size), jnp.float32) / size
    product = jax.jit(lambda a, b: jnp.matmul(a, b, precision="highest"))
    product(a, a).block_until_ready()
    return 2 * size**3 / seconds_per_call(lambda: product(a, a).block_until_ready(), seconds)


def _profile(learner: "workload.Learner", budget: Budget) -> list[Row]:
    """Milliseconds of each part of a gradient step, compiled alone; fused into one call they can take less."""
    import jax
    import jax.numpy as jnp
    import optax

    from learner import replay

    agent, spec, config = learner.sizes.agent, learner.sizes.replay_spec, learner.config
    params, key = learner.state.params, jax.random.key(0)
    batch_size = learner.sizes.batch_size
    optimizer = optax.adam(config.learner.learning_rate, eps=config.learner.adam_eps)

    def loss(params: Any, batch: replay.Transitions) -> jax.Array:
        return agent.loss(params, params, key, batch).loss.mean()

    sample = jax.jit(lambda stored, key: replay.sample(spec, stored, key, batch_size, 0.5))
    forward, gradient = jax.jit(loss), jax.jit(jax.grad(loss))
    adam = jax.jit(lambda grads, state, params: optax.apply_updates(params, optimizer.update(grads, state)[0]))

    @partial(jax.jit, donate_argnums=0)
    def priorities(stored: replay.ReplayState, slots: jax.Array, errors: jax.Array) -> replay.ReplayState:
        return replay.update_priorities(spec, stored, slots, errors)

    def set_priorities() -> Any:
        learner.replay = priorities(learner.replay, info.slots, errors)
        return learner.replay

    batch, info = sample(learner.replay, key)
    grads = gradient(params, batch)
    adam_state = jax.jit(optimizer.init)(params)
    errors = jnp.ones(batch_size)
    calls: dict[str, Callable[[], Any]] = {
        "draw of the batch": lambda: sample(learner.replay, key),
        "loss (three forward passes)": lambda: forward(params, batch),
        "loss and gradient": lambda: gradient(params, batch),
        "Adam": lambda: adam(grads, adam_state, params),
        "priorities": set_priorities,
    }
    bodies = {
        name: partial(seconds_per_call, lambda call=call: jax.block_until_ready(call()), budget.body_s / 2)
        for name, call in calls.items()
    }
    found = {name: [1e3 * s for s in seconds] for name, seconds in alternate(budget.rounds, bodies).items()}
    return [measured(f"profile: {name}", "ms", values) for name, values in found.items()]
