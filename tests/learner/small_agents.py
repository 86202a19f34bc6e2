"""A small agent, its batch and made-up parameters, for tests of agents."""

from dataclasses import replace
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from learner.agents.base import Agent, AgentSpec, make_agent
from learner.agents.configs.rainbow import RainbowConfig
from learner.config import ValueConfig
from learner.observation import Observation
from learner.replay import Transitions

B, A = 6, 3
SPEC = AgentSpec(
    obs_shape=(10, 10, 2), num_actions=A, num_tasks=2, v_min=-2.0, v_max=3.0, num_variables=2, num_past_actions=3
)
RAINBOW = RainbowConfig(
    conv_channels=(4,), conv_kernels=(4,), conv_strides=(2,), hidden_units=8, num_atoms=11, noisy_sigma=0.3
)
ALL_OFF = replace(RAINBOW, double=False, dueling=False, noisy="off", distributional=False)


def batch(seed: int = 0) -> Transitions:
    rng = np.random.default_rng(seed)
    obs = rng.integers(0, 256, (2, B, *SPEC.obs_shape), dtype=np.uint8)
    task = jnp.asarray(rng.integers(0, 2, B), jnp.int32)
    actions = rng.integers(-1, A, (2, B, SPEC.num_past_actions))
    vector = rng.normal(0, 50, (2, B, SPEC.num_variables))
    obs_tm1, obs_t = (
        Observation(
            frames=jnp.asarray(obs[i]),
            vector=jnp.asarray(vector[i], jnp.float32),
            actions=jnp.asarray(actions[i], jnp.int32),
            task=task,
        )
        for i in range(2)
    )
    return Transitions(
        obs_tm1=obs_tm1,
        a_tm1=jnp.asarray(rng.integers(0, A, B), jnp.int32),
        r_t=jnp.asarray(rng.normal(size=B), jnp.float32),
        discount_t=jnp.asarray(rng.choice([0.0, 0.97], B), jnp.float32),
        obs_t=obs_t,
    )


@cache
def jitted(config: ValueConfig, spec: AgentSpec = SPEC):
    """The agent, and its functions compiled when first called."""
    agent = make_agent(config, spec)
    return agent, jax.jit(agent.act), jax.jit(agent.evaluate), jax.jit(agent.loss)


def made_up_params(agent: Agent, seed: int, sigma: float = 0.3):
    """Parameters without the compilation of `init`."""
    rng = np.random.default_rng(seed)

    def leaf(path, shape):
        noisy = "sigma" in jax.tree_util.keystr(path)
        return np.full(shape.shape, sigma, np.float32) if noisy else rng.normal(0, 0.2, shape.shape).astype(np.float32)

    return jax.tree_util.tree_map_with_path(leaf, jax.eval_shape(agent.init, jax.random.key(0)))
