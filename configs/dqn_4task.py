"""DQN on four Defend the Center tasks (thesis Algorithm 1, Table 5.1)."""

from dataclasses import replace

from configs.rainbow_4task import CONFIG as RAINBOW

CONFIG = replace(
    RAINBOW,
    name="dqn_4task",
    agent=replace(RAINBOW.agent, name="dqn", double=False, dueling=False, noisy="off", distributional=False, n_steps=1),
    replay=replace(RAINBOW.replay, capacity=50_000, prioritized=False),
)
