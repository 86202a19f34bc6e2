"""A run of random policies, small enough to play."""

import json

import jax
import numpy as np

from gvz.core.env_config import EnvConfig
from gvz.run.assemble import run_agent
from gvz.run.config import RunConfig
from gvz.run.config_files import config_to_dict
from learner import checkpoint
from learner.agents.configs.rainbow import RainbowConfig

CONFIG = RunConfig(
    name="small",
    seed=7,
    env=EnvConfig(frame_height=24, frame_width=32, grayscale=True),
    agent=RainbowConfig(conv_channels=(4,), conv_kernels=(8,), conv_strides=(4,), hidden_units=8),
)


def write_policy(run, config, step):
    """Writes random parameters as the policy of a step, and the run's configuration; returns the parameters."""
    rng = np.random.default_rng(step)
    template = jax.eval_shape(run_agent(config).init, jax.random.key(0))
    params = jax.tree.map(lambda leaf: 0.1 * rng.standard_normal(leaf.shape, np.float32), template)
    checkpoint.write(run / "policies" / str(step), params, {"num_updates": step})
    (run / "config.json").write_text(json.dumps(config_to_dict(config)))
    return params
