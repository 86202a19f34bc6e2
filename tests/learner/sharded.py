"""The learner on four devices against one device, plain lists and float64. Run by test_sharding.py where a processor
counts as four devices.
"""

import itertools
from dataclasses import replace
from functools import cached_property

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from gvz.core.errors import NonFiniteError
from gvz.run.config import change_agent
from learner import checkpoint, replay, sum_tree
from learner.across import Across
from learner.agents.base import make_agent
from learner.agents.configs.rainbow import RainbowConfig
from learner.checkpoint import Restored, snapshot
from learner.config import LearnerConfig, ReplayConfig
from learner.ingest import Ingest
from learner.off_policy import OffPolicyLearner, OffPolicyParts
from learner.replay import ReplayState
from learner.sharding import REPLICATED, SHARDED, _jit, placement
from tests.learner.sum_trees import check_valid
from tests.learner.test_train_step import AGENT, RAINBOW, REPLAY, SPEC, LinearQ
from tests.oracles import ReplayOracle, check_batch, play, step_block

TASKS = ("easy", "hard")
ONES = np.ones(len(TASKS), np.float32)
REPLAY_SPEC = replace(REPLAY, num_lanes=4, capacity=4 * 40, num_sights=3)
LEARNER = LearnerConfig(
    batch_size=16,
    total_updates=100,
    warmup_steps=200,
    env_steps_per_update=4.0,
    target_period_updates=3,
    learning_rate=1e-3,
    step_tolerance=1000,
)
SEVERAL = pytest.mark.parametrize("devices", [2, 4])


def parts_of(devices: int, agent=AGENT, spec=REPLAY_SPEC, **learner) -> OffPolicyParts:
    return OffPolicyParts(
        agent=agent,
        config=replace(LEARNER, devices=devices, **learner),
        replay_config=ReplayConfig(),
        replay_spec=spec,
        num_updates_per_call=1,
    )


def records(count: int, spec=REPLAY_SPEC, lanes: tuple[int, ...] = (0, 1, 2, 3)):
    """Random lanes in turn, each going on with its own stream of episodes, some of which are cut."""
    rng = np.random.default_rng(1)
    streams = [play(rng, spec, lane, mean_steps=8.0) for lane in lanes]
    mixed = (next(streams[rng.integers(len(streams))]) for _ in itertools.count())
    return [replace(record, action=record.action % 3) for record in itertools.islice(mixed, count)]


class Placed:
    """Replay and learner's state as `OffPolicyLearner` holds them."""

    def __init__(self, devices: int, stream, **changes):
        self.parts, self.devices = parts_of(devices, **changes), devices
        self.draws = {}
        self.place, self.each = placement(self.parts), self.parts.of_one_of(devices).replay_spec
        self.state, self.replay = self.place.init(jax.random.key(3))
        ingest = Ingest(self.parts.replay_spec, 16)
        for start in range(0, len(stream), 50):
            for arrays in self.place.blocks(ingest, [step_block(stream[start : start + 50])], 0):
                self.replay = self.place.add(self.replay, arrays)

    def canonical(self):
        return jax.device_get(self.place.canonical(self.state, self.replay)[1])

    def leaves(self) -> np.ndarray:
        tree = self.canonical().tree
        return np.asarray(sum_tree.get(jax.tree.map(jnp.asarray, tree), jnp.arange(tree.num_leaves)))

    def draw(self, key, is_exponent: float, batch_size: int = 16):
        """A batch of all devices with a key that all have; its slots are counted over all lanes."""
        batch, info = jax.device_get(self._draw(is_exponent, batch_size)(self.replay, key))
        offset = np.repeat(np.arange(self.devices) * self.each.num_slots, batch_size // self.devices)
        return batch, replace(info, slots=info.slots + offset)

    def _draw(self, is_exponent: float, batch_size: int):
        """Compiled once for these arguments."""
        if (is_exponent, batch_size) in self.draws:
            return self.draws[is_exponent, batch_size]

        def here(shard, key):
            across, shard = Across(self.devices), self.place._of_shard(shard)
            return replay.sample(self.each, shard, across.own_key(key), batch_size // self.devices, is_exponent, across)

        drawn = _jit(here, self.place._here, (self.place._replay_specs, REPLICATED), SHARDED)
        return self.draws.setdefault((is_exponent, batch_size), drawn)

    def update(self, slots, td_errors) -> None:
        """Sets priorities, on each device of its own part of a batch."""
        self.replay = self._update(self.replay, slots % self.each.num_slots, td_errors)

    @cached_property
    def _update(self):
        def here(shard, slots, td_errors):
            own = self.place._of_shard(shard)
            return self.place._as_shard(
                replay.update_priorities(self.each, own, slots, td_errors, Across(self.devices))
            )

        specs = self.place._replay_specs
        return _jit(here, self.place._here, (specs, SHARDED, SHARDED), specs)

    def train(self, count: int) -> None:
        step = self.place.make_train_step(1)
        for _ in range(count):
            self.state, self.replay = step(self.state, self.replay, jnp.asarray(ONES))


update_one = jax.jit(replay.update_priorities, static_argnums=0)


def varied(placed: Placed, one: Placed) -> None:
    """Gives both the same new priorities, for the slots that were drawn."""
    for seed in range(6):
        _, info = placed.draw(jax.random.key(seed), 1.0)
        td_errors = np.random.default_rng(seed).exponential(3.0, len(info.slots)).astype(np.float32)
        placed.update(info.slots, td_errors)
        one.replay = update_one(one.parts.replay_spec, one.replay, jnp.asarray(info.slots), td_errors)


@pytest.mark.parametrize(("devices", "equal_shares"), [(2, False), (4, False), (4, True)])
def test_shards_hold_the_records_and_priorities_of_one_replay(devices, equal_shares):
    spec = replace(REPLAY_SPEC, equal_shares=equal_shares)
    stream = records(400, spec)
    placed, one = Placed(devices, stream, spec=spec), Placed(1, stream, spec=spec)
    varied(placed, one)
    assert float(one.replay.max_priority) > 1
    chex.assert_trees_all_equal(placed.canonical(), jax.device_get(one.replay))
    check_valid(one.replay.tree)


@SEVERAL
def test_a_batch_is_of_complete_transitions_with_the_probabilities_and_weights_of_plain_lists(devices):
    stream, beta = records(400), 0.6
    placed, one = Placed(devices, stream), Placed(1, stream)
    varied(placed, one)
    oracle = ReplayOracle(REPLAY_SPEC)
    for record in stream:
        oracle.add(record)
    leaves = [float(leaf) for leaf in np.asarray(sum_tree.get(one.replay.tree, jnp.arange(REPLAY_SPEC.num_slots)))]
    each = len(leaves) // devices
    for seed in range(5):
        batch, info = placed.draw(jax.random.key(seed), beta)
        assert set(info.slots) <= oracle.drawable()
        assert [slot // each for slot in info.slots] == [d for d in range(devices) for _ in range(16 // devices)]
        check_batch(batch, [oracle.transition(slot) for slot in info.slots])
        p = [leaves[i] / sum(leaves[i // each * each :][:each]) / devices for i in info.slots]
        np.testing.assert_allclose(info.probabilities, p, rtol=1e-5)
        raw = [(len(oracle.drawable()) * one_p) ** -beta for one_p in p]
        np.testing.assert_allclose(info.weights, [w / max(raw) for w in raw], rtol=1e-5)


def alike():
    """Records that are the same in every lane."""
    return [replace(record, lane=lane) for record in records(120, lanes=(0,)) for lane in range(4)]


def test_devices_draw_by_keys_of_their_own():
    _, info = Placed(4, alike()).draw(jax.random.key(0), 1.0, batch_size=64)
    assert len(np.unique(info.slots.reshape(4, -1) % 40, axis=0)) == 4


def test_where_all_devices_have_the_same_sum_of_priorities_a_draw_is_that_of_one_tree():
    placed, one = Placed(4, alike()), Placed(1, alike())
    leaves = np.float64(np.asarray(sum_tree.get(one.replay.tree, jnp.arange(REPLAY_SPEC.num_slots))))
    wanted = leaves / leaves.sum()
    counts = np.zeros(REPLAY_SPEC.num_slots)
    for seed in range(40):
        _, info = placed.draw(jax.random.key(seed), 1.0, batch_size=128)
        np.testing.assert_allclose(info.probabilities, wanted[info.slots], rtol=1e-5)
        np.testing.assert_allclose(info.weights, 1.0, rtol=1e-5)
        counts += np.bincount(info.slots, minlength=REPLAY_SPEC.num_slots)
    assert not counts[leaves == 0].any()
    drawn = counts[leaves > 0]
    assert stats.chisquare(drawn, drawn.sum() * wanted[leaves > 0]).pvalue > 1e-3


@SEVERAL
def test_the_gradient_is_that_of_the_whole_batch_on_one_device(devices):
    """Adam's first moment after one step is (1 - 0.9) times the gradient, which is worked out sample by sample."""
    stream, agent = records(400), LinearQ(replace(SPEC))
    placed, one = Placed(devices, stream, agent=agent), Placed(1, stream, agent=agent)
    varied(placed, one)
    _, key_sample, _ = jax.random.split(placed.state.key, 3)
    batch, info = placed.draw(key_sample, placed.parts.replay_config.importance_sampling_exponent)
    w = np.float64(placed.state.params["w"])
    factor = {0: 0.5, 1: 2.0}  # of the tasks' losses

    def inputs(obs, i):
        return np.append(np.float64(obs.frames[i, 2, 5]) / 255, 1.0)

    gradient, loss, new_leaves = np.zeros_like(w), 0.0, one_leaves(one)
    for i, slot in enumerate(info.slots):
        x, action = inputs(batch.obs_tm1, i), batch.a_tm1[i]
        td = batch.r_t[i] + batch.discount_t[i] * (w @ inputs(batch.obs_t, i)).max() - w[action] @ x
        weight = info.weights[i] * factor[int(batch.task[i])]
        gradient[action] -= weight * np.clip(td, -1, 1) * x / len(info.slots)
        loss += weight * (td**2 / 2 if abs(td) < 1 else abs(td) - 0.5) / len(info.slots)
        new_leaves[slot] = (abs(td) + REPLAY_SPEC.min_priority) ** REPLAY_SPEC.priority_exponent
    step = placed.place.make_train_step(1)
    placed.state, placed.replay = step(placed.state, placed.replay, jnp.asarray([factor[0], factor[1]], jnp.float32))
    mu = placed.state.opt_state[0].mu["w"]
    np.testing.assert_allclose(np.asarray(mu), 0.1 * gradient, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(float(placed.state.metrics.loss), loss, rtol=1e-5)
    np.testing.assert_allclose(float(placed.state.metrics.grad_norm), np.linalg.norm(gradient), rtol=1e-5)
    np.testing.assert_allclose(placed.leaves(), new_leaves, rtol=1e-4)
    np.testing.assert_array_equal(placed.state.metrics.task_samples, np.bincount(batch.task, minlength=2))


def one_leaves(one: Placed) -> np.ndarray:
    return np.float64(np.asarray(sum_tree.get(one.replay.tree, jnp.arange(REPLAY_SPEC.num_slots))))


VIEWS = {"stack_size": 2, "augmentations": ("shift", "contrast"), "hidden_input_share": 0.5, "past_actions": 2}
AGENTS = {
    "rainbow with augmentations": replace(RAINBOW, **VIEWS),
    "quantiles, munchausen": RainbowConfig(
        **{name: getattr(RAINBOW, name) for name in ("conv_channels", "conv_kernels", "conv_strides", "hidden_units")},
        num_quantiles=4,
        munchausen=True,
    ),
    "dqn": change_agent(RAINBOW, "dqn"),
}


@pytest.mark.parametrize("name", AGENTS)
def test_every_agent_of_transitions_learns_and_all_devices_have_the_same_bits(name):
    config = AGENTS[name]
    spec = replace(REPLAY_SPEC, num_past_actions=config.past_actions, num_newest=4)
    agent = make_agent(config, replace(SPEC, num_past_actions=config.past_actions))
    placed = Placed(4, records(400, spec), agent=agent, spec=spec, target_ema=0.9, average_ema=0.9)
    before = jax.device_get(placed.state.params)
    placed.train(3)
    trained = jax.tree.leaves((placed.state.params, placed.state.average_params, placed.state.opt_state))
    assert all(np.isfinite(leaf).all() for leaf in trained)
    assert not any(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(before), trained, strict=False))
    for leaf in [*trained, placed.replay.max_priority]:
        copies = [np.asarray(shard.data).tobytes() for shard in leaf.addressable_shards]
        assert len(copies) == 4
        assert len(set(copies)) == 1
    assert int(placed.state.non_finite.num_skipped) == 0
    assert placed.state.metrics.task_samples.sum() == 3 * 16


def test_a_device_without_a_transition_counts_for_nothing_and_the_others_for_more():
    placed = Placed(4, records(100, lanes=(0, 2)))
    _, info = placed.draw(jax.random.key(0), 1.0)
    there = np.repeat([True, False, True, False], 4)
    leaves = np.float64(placed.leaves())
    sums = leaves.reshape(4, -1).sum(1)
    p = leaves[info.slots] / np.where(sums > 0, sums, 1)[info.slots // 40] / 2
    np.testing.assert_allclose(info.probabilities[there], p[there], rtol=1e-5)
    np.testing.assert_allclose(info.weights, np.where(there, 2 * p[there].min() / np.where(there, p, 1), 0), rtol=1e-5)
    placed.train(1)
    assert np.isfinite(float(placed.state.metrics.loss))
    assert not placed.leaves().reshape(4, -1)[[1, 3]].any()


def same_newest(state: ReplayState, devices: int) -> set[int]:
    """The anchors that as many devices keep: of its own lanes each the newest quarter, half or all of four."""
    oldest_first = [int(slot) for slot in np.roll(state.newest, -int(state.newest_head)) if slot < 160]
    kept = [[slot for slot in oldest_first if slot * devices // 160 == d][-4 // devices :] for d in range(devices)]
    found = set().union(*kept)
    return found | ({160} if len(found) < 4 else set())


def learner_of(devices: int, tmp_path, restored: Restored | None = None, agent=AGENT) -> OffPolicyLearner:
    spec = replace(REPLAY_SPEC, num_newest=4)
    return parts_of(devices, agent, spec).make(jax.random.key(5), TASKS, tmp_path, restored)


def saved(learner: OffPolicyLearner, tmp_path) -> Restored:
    """Written and read; shapes are the same for any number of devices."""
    checkpoint.write(tmp_path / "1", snapshot(learner.arrays()), learner.state())
    arrays, host = checkpoint.read(tmp_path / "1", learner._parts.array_shapes())
    return Restored(num_updates=0, arrays=arrays, host=host, damage=[])


def test_a_checkpoint_goes_on_with_any_number_of_devices(tmp_path):
    """1 -> 2 -> 4 -> 1: the same records, priorities, parameters; and learning goes on."""
    stream = records(400, replace(REPLAY_SPEC, num_newest=4))
    learner = learner_of(1, tmp_path, agent=LinearQ())
    learner.add([step_block(stream)], 0)
    for devices in (2, 4, 1):
        for _ in range(3):
            assert learner.update() == 1
        before = saved(learner, tmp_path)
        learner = learner_of(devices, tmp_path, before, LinearQ())
        after = snapshot(learner.arrays())
        assert same_newest(before.arrays["replay"], devices) == set(after["replay"].newest)
        for tree in (before.arrays, after):
            tree["replay"] = replace(tree["replay"], newest=np.zeros(4), newest_head=np.zeros(()))
        before.arrays["learner"] = snapshot(before.arrays["learner"])
        chex.assert_trees_all_equal(before.arrays, after)
    assert learner.update() == 1
    learner.check_finite()


def test_a_checkpoint_of_four_devices_goes_on_with_four_bit_for_bit(tmp_path):
    learner = learner_of(4, tmp_path)
    learner.add([step_block(records(400, replace(REPLAY_SPEC, num_newest=4)))], 0)
    for _ in range(2):
        learner.update()
    other = learner_of(4, tmp_path, saved(learner, tmp_path))
    for one in (learner, other):
        for _ in range(3):
            assert one.update() == 1
    assert learner.take_metrics()["learner/loss"] > 0
    chex.assert_trees_all_equal(snapshot(learner.params), snapshot(other.params))


def test_a_train_step_compiles_once_also_after_metrics_were_read(tmp_path):
    learner = learner_of(4, tmp_path)
    learner.add([step_block(records(400, replace(REPLAY_SPEC, num_newest=4)))], 0)
    learner.update()
    assert 0 < learner.take_metrics()["learner/sample_share/easy"] < 1
    compiled = list[str]()
    jax.monitoring.register_event_duration_secs_listener(lambda name, _, **__: compiled.append(name))
    learner.update()
    assert not [name for name in compiled if "compile" in name]
    assert len(learner.acting_params().devices()) == 1


def test_a_number_that_is_not_finite_on_one_device_stops_the_update_on_all_and_the_whole_batch_is_saved(tmp_path):
    learner = learner_of(4, tmp_path)
    learner.add([step_block(records(400, replace(REPLAY_SPEC, num_newest=4)))], 0)
    reward = np.asarray(learner._replay.store.reward).copy()
    reward[:40] = np.nan  # the lanes of device 0
    spoilt = jax.device_put(reward, learner._replay.store.reward.sharding)
    learner._replay = replace(learner._replay, store=replace(learner._replay.store, reward=spoilt))
    before = snapshot(learner.params)
    assert learner.update() == 1
    with pytest.raises(NonFiniteError, match=r"update 1: 4 of 16 losses are NaN"):
        learner.check_finite()
    chex.assert_trees_all_equal(snapshot(learner.params), before)
    assert len(np.load(tmp_path / "nonfinite_batch_1.npz")["r_t"]) == 16
