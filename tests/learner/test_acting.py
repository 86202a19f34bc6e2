"""Acting on the learner's device: as an actor acts on its core."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from scipy import stats

from actors.policy import ExportedPolicy
from actors.preprocess import ObservationBatch
from gvz.transport.messages import ParamsHeader
from learner.acting import DevicePolicy
from learner.agents.base import Agent, AgentSpec, make_agent
from learner.agents.configs.ppo import PPOConfig
from learner.agents.configs.rainbow import RainbowConfig
from learner.config import AgentConfig
from learner.export import export_policy, flatten_params, unflatten_params

GAMES, ACTORS, NUM_ACTIONS = 2, 3, 5
MASKS = ((True,) * NUM_ACTIONS, (False, True, False, True, True))
SPEC = AgentSpec(
    obs_shape=(12, 12, 4), num_actions=NUM_ACTIONS, num_tasks=2, v_min=-1.0, v_max=1.0, num_past_actions=2, masked=True
)
NETWORK = {"conv_channels": (4,), "conv_kernels": (4,), "conv_strides": (2,), "hidden_units": 8}
RAINBOW = RainbowConfig(**NETWORK, num_atoms=5, noisy="off")


def observed(num_games: int, seed: int) -> ObservationBatch:
    """Games of both tasks with different pasts."""
    rng = np.random.default_rng(seed)
    batch = ObservationBatch(num_games, (12, 12, 1), 4, past_actions=2, action_masks=MASKS)
    for game in range(num_games):
        batch.begin(game, game % 2, rng.integers(0, 256, (12, 12, 1), dtype=np.uint8), {})
        for _ in range(game % 4):
            batch.push(game, int(rng.integers(NUM_ACTIONS)), rng.integers(0, 256, (12, 12, 1), dtype=np.uint8), {})
    return batch


def header(version: int, epsilon: float = 0.0) -> ParamsHeader:
    return ParamsHeader(version=version, num_updates=version, epsilon=epsilon)


def flat_params(agent: Agent, seed: int) -> jax.Array:
    return jax.jit(flatten_params)(jax.jit(agent.init)(jax.random.key(seed)))


@pytest.mark.parametrize("config", [RAINBOW, PPOConfig(**NETWORK)], ids=["rainbow", "ppo"])
def test_a_batch_of_all_actors_gets_what_each_actor_would_choose_by_itself(config: AgentConfig):
    """Greedy actions of Rainbow without noise, values of PPO (whose actions are drawn)."""
    agent = make_agent(config, SPEC)
    policy = DevicePolicy(agent, seed=1)
    template = jax.eval_shape(agent.init, jax.random.key(0))
    actors, chosen = [], set()
    for version in (1, 2):
        vector = flat_params(agent, version)
        policy.set_params(vector, header(version))
        batch = observed(ACTORS * GAMES, version).arrays
        action, extras = policy.act(batch)
        assert (action.dtype, action.shape, extras.dtype) == (np.int32, (ACTORS * GAMES,), np.float32)
        assert policy.params_version == version
        for i in range(ACTORS):
            own = {name: array[i * GAMES : (i + 1) * GAMES] for name, array in batch.items()}
            if version == 1:
                serialized = export_policy(agent, template, GAMES)
                actors.append(ExportedPolicy(serialized, vector.size, own, seed=i))
            actors[i].set_params(np.asarray(vector), header(version))
            wanted, wanted_extras = actors[i].act(own)
            rows = slice(i * GAMES, (i + 1) * GAMES)
            if isinstance(config, PPOConfig):
                np.testing.assert_allclose(extras[rows, 0], wanted_extras[:, 0], rtol=1e-4, atol=1e-6)
            else:
                np.testing.assert_array_equal(action[rows], wanted)
        chosen |= set(action.tolist())
    assert len(chosen) > 1


def test_in_warm_up_actions_are_uniform_among_the_allowed_and_every_call_has_a_key_of_its_own():
    policy = DevicePolicy(make_agent(RAINBOW, SPEC), seed=1)
    policy.set_params(flat_params(make_agent(RAINBOW, SPEC), 1), header(1, epsilon=1.0))
    batch = observed(64, 0).arrays
    drawn = np.array([policy.act(batch)[0] for _ in range(30)])
    assert len({tuple(row) for row in drawn.tolist()}) == 30
    for task, mask in enumerate(MASKS):
        counts = np.bincount(drawn[:, task::2].ravel(), minlength=NUM_ACTIONS)
        assert not counts[~np.array(mask)].any()
        assert stats.chisquare(counts[np.array(mask)]).pvalue > 0.001  # the same on every machine: keys draw integers


def test_noise_is_drawn_for_each_game_and_call():
    agent = make_agent(replace(RAINBOW, noisy="factorized", noisy_sigma=5.0), SPEC)
    policy = DevicePolicy(agent, seed=1)
    policy.set_params(flat_params(agent, 1), header(1))
    batch = {name: np.repeat(array[:1], 64, axis=0) for name, array in observed(2, 0).arrays.items()}
    first, second = policy.act(batch)[0], policy.act(batch)[0]
    assert len(set(first.tolist())) > 1, "the same observation, other noise"
    assert (first != second).any()


def test_parameters_come_back_from_their_vector():
    params = make_agent(RAINBOW, SPEC).init(jax.random.key(3))
    back = unflatten_params(jax.eval_shape(lambda: params), flatten_params(params))
    assert jax.tree.structure(back) == jax.tree.structure(params)
    jax.tree.map(np.testing.assert_array_equal, back, params)
