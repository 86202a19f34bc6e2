"""The exported acting function is the agent's own, and flat parameters are the tree."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from actors.preprocess import ObservationBatch
from learner.agents.base import AgentSpec, make_agent
from learner.agents.configs.rainbow import RainbowConfig
from learner.export import export_policy, flatten_params, layout_hash
from learner.observation import Observation

SPEC = AgentSpec(obs_shape=(12, 12, 4), num_actions=3, num_tasks=2, v_min=-1.0, v_max=1.0, num_past_actions=2)
CONFIG = RainbowConfig(
    conv_channels=(4,), conv_kernels=(4,), conv_strides=(2,), hidden_units=8, num_atoms=5, noisy_sigma=2.0
)
B = 4


@pytest.fixture(scope="module")
def agent_and_params():
    agent = make_agent(CONFIG, SPEC)
    return agent, jax.jit(agent.init)(jax.random.key(0))


def test_exported_function_acts_as_the_agent_does(agent_and_params):
    agent, params = agent_and_params
    serialized = export_policy(agent, jax.eval_shape(lambda: params), B)
    assert isinstance(serialized, bytes)
    exported = jax.export.deserialize(bytearray(serialized))
    assert exported.platforms == ("cpu",)
    call, act = jax.jit(exported.call), jax.jit(agent.act)
    leaves = jax.tree.leaves(params)
    for i in range(5):
        rng, observed = np.random.default_rng(i), ObservationBatch(B, (12, 12, 1), 4, past_actions=2)
        for game in range(B):
            observed.begin(game, game % 2, rng.integers(0, 256, (12, 12, 1), dtype=np.uint8), {})
            observed.push(game, i % 3, rng.integers(0, 256, (12, 12, 1), dtype=np.uint8), {})
        obs = observed.arrays
        key = jax.random.key(i)
        action, extras = call(leaves, obs, np.asarray(jax.random.key_data(key)), np.float32(0.25))
        assert action.dtype == jnp.int32
        assert extras.shape == (B, 0)
        np.testing.assert_array_equal(action, act(params, key, Observation(**obs), jnp.float32(0.25))[0])


def test_flat_parameters_are_the_leaves_in_tree_order(agent_and_params):
    _, params = agent_and_params
    flat, at = np.asarray(jax.jit(flatten_params)(params)), 0
    for leaf in jax.tree.leaves(params):
        np.testing.assert_array_equal(flat[at : at + leaf.size].reshape(leaf.shape), leaf)
        at += leaf.size
    assert flat.shape == (at,)
    assert flat.dtype == np.float32


def test_layout_hash_tells_paths_shapes_and_dtypes_apart():
    f32 = jax.ShapeDtypeStruct
    base = {"a": {"kernel": f32((2, 3), jnp.float32)}, "b": f32((6,), jnp.float32)}
    others = [
        {"a": {"weight": f32((2, 3), jnp.float32)}, "b": f32((6,), jnp.float32)},
        {"a": {"kernel": f32((3, 2), jnp.float32)}, "b": f32((6,), jnp.float32)},
        {"a": {"kernel": f32((2, 3), jnp.bfloat16)}, "b": f32((6,), jnp.float32)},
        {"a": {"kernel": f32((2, 3), jnp.float32)}},
    ]
    hashes = [layout_hash(tree) for tree in (base, *others)]
    assert len(set(hashes)) == len(hashes)
    assert all(0 <= value < 2**64 for value in hashes)
    assert layout_hash(jax.tree.map(lambda leaf: jnp.ones(leaf.shape, leaf.dtype), base)) == hashes[0]


def test_layout_is_one_for_every_form_of_the_convolution(agent_and_params):
    _, params = agent_and_params
    for form in ("direct", "shifted"):
        agent = make_agent(replace(CONFIG, conv_form=form), SPEC)
        assert layout_hash(jax.eval_shape(agent.init, jax.random.key(0))) == layout_hash(params)
