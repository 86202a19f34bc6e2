"""Bodies for `make bench`: sum tree, insertion and sampling at the sizes of real runs. Each runs once in CI."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from learner import replay, sum_tree
from learner.ingest import BLOCK_SIZE
from learner.replay import ReplaySpec, ReplayState
from learner.store import StepArrays

STEPS_PER_CALL = 100


def make_spec(capacity: int) -> ReplaySpec:
    return ReplaySpec(
        num_lanes=8,
        capacity=capacity,
        frame_shape=(84, 84, 3),
        num_tasks=4,
        stack_size=4,
        n_steps=3,
        discount=0.99,
        priority_exponent=0.6,
        min_priority=0.01,
        prioritized=True,
        num_newest=0,
    )


def make_block(spec: ReplaySpec) -> StepArrays:
    """A full block of records in mid-episode, spread over all lanes."""
    N, rng = BLOCK_SIZE, np.random.default_rng(0)
    return StepArrays(
        frames=rng.integers(0, 256, (N, *spec.frame_shape), dtype=np.uint8),
        action=np.zeros(N, np.int32),
        reward=rng.random(N, dtype=np.float32),
        lane=np.arange(N, dtype=np.int32) % spec.num_lanes,
        task=np.arange(N, dtype=np.int32) % spec.num_tasks,
        first=rng.random(N) < 0.01,
        terminated=np.zeros(N, bool),
        truncated=np.zeros(N, bool),
        num_valid=np.array(N, np.int32),
    )


@pytest.fixture(scope="module", params=[2_000, 20_000])
def filled(request) -> tuple[ReplaySpec, ReplayState]:
    spec = make_spec(request.param)
    add, state, block = jax.jit(partial(replay.add, spec), donate_argnums=0), replay.init(spec), make_block(spec)
    for _ in range(spec.capacity // BLOCK_SIZE + 1):
        state = add(state, block)
    return spec, jax.block_until_ready(state)


def measure(benchmark, call, state, *args) -> None:
    """Times `state = call(state, *args)`, compiled and warm, with the state donated and the result awaited."""
    held = [call(jax.tree.map(jnp.copy, state), *args)]

    def body() -> None:
        held[0] = jax.block_until_ready(call(held[0], *args))

    benchmark.pedantic(body, rounds=20, warmup_rounds=2)


@pytest.mark.parametrize("batch_size", [32, 512])
def test_sum_tree_sample_and_set(benchmark, batch_size: int):
    """A hundred draws and updates in one scan: the figure is for all of them."""
    num_leaves = 1_000_000
    values = jax.random.uniform(jax.random.key(0), (num_leaves,)) + 0.01
    tree = jax.jit(sum_tree.set)(sum_tree.init(num_leaves), jnp.arange(num_leaves), values)
    keys = jax.random.split(jax.random.key(1), STEPS_PER_CALL)

    @partial(jax.jit, donate_argnums=0)
    def steps(tree, keys):
        def step(tree, key):
            indices, _ = sum_tree.sample(tree, key, batch_size)
            return sum_tree.set(tree, indices, values[:batch_size]), None

        return jax.lax.scan(step, tree, keys)[0]

    measure(benchmark, steps, tree, keys)


def test_add_a_block(benchmark, filled):
    """Flat in the capacity: the state is written in place."""
    spec, state = filled
    measure(benchmark, jax.jit(partial(replay.add, spec), donate_argnums=0), state, make_block(spec))


@pytest.mark.parametrize("batch_size", [32, 256])
def test_sample_a_batch(benchmark, filled, batch_size: int):
    """The batch is made in full: both stacks, returns, weights."""
    spec, state = filled
    sample = jax.jit(lambda state, key: replay.sample(spec, state, key, batch_size, 0.5))
    jax.block_until_ready(sample(state, jax.random.key(0)))
    benchmark.pedantic(lambda: jax.block_until_ready(sample(state, jax.random.key(1))), rounds=20, warmup_rounds=2)
