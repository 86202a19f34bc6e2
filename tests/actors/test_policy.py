"""Policies: the learner's function by way of bytes, or chance; the same numbers for the same seed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fake_env import export_act

from actors.policy import ExportedPolicy, RandomPolicy
from actors.preprocess import ObservationBatch
from gvz.transport.messages import ParamsHeader

BATCH, NUM_ACTIONS = 3, 7


def act(params, obs, key, epsilon):
    """Greedy: the second parameter + task + the observation's sum; with probability epsilon a random action."""
    frames, task = obs["frames"].astype(jnp.int32), obs["task"]
    greedy = (params[1][0].astype(jnp.int32) + task + frames.sum((1, 2, 3))) % NUM_ACTIONS
    explore_key, action_key = jax.random.split(jax.random.wrap_key_data(key))
    explore = jax.random.bernoulli(explore_key, epsilon, (BATCH,))
    return jnp.where(explore, jax.random.randint(action_key, (BATCH,), 0, NUM_ACTIONS), greedy)


@pytest.fixture(scope="module")
def serialized() -> bytes:
    return export_act(act, [(1, 1), (1,)], OBSERVED)


def header(epsilon: float) -> ParamsHeader:
    return ParamsHeader(version=1, num_updates=1, epsilon=epsilon)


OBSERVED = ObservationBatch(BATCH, (4, 5, 3), 2)
OBS = OBSERVED.arrays
OBS["frames"][:] = np.random.default_rng(0).integers(0, 256, OBS["frames"].shape, np.uint8)
OBS["task"][:] = [0, 1, 2]
FRAMES, TASK = OBS["frames"], OBS["task"]


def test_the_function_is_called_with_the_newest_parameters(serialized: bytes):
    policy = ExportedPolicy(serialized, 2, OBS, seed=0)
    for value in (3.0, 5.0):
        policy.set_params(np.array([0.0, value], np.float32), header(0.0))
        wanted = (value + TASK + FRAMES.sum((1, 2, 3), dtype=np.int64)) % NUM_ACTIONS
        action, extras = policy.act(OBS)
        assert extras.shape == (BATCH, 0)
        assert action.dtype == np.int32
        np.testing.assert_array_equal(action, wanted)


def draws(policy: ExportedPolicy | RandomPolicy, count: int) -> list[list[int]]:
    return [policy.act(OBS)[0].tolist() for _ in range(count)]


@pytest.mark.parametrize("kind", ["exported", "random"])
def test_choices_follow_from_seed_and_call_number_alone(serialized: bytes, kind: str):
    def make(seed: int):
        games = len(OBS["task"])
        exported = kind == "exported"
        policy = ExportedPolicy(serialized, 2, OBS, seed) if exported else RandomPolicy(NUM_ACTIONS, games, seed)
        policy.set_params(np.zeros(2, np.float32), header(1.0))
        return policy

    first = draws(make(5), 300)
    assert draws(make(5), 300) == first
    assert draws(make(6), 300) != first
    assert len({tuple(d) for d in first}) > 150, "every call has a key of its own"
    late = make(5)
    late.num_calls = 200
    assert draws(late, 100) == first[200:]


def test_epsilon_is_the_share_of_random_actions(serialized: bytes):
    policy = ExportedPolicy(serialized, 2, OBS, seed=0)
    policy.set_params(np.zeros(2, np.float32), header(0.5))
    greedy = (TASK + FRAMES.sum((1, 2, 3), dtype=np.int64)) % NUM_ACTIONS
    share = np.mean(np.array(draws(policy, 400)) != greedy)
    assert share == pytest.approx(0.5 * (NUM_ACTIONS - 1) / NUM_ACTIONS, abs=0.05)  # 3.5 standard deviations


def test_chance_is_uniform():
    policy = RandomPolicy(NUM_ACTIONS, BATCH, seed=1)
    counts = np.bincount(np.array(draws(policy, 2000)).ravel(), minlength=NUM_ACTIONS)
    assert counts.size == NUM_ACTIONS
    np.testing.assert_allclose(counts / counts.sum(), 1 / NUM_ACTIONS, atol=0.02)  # 4 standard deviations


def test_chance_keeps_to_the_mask_and_is_uniform_within_it():
    """Four standard deviations of 4,000 draws."""
    masks = [[True] * NUM_ACTIONS, [False, True, False, False, True, False, True]]
    observed = ObservationBatch(2, (4, 5, 3), 1, action_masks=masks)
    for game in range(2):
        observed.begin(game, game, np.zeros((4, 5, 3), np.uint8), {})
    policy = RandomPolicy(NUM_ACTIONS, 2, seed=1)
    drawn = np.array([policy.act(observed.arrays)[0] for _ in range(4000)])
    for game, mask in enumerate(masks):
        shares = np.bincount(drawn[:, game], minlength=NUM_ACTIONS) / 4000
        np.testing.assert_allclose(shares, np.array(mask) / sum(mask), atol=0.03)
        assert not shares[~np.array(mask)].any()


def test_a_function_for_other_games_is_refused_at_once(serialized: bytes):
    with pytest.raises(ValueError, match="acting function: it takes 2 parameters, want 3"):
        ExportedPolicy(serialized, 3, OBS, seed=0)
    with pytest.raises(ValueError, match="Shape mismatch"):
        ExportedPolicy(serialized, 2, ObservationBatch(BATCH + 1, (4, 5, 3), 2).arrays, seed=0)
