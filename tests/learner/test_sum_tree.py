"""The sum tree against a float64 oracle, its distribution, and what float32 does to others."""

import math
from functools import partial

import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import settings
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from scipy import stats

from learner import sum_tree
from learner.sum_tree import FANOUT, SumTree
from tests import compiling
from tests.learner.sum_trees import check_valid

NUM_LEAVES = (1, FANOUT - 1, FANOUT, FANOUT**2, FANOUT**2 + 1, 1000)
NUM_GROUPS = (1, 3)
set_leaves = jax.jit(sum_tree.set, donate_argnums=0)
get_leaves = jax.jit(lambda tree: sum_tree.get(tree, jnp.arange(tree.num_leaves + 3)))
total = jax.jit(sum_tree.total)
draw = jax.jit(sum_tree.sample, static_argnames="batch_size")
draw_many = jax.jit(sum_tree.sample, static_argnames="batch_size", compiler_options=compiling.MUCH)


def tree_of(values) -> SumTree:
    values = np.asarray(values, np.float32)
    return set_leaves(sum_tree.init(len(values)), np.arange(len(values)), values)


class AgainstOracle(RuleBasedStateMachine):
    """Random operations on the tree and on a float64 array; indices repeat and some lie beyond the last leaf."""

    @initialize(group_size=st.sampled_from(NUM_LEAVES), num_groups=st.sampled_from(NUM_GROUPS))
    def make(self, group_size, num_groups):
        self.tree = sum_tree.init(group_size * num_groups, num_groups)
        self.leaves = np.zeros(group_size * num_groups)

    @rule(data=st.data(), size=st.sampled_from((1, 8)), spread=st.sampled_from((1, 3, 1000)))
    def set_some(self, data, size, spread):
        highest = min(len(self.leaves) + 2, spread)
        value = st.one_of(st.just(0.0), st.floats(2.0**-20, 2.0**20, width=32))
        indices = data.draw(st.lists(st.integers(0, highest), min_size=size, max_size=size))
        values = data.draw(st.lists(value, min_size=size, max_size=size))
        self.tree = set_leaves(self.tree, np.array(indices, np.int32), np.array(values, np.float32))
        for index in set(indices):
            if index < len(self.leaves):
                self.leaves[index] = max(v for i, v in zip(indices, values, strict=True) if i == index)

    @rule()
    def set_all_to_zero(self):
        n = len(self.leaves)
        self.tree = set_leaves(self.tree, np.arange(n), np.zeros(n, np.float32))
        self.leaves[:] = 0
        assert float(total(self.tree)) == 0

    @precondition(lambda self: self.leaves.any())
    @rule(seed=st.integers(0, 2**31), batch_size=st.sampled_from((1, 7)))
    def draw_some(self, seed, batch_size):
        indices, probabilities = map(np.asarray, draw(self.tree, jax.random.key(seed), batch_size))
        assert (self.leaves[indices] > 0).all(), "drew a leaf of zero, or beyond the last"
        groups = self.leaves.reshape(self.tree.num_groups, -1)
        sums = groups.sum(1, keepdims=True)
        wanted = (groups / np.maximum(sums, 1e-300) / np.count_nonzero(sums)).ravel()
        np.testing.assert_allclose(probabilities, wanted[indices], rtol=1e-5)
        ends = np.cumsum(wanted)
        starts = ends - wanted
        strata = np.arange(batch_size + 1) / batch_size
        assert (starts[indices] <= strata[1:] + 1e-5).all(), "drew a leaf that lies behind its stratum"
        assert (ends[indices] >= strata[:-1] - 1e-5).all(), "drew a leaf that lies before its stratum"

    @invariant()
    def is_the_same(self):
        if not hasattr(self, "tree"):
            return
        check_valid(self.tree)
        np.testing.assert_array_equal(get_leaves(self.tree), np.append(self.leaves, [0, 0, 0]).astype(np.float32))
        np.testing.assert_allclose(float(total(self.tree)), math.fsum(self.leaves), rtol=1e-6)


TestAgainstOracle = AgainstOracle.TestCase
TestAgainstOracle.settings = settings(max_examples=40, stateful_step_count=20, derandomize=True)


@partial(jax.jit, donate_argnums=0, static_argnums=2)
def churn(tree: SumTree, key: jax.Array, num_rounds: int) -> SumTree:
    """Batches of 512 random updates over ten orders of magnitude."""

    def some(_, carry):
        tree, key = carry
        key, key_index, key_value = jax.random.split(key, 3)
        indices = jax.random.randint(key_index, (512,), 0, tree.num_leaves)
        return sum_tree.set(tree, indices, 10 ** jax.random.uniform(key_value, (512,), minval=-5, maxval=5)), key

    return jax.lax.fori_loop(0, num_rounds, some, (tree, key))[0]


def test_a_million_updates_leave_the_root_within_float32_rounding():
    tree = churn(sum_tree.init(20_000), jax.random.key(0), 2_000)
    check_valid(tree)
    leaves = np.asarray(get_leaves(tree))[:20_000]
    assert (leaves > 0).all()
    roundings = 4 * 4  # four pairwise additions in each of four levels
    assert abs(float(total(tree)) - math.fsum(leaves)) <= roundings * 2.0**-24 * math.fsum(leaves)
    tree = set_leaves(tree, np.arange(20_000), np.zeros(20_000, np.float32))
    assert not np.asarray(tree.nodes).any(), "something is left of what was taken away"


@pytest.mark.parametrize("batch_size", [1, 64])
def test_frequencies_are_the_priorities(batch_size: int):
    """Chi-square, fixed seed. Alone, draws are independent: they may fit neither too badly nor too well."""
    values = np.random.default_rng(1).exponential(size=300) * (np.arange(300) % 3 > 0)
    tree, keys = tree_of(values), jax.random.split(jax.random.key(2), 64_000 // batch_size)
    indices = jax.jit(jax.vmap(lambda key: sum_tree.sample(tree, key, batch_size)[0]))(keys)
    counts = np.bincount(np.asarray(indices).ravel(), minlength=300)
    assert not counts[values == 0].any()
    drawable = values > 0
    expected = values[drawable] / values.sum() * 64_000
    p_value = stats.chisquare(counts[drawable], expected * counts.sum() / expected.sum()).pvalue
    assert p_value > 0.001
    if batch_size == 1:
        assert p_value < 0.999


def test_groups_get_equal_shares_whatever_their_priorities():
    """Chi-square, fixed seed: group sums are 1e-3, 1 and 1e5, one group is empty; within a group draws follow it."""
    rng = np.random.default_rng(5)
    values = rng.exponential(size=(4, 100)) * np.array([[1e-5], [0], [1e-2], [1e3]])
    tree = set_leaves(sum_tree.init(400, 4), np.arange(400), values.ravel().astype(np.float32))
    keys = jax.random.split(jax.random.key(6), 1_000)
    indices = jax.jit(jax.vmap(lambda key: sum_tree.sample(tree, key, 64)[0]))(keys)
    counts = np.bincount(np.asarray(indices).ravel(), minlength=400).reshape(4, 100)
    assert np.abs(counts.sum(1) - np.array([1, 0, 1, 1]) * 64_000 / 3).max() <= 1_000
    for group in (0, 2, 3):
        expected = values[group] / values[group].sum() * counts[group].sum()
        assert stats.chisquare(counts[group], expected).pvalue > 0.001


def test_a_million_leaves_are_drawn_in_proportion_and_those_of_zero_never():
    """2^20 leaves over ten orders of magnitude, a third of them zero: 2^23 draws, fixed seed.

    Leaves are counted in 4,096 intervals of 256, and by size in 30 bins of equal expectation, so that neither a place
    nor a size is drawn more often than its share. Draws are stratified, so the counts of intervals vary less than
    independent ones would: each lies within 2 of what is expected for every one of the 8 batches.
    """
    rng, num_leaves, batch_size, num_batches = np.random.default_rng(3), 2**20, 2**20, 8
    values = (10 ** rng.uniform(-5, 5, num_leaves) * (rng.random(num_leaves) > 1 / 3)).astype(np.float32)
    tree = tree_of(values)
    check_valid(tree)
    exact = math.fsum(values)
    assert abs(float(total(tree)) - exact) <= 4 * 5 * 2.0**-24 * exact  # four additions in each of five levels
    keys = jax.random.split(jax.random.key(4), num_batches)
    drawn = [np.asarray(draw_many(tree, key, batch_size)[0]) for key in keys]
    counts = np.bincount(np.concatenate(drawn), minlength=num_leaves)
    assert counts.size == num_leaves
    assert not counts[values == 0].any(), "drew a leaf of zero"

    expected = values.astype(np.float64) / exact * batch_size * num_batches
    by_place, expected_by_place = (a.reshape(-1, 256).sum(1) for a in (counts, expected))
    assert np.abs(by_place - expected_by_place).max() < 2 * num_batches

    order = np.argsort(values)
    bins = (np.cumsum(expected[order]) / expected.sum() * 30).astype(int).clip(0, 29)
    by_size, expected_by_size = (np.bincount(bins, weights=a[order], minlength=30) for a in (counts, expected))
    assert stats.chisquare(by_size, expected_by_size).pvalue > 0.001


def test_strata_divide_the_batch_evenly():
    indices, probabilities = draw(tree_of(np.full(32, 0.25)), jax.random.key(0), 32)
    np.testing.assert_array_equal(indices, np.arange(32))
    np.testing.assert_allclose(probabilities, 1 / 32)


def test_a_leaf_below_the_rounding_step_of_the_total_gets_its_share():
    """4096 leaves of 1/256 behind one of 2^20, where float32 steps are 1/8: without the finer bits only every 32nd
    of them could ever be drawn."""
    tree = tree_of([2.0**20, *[2.0**-8] * 4096])
    hits = [np.asarray(draw_many(tree, jax.random.key(seed), 2**17)[0]) for seed in range(24)]
    small = np.concatenate(hits)
    small = small[small > 0]
    expected = 24 * 2**17 * 16 / (2**20 + 16)
    assert abs(len(small) - expected) < 4 * expected**0.5
    assert len(np.unique(small % 32)) > 16


def draw_of(tree: SumTree, monkeypatch: pytest.MonkeyPatch, point: float, finer_bits: float) -> tuple[int, float]:
    """The last leaf that is drawn, and its probability, if all random numbers of a draw are these."""
    numbers = np.float32([[point], [finer_bits]])
    monkeypatch.setattr(jax.random, "uniform", lambda _, shape: jnp.broadcast_to(numbers, shape))
    indices, probabilities = sum_tree.sample(tree, jax.random.key(0), 4)
    return int(indices[-1]), float(probabilities[-1])


@pytest.mark.parametrize("num_groups", [1, 4])
def test_the_finer_bits_reach_from_one_point_to_the_next(num_groups: int, monkeypatch: pytest.MonkeyPatch):
    """The last point of a batch of 4 is a multiple of 2^-24 of the total, which is that of all groups: 2^-22 of one of
    four. A group is as above, where 2^-24 are 16 leaves.
    """
    group = np.float32([2.0**20, *[2.0**-8] * 4096])
    size = len(group) * num_groups
    tree = set_leaves(sum_tree.init(size, num_groups), np.arange(size), np.tile(group, num_groups))
    point = 1 - 4 / num_groups * 2.0**-19
    leaves = [draw_of(tree, monkeypatch, point, bits)[0] for bits in (0.0, 1 - 2.0**-24)]
    assert np.diff(leaves) == pytest.approx(16 * num_groups, abs=2)


@pytest.mark.parametrize("num_groups", [1, 3])
def test_a_point_that_rounds_to_the_end_of_the_last_part_draws_the_last_leaf(
    num_groups: int, monkeypatch: pytest.MonkeyPatch
):
    """3 and the largest float below 1 are 4 in float32, and 4 / 4 is the end of all leaves."""
    tree = set_leaves(sum_tree.init(30, num_groups), np.arange(30), np.ones(30, np.float32))
    almost_one = 1 - 2.0**-24
    assert draw_of(tree, monkeypatch, almost_one, almost_one) == (29, pytest.approx(1 / 30))


def test_a_target_at_the_end_of_a_row_finds_the_last_positive_child():
    """Rounding can carry a target to the sum of its row; one draw in 10^5 or less, so the row is asked directly."""
    row = np.zeros((4, FANOUT), np.float32)
    row[:, 2], row[:, 5] = 1.0, 2.0
    target = np.array([0.0, 1.0, 3.0, 4.0], np.float32)
    child, start, value = sum_tree._choose_child(jnp.asarray(row), jnp.asarray(target))
    np.testing.assert_array_equal(child, [2, 5, 5, 5])
    np.testing.assert_array_equal(start, [0, 1, 1, 1])
    np.testing.assert_array_equal(value, [1, 2, 2, 2])


def test_the_largest_of_repeated_values_wins_in_any_order():
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [1, 3, 0, 2]):
        indices, values = np.array([5, 5, 7, 5])[order], np.array([1, 4, 9, 2], np.float32)[order]
        tree = set_leaves(tree_of(np.full(20, 3.0)), indices, values)
        leaves = get_leaves(tree)
        assert (leaves[5], leaves[7], total(tree)) == (4, 9, 18 * 3 + 4 + 9)


def test_all_zero_priorities_are_refused_with_nan():
    indices, probabilities = draw(sum_tree.init(50), jax.random.key(0), 4)
    assert np.isnan(probabilities).all()
    assert ((indices >= 0) & (indices < 50)).all()


def test_an_empty_tree_cannot_be_made():
    with pytest.raises(ValueError, match="sum tree: got num_leaves 0, want at least 1"):
        sum_tree.init(0)
    with pytest.raises(ValueError, match="sum tree: got num_groups 3, want a divisor of num_leaves 10"):
        sum_tree.init(10, 3)


def test_donation_writes_in_place():
    tree = tree_of(np.ones(10_000))
    address = tree.nodes.unsafe_buffer_pointer()
    for _ in range(3):
        tree = set_leaves(tree, np.arange(8), np.ones(8, np.float32))
        assert tree.nodes.unsafe_buffer_pointer() == address


@pytest.mark.parametrize(
    ("node", "value", "message"),
    [
        (-24, -1.0, "leaf 88 is -1.0, want a finite number of at least 0"),
        (-24, np.nan, "leaf 88 is nan, want"),
        (-1, 1.0, "padding after leaf 99 is"),
        (3, 7.0, "node 3 is 7.0, its children are 16.0"),
        (15, 1e-3, "node 15 is 0.0010000000474974513, its children are 0.0"),
    ],
)
def test_check_valid_names_what_is_wrong(node: int, value: float, message: str):
    tree = tree_of(np.ones(100))
    check_valid(tree)
    broken = SumTree(nodes=tree.nodes.at[node].set(value), num_leaves=100)
    with pytest.raises(ValueError, match=f"sum tree: {message}"):
        check_valid(broken)
