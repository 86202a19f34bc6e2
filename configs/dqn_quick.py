"""DQN at the size of `rainbow_quick`: same frames, convolutions, replay, warm-up and updates.

Its exploration falls over a sixteenth of the run's decisions, as `dqn_4task`'s does over 50,000 of 800,000.
"""

from dataclasses import replace

from configs.rainbow_quick import CONFIG as RAINBOW

CONFIG = replace(
    RAINBOW,
    name="dqn_quick",
    agent=replace(
        RAINBOW.agent,
        name="dqn",
        double=False,
        dueling=False,
        noisy="off",
        distributional=False,
        n_steps=1,
        epsilon_decay_steps=5_000,
    ),
    replay=replace(RAINBOW.replay, prioritized=False),
)
