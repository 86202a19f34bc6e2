"""Agents that learn on-policy: the contract of all there are, what each records, masks, and what is refused."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gvz.core.registry import discover
from learner.agents.base import AgentSpec, OnPolicyAgent, RolloutSteps, Samples, make_agent
from learner.agents.configs.pqn import PQNConfig
from learner.config import agent_config_class
from learner.observation import Observation
from tests.learner import reference
from tests.learner.small_agents import SPEC, A, B, made_up_params

MASKED = replace(SPEC, masked=True)
MASK = np.array([[True, False, True]] * (B - 1) + [[False, True, False]])
NAMES = [
    name
    for name, module in discover("learner.agents").items()
    if hasattr(module, "AGENT") and agent_config_class(name).on_policy
]


def made(name: str, spec: AgentSpec = SPEC):
    config = agent_config_class(name)(
        name=name, conv_channels=(4,), conv_kernels=(4,), conv_strides=(2,), hidden_units=8
    )
    return make_agent(config, spec)


@cache
def jitted(name: str, spec: AgentSpec = SPEC):
    agent = made(name, spec)
    return agent, jax.jit(agent.act), jax.jit(agent.evaluate), jax.jit(agent.losses)


def observation(mask: np.ndarray | None = None) -> Observation:
    rng = np.random.default_rng(0)
    return Observation(
        frames=rng.integers(0, 256, (B, *SPEC.obs_shape), dtype=np.uint8),
        vector=rng.normal(0, 50, (B, 2)).astype(np.float32),
        actions=rng.integers(-1, A, (B, 3)).astype(np.int32),
        task=rng.integers(0, 2, B).astype(np.int32),
        mask=mask,
    )


def samples(agent, params, obs: Observation, act) -> Samples:
    action, extras = act(params, jax.random.key(2), obs, jnp.float32(0.0))
    rng = np.random.default_rng(1)
    steps = RolloutSteps(
        r_t=rng.normal(size=(B, 1)).astype(np.float32),
        terminated=np.zeros((B, 1), bool),
        truncated=np.zeros((B, 1), bool),
        extras_tm1=extras[:, None],
        extras_t=jnp.roll(extras, -1, 0)[:, None],
    )
    targets = jax.tree.map(jnp.ravel, agent.targets(steps))
    return Samples(obs, action, extras, targets, jnp.ones(B))


def test_both_are_discovered():
    assert {"pqn", "ppo"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_every_agent_keeps_the_contract(name: str):
    agent, act, evaluate, losses = jitted(name)
    assert isinstance(agent, OnPolicyAgent)
    assert agent == made(name)
    assert hash(agent) == hash(made(name))
    params = jax.jit(agent.init)(jax.random.key(0))
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(params))
    obs = observation()
    action, extras = act(params, jax.random.key(2), obs, jnp.float32(0.5))
    assert action.shape == (B,)
    assert action.dtype == jnp.int32
    assert extras.shape[0] == B
    assert extras.shape[1] >= 1
    np.testing.assert_allclose(extras[:, 0], 0.0, atol=2e-6, err_msg="the value of a fresh network is 0")
    evaluation = evaluate(params, obs)
    of_actions = evaluation.policy if evaluation.q_values is None else evaluation.q_values
    np.testing.assert_array_equal(evaluation.action, np.asarray(of_actions).argmax(-1))
    batch = samples(agent, params, obs, act)
    result = losses(params, batch)
    for values in (result.loss, *result.metrics.values(), *batch.targets):
        assert values.shape == (B,)
        assert np.isfinite(values).all()
    grads = jax.jit(jax.grad(lambda p: agent.losses(p, batch).loss.mean()))(made_up_params(agent, 0))
    assert all(np.any(leaf) for leaf in jax.tree.leaves(grads))


@pytest.mark.parametrize("name", NAMES)
def test_masked_actions_are_never_taken_and_have_finite_gradients(name: str):
    agent, act, evaluate, _ = jitted(name, MASKED)
    params, obs = made_up_params(agent, 0), observation(MASK)
    for epsilon in (0.0, 1.0):
        for seed in range(40):
            action, _ = act(params, jax.random.key(seed), obs, jnp.float32(epsilon))
            assert MASK[np.arange(B), action].all()
    evaluation = evaluate(params, obs)
    assert MASK[np.arange(B), evaluation.action].all()
    assert evaluation.policy is None or not np.asarray(evaluation.policy)[~MASK].any()
    batch = samples(agent, params, obs, act)
    grads = jax.jit(jax.grad(lambda p: agent.losses(p, batch).loss.mean()))(params)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(grads))


@pytest.mark.parametrize("epsilon", [0.0, 0.3])
def test_ppo_samples_its_policy_and_records_value_and_probability(epsilon: float):
    """With probability epsilon an action is uniformly random; what is recorded counts this in."""
    agent, _, evaluate, _ = jitted("ppo")
    params, obs, K = made_up_params(agent, 3), observation(), 3000
    actions, extras = jax.jit(jax.vmap(lambda key: agent.act(params, key, obs, jnp.float32(epsilon))))(
        jax.random.split(jax.random.key(0), K)
    )
    evaluation = evaluate(params, obs)
    assert evaluation.q_values is None
    probabilities = np.asarray(evaluation.policy)
    np.testing.assert_allclose(probabilities.sum(1), 1.0, rtol=1e-5)
    probabilities = (1 - epsilon) * probabilities + epsilon / A
    shares = np.stack([(np.asarray(actions) == a).mean(0) for a in range(A)], axis=1)
    np.testing.assert_allclose(shares, probabilities, atol=5 * np.sqrt(0.25 / K))
    taken = probabilities[np.arange(B), np.asarray(actions)]
    np.testing.assert_allclose(np.exp(extras[:, :, 1]), taken, rtol=1e-4)
    np.testing.assert_allclose(extras[0, :, 0], evaluation.value, rtol=1e-5, atol=1e-6)


def test_ppo_records_of_a_random_action_its_share_of_the_allowed():
    agent, act, _, _ = jitted("ppo", MASKED)
    _, extras = act(made_up_params(agent, 0), jax.random.key(0), observation(MASK), jnp.float32(1.0))
    np.testing.assert_allclose(np.exp(extras[:, 1]), 1 / MASK.sum(1), rtol=1e-5)


def test_pqn_records_the_largest_value_among_the_allowed():
    agent, act, evaluate, _ = jitted("pqn", MASKED)
    params, obs = made_up_params(agent, 3), observation(MASK)
    _, extras = act(params, jax.random.key(0), obs, jnp.float32(1.0))
    q = np.where(MASK, evaluate(params, obs).q_values, -np.inf)
    np.testing.assert_allclose(extras[:, 0], q.max(1), rtol=1e-5)


SMALL_PQN = PQNConfig(conv_channels=(4,), conv_kernels=(4,), conv_strides=(2,), hidden_units=8)


def test_a_fresh_pqn_gives_every_state_and_action_the_initial_value():
    agent = make_agent(replace(SMALL_PQN, initial_value=2.5), SPEC)
    found = jax.jit(agent.evaluate)(jax.jit(agent.init)(jax.random.key(0)), observation())
    np.testing.assert_allclose(found.q_values, 2.5, atol=2e-6)


def test_pqn_normalizes_its_hidden_layer():
    def layers(config: PQNConfig) -> set[str]:
        return set(jax.eval_shape(make_agent(config, SPEC).init, jax.random.key(0))["params"])

    config = SMALL_PQN
    assert layers(config) - layers(replace(config, layer_norm=False)) == {"q_norm"}
    assert "norm_0" in layers(config), "its encoder's convolutions, too"
    config = replace(config, encoder="nature")
    agent, obs = make_agent(config, SPEC), observation()
    params = made_up_params(agent, 0)
    wanted = reference.network(config, params["params"], obs, A, SPEC.num_tasks)[:, :, 0]
    np.testing.assert_allclose(jax.jit(agent.evaluate)(params, obs).q_values, wanted, rtol=1e-4, atol=1e-5)


def test_epsilon_falls_in_a_line_and_ppo_has_none():
    config = PQNConfig(epsilon_start=0.9, epsilon_end=0.1, epsilon_decay_steps=80)
    assert [config.epsilon(steps) for steps in (0, 40, 80, 1000)] == pytest.approx([0.9, 0.5, 0.1, 0.1])
    assert made("ppo").epsilon(0) == 0.0
