"""Policies: the learner's function by way of bytes, or chance; the same numbers for the same seed."""

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

from actors.policy import ExportedPolicy, RandomPolicy, make_policy
from gvz.transport.messages import ParamsHeader

BATCH, OBS, NUM_ACTIONS = 3, (3, 4, 5, 6), 7


def act(params, obs, task, key, epsilon):
    """Greedy: the second parameter + task + the observation's sum; with probability epsilon a random action."""
    greedy = (params[1][0].astype(jnp.int32) + task + obs.astype(jnp.int32).sum((1, 2, 3))) % NUM_ACTIONS
    explore_key, action_key = jax.random.split(jax.random.wrap_key_data(key))
    explore = jax.random.bernoulli(explore_key, epsilon, (BATCH,))
    return jnp.where(explore, jax.random.randint(action_key, (BATCH,), 0, NUM_ACTIONS), greedy)


@pytest.fixture(scope="module")
def serialized() -> bytes:
    arguments = (
        [jax.ShapeDtypeStruct((1, 1), jnp.float32), jax.ShapeDtypeStruct((1,), jnp.float32)],
        jax.ShapeDtypeStruct(OBS, jnp.uint8),
        jax.ShapeDtypeStruct((BATCH,), jnp.int32),
        jax.ShapeDtypeStruct((2,), jnp.uint32),
        jax.ShapeDtypeStruct((), jnp.float32),
    )
    return bytes(jax.export.export(jax.jit(act), platforms=["cpu"])(*arguments).serialize())


def header(epsilon: float) -> ParamsHeader:
    return ParamsHeader(version=1, num_updates=1, epsilon=epsilon)


OBSERVATION = np.random.default_rng(0).integers(0, 256, OBS, np.uint8)
TASK = np.array([0, 1, 2], np.int32)


def test_the_function_is_called_with_the_newest_parameters(serialized: bytes):
    policy = ExportedPolicy(serialized, 2, OBS, seed=0)
    for value in (3.0, 5.0):
        policy.set_params(np.array([0.0, value], np.float32), header(0.0))
        wanted = (value + TASK + OBSERVATION.sum((1, 2, 3), dtype=np.int64)) % NUM_ACTIONS
        action = policy.act(OBSERVATION, TASK)
        assert action.dtype == np.int32
        np.testing.assert_array_equal(action, wanted)


def draws(policy: ExportedPolicy | RandomPolicy, count: int) -> list[list[int]]:
    return [policy.act(OBSERVATION, TASK).tolist() for _ in range(count)]


@pytest.mark.parametrize("kind", ["exported", "random"])
def test_choices_follow_from_seed_and_call_number_alone(serialized: bytes, kind: str):
    def make(seed: int):
        data = serialized if kind == "exported" else b""
        policy = make_policy(data, num_actions=NUM_ACTIONS, num_params=2, obs_shape=OBS, seed=seed)
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
    greedy = (TASK + OBSERVATION.sum((1, 2, 3), dtype=np.int64)) % NUM_ACTIONS
    share = np.mean(np.array(draws(policy, 400)) != greedy)
    assert share == pytest.approx(0.5 * (NUM_ACTIONS - 1) / NUM_ACTIONS, abs=0.05)  # 3.5 standard deviations


def test_chance_is_uniform():
    policy = RandomPolicy(NUM_ACTIONS, BATCH, seed=1)
    counts = np.bincount(np.array(draws(policy, 2000)).ravel(), minlength=NUM_ACTIONS)
    assert counts.size == NUM_ACTIONS
    np.testing.assert_allclose(counts / counts.sum(), 1 / NUM_ACTIONS, atol=0.02)  # 4 standard deviations


def test_a_function_for_other_games_is_refused_at_once(serialized: bytes):
    with pytest.raises(ValueError, match="acting function: it takes 2 parameters, want 3"):
        ExportedPolicy(serialized, 3, OBS, seed=0)
    with pytest.raises(ValueError, match="Shape mismatch"):
        ExportedPolicy(serialized, 2, (4, *OBS[1:]), seed=0)
