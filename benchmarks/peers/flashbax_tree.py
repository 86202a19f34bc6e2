"""flashbax's sum tree, a draw and an update in one jit: `python flashbax_tree.py NUM_LEAVES STEPS_PER_CALL`."""

import functools
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flashbax.buffers import sum_tree
from serve import serve


def main() -> None:
    """Makes the tree and serves."""
    num_leaves, steps_per_call = int(sys.argv[1]), int(sys.argv[2])
    on_cpu = jax.default_backend() == "cpu"
    set_batch = sum_tree.set_batch_scan if on_cpu else sum_tree.set_batch_bincount  # as flashbax chooses
    values = jax.random.uniform(jax.random.key(0), (num_leaves,)) + 0.01
    keys = jax.random.split(jax.random.key(1), steps_per_call)

    @functools.cache
    def compiled(batch: int) -> Callable[[Any], Any]:
        @functools.partial(jax.jit, donate_argnums=0)
        def steps(tree: Any, keys: jax.Array) -> Any:
            def step(tree: Any, key: jax.Array) -> tuple[Any, None]:
                indices = sum_tree.stratified_sample(tree, batch, key)
                return set_batch(tree, indices, values[:batch]), None

            return jax.lax.scan(step, tree, keys)[0]

        return lambda tree: jax.block_until_ready(steps(tree, keys))

    filled = jax.jit(sum_tree.set_batch_bincount)(sum_tree.init(num_leaves), jnp.arange(num_leaves), values)
    trees: dict[int, Any] = {}

    def time_steps(seconds: float, batch: int) -> dict[str, Any]:
        steps = compiled(batch)
        if batch not in trees:
            trees[batch] = steps(jax.tree.map(jnp.copy, filled))
        count, start = 0, time.perf_counter()
        while count == 0 or time.perf_counter() - start < seconds:
            trees[batch] = steps(trees[batch])
            count += 1
        return {"seconds_per_call": (time.perf_counter() - start) / count}

    serve(time_steps, "flashbax", "jax")


if __name__ == "__main__":
    main()
