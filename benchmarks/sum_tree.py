"""One draw and one update of the sum tree at a million leaves, compared with flashbax's.

Both run in one jit, a hundred steps in a scan with the tree donated. flashbax 0.1.3 runs in the peers' process, with
the same JAX settings and the setter that it chooses on this device. Goals: twice flashbax's speed at batch 32 and 512
on a CPU; on a GPU at most 50 microseconds at batch 256.
"""

import contextlib
from collections.abc import Callable
from functools import partial

from benchmarks.remote import start_peer
from benchmarks.rounds import Budget, Row, absent, alternate, goal, measured, ratios, seconds_per_call

STEPS_PER_CALL = 100


def measure(budget: Budget) -> list[Row]:
    """Microseconds a step at several batch sizes, and the goals."""
    import jax

    num_leaves = 10_000 if budget.quick else 1_000_000
    on_cpu = jax.default_backend() == "cpu"
    batches = (32,) if budget.quick else (32, 512) if on_cpu else (32, 256, 512)
    rows: list[Row] = []
    with contextlib.ExitStack() as stack:
        peer = "its goal is on a CPU"
        if on_cpu:
            sizes = str(num_leaves), str(STEPS_PER_CALL)
            peer = start_peer("flashbax_tree", budget.peers, *sizes, environment={"JAX_PLATFORMS": "cpu"})
        bodies: dict[str, Callable[[], float]] = {}
        for batch in batches:
            bodies[f"sum tree, batch {batch}"] = partial(seconds_per_call, steps_of(num_leaves, batch), budget.body_s)
            if not isinstance(peer, str):
                body = {"seconds": budget.body_s, "batch": batch}
                bodies[f"flashbax, batch {batch}"] = lambda body=body: peer(**body)["seconds_per_call"]
        if isinstance(peer, str):
            rows.append(absent("flashbax", peer))
        else:
            stack.enter_context(peer)
        values = {name: [1e6 * s / STEPS_PER_CALL for s in f] for name, f in alternate(budget.rounds, bodies).items()}
    for name, found in values.items():
        rows.append(measured(f"{name}, {num_leaves:,} leaves", "us a step", found))
    for batch in batches:
        ours, theirs = values[f"sum tree, batch {batch}"], values.get(f"flashbax, batch {batch}")
        if on_cpu and theirs:
            rows.append(goal(4, f"against flashbax, batch {batch}", ratios(theirs, ours), at_least=2.0, unit="x"))
        if not on_cpu and batch == 256:
            rows.append(goal(4, "sum tree on a GPU, batch 256", ours, at_most=50.0, unit="us a step"))
    return rows


def steps_of(num_leaves: int, batch_size: int) -> Callable[[], None]:
    """A compiled and warm function that does STEPS_PER_CALL steps and waits for them."""
    import jax
    import jax.numpy as jnp

    from learner import sum_tree

    values = jax.random.uniform(jax.random.key(0), (num_leaves,)) + 0.01
    keys = jax.random.split(jax.random.key(1), STEPS_PER_CALL)

    @partial(jax.jit, donate_argnums=0)
    def steps(tree: sum_tree.SumTree, keys: jax.Array) -> sum_tree.SumTree:
        def step(tree: sum_tree.SumTree, key: jax.Array) -> tuple[sum_tree.SumTree, None]:
            indices, _ = sum_tree.sample(tree, key, batch_size)
            return sum_tree.set(tree, indices, values[:batch_size]), None

        return jax.lax.scan(step, tree, keys)[0]

    tree = [steps(jax.jit(sum_tree.set)(sum_tree.init(num_leaves), jnp.arange(num_leaves), values), keys)]

    def call() -> None:
        tree[0] = jax.block_until_ready(steps(tree[0], keys))

    return call
