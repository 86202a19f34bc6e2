"""DQN at the size of `rainbow_quick`: same frames, convolutions, replay, warm-up and updates.

Its exploration falls over 5,000 of 240,000 decisions; `dqn_4task`'s over 50,000 of 3,200,000.
"""

from dataclasses import replace

from configs.rainbow_quick import CONFIG as RAINBOW
from learner.agents.configs.dqn import DQNConfig
from learner.config import ReplayConfig

CONFIG = replace(
    RAINBOW,
    name="dqn_quick",
    agent=DQNConfig(
        conv_channels=(16, 32), conv_kernels=(8, 4), conv_strides=(4, 2), hidden_units=128, epsilon_decay_steps=5_000
    ),
    replay=ReplayConfig(capacity=50_000, prioritized=False),
)
