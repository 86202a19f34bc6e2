"""PQN at the size of `rainbow_quick`: same frames and convolutions, for 80,000 decisions.

Windows of 32 steps, two epochs and lambda are the paper's for Atari (Gallici et al. 2024); epsilon falls over a tenth
of the decisions as there. There are 8 games instead of its 128, and 8 minibatches of 32 steps instead of 32 of 128.
"""

from dataclasses import replace

from configs.ppo_quick import CONFIG as PPO
from gvz.run.config import CheckpointConfig
from learner.agents.configs.pqn import PQNConfig
from learner.config import OnPolicyConfig

CONFIG = replace(
    PPO,
    name="pqn_quick",
    agent=PQNConfig(
        conv_channels=(16, 32), conv_kernels=(8, 4), conv_strides=(4, 2), hidden_units=128, epsilon_decay_steps=8_000
    ),
    learner=OnPolicyConfig(
        total_updates=5_000,
        rollout_steps=32,
        num_epochs=2,
        num_minibatches=8,
        learning_rate=5e-4,
        optimizer="radam",
        max_grad_norm=10.0,
    ),
    checkpoint=CheckpointConfig(period_updates=1_250),
)
