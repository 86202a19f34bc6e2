"""DQN on four Defend the Center tasks (thesis Algorithm 1, Table 5.1)."""

from dataclasses import replace

from configs.rainbow_4task import CONFIG as RAINBOW
from learner.agents.configs.dqn import DQNConfig
from learner.config import ReplayConfig

CONFIG = replace(
    RAINBOW,
    name="dqn_4task",
    agent=DQNConfig(),
    replay=ReplayConfig(capacity=50_000, prioritized=False),
)
