"""A run directory that was never trained, for commands that read one."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

from gvz.core.env_config import EnvConfig
from gvz.run.assemble import run_agent
from gvz.run.config import RunConfig
from gvz.run.config_files import config_to_dict
from learner import checkpoint
from learner.agents.configs.rainbow import RainbowConfig


@pytest.fixture
def small_run(tmp_path: Path) -> Path:
    """The run small/seed_7 on Defend the Center, with random policies of updates 10 and 20."""
    config = RunConfig(
        name="small",
        seed=7,
        env=EnvConfig(frame_height=24, frame_width=32, grayscale=True),
        agent=RainbowConfig(conv_channels=(4,), conv_kernels=(8,), conv_strides=(4,), hidden_units=8),
    )
    path = tmp_path / "run"
    template = jax.eval_shape(run_agent(config).init, jax.random.key(0))
    for step in (10, 20):
        rng = np.random.default_rng(step)
        params = jax.tree.map(lambda leaf, rng=rng: rng.standard_normal(leaf.shape, np.float32), template)
        checkpoint.write(path / "policies" / str(step), params, {"num_updates": step})
    (path / "config.json").write_text(json.dumps(config_to_dict(config)))
    return path
