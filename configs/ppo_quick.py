"""PPO at the size of `rainbow_quick`: same frames and convolutions, for 80,000 decisions.

8 games, 3 epochs and 4 minibatches are the paper's for Atari (Schulman et al. 2017, Table 5); windows have 32 steps
instead of its 128, so that there are 312 rollouts and not 78.
"""

from dataclasses import replace

from actors.config import ActorsConfig
from configs.rainbow_quick import CONFIG as RAINBOW
from gvz.run.config import CheckpointConfig
from learner.config import OnPolicyConfig, change_agent

CONFIG = replace(
    RAINBOW,
    name="ppo_quick",
    actors=ActorsConfig(num_actors=2, games_per_actor=4),
    agent=change_agent(RAINBOW.agent, "ppo"),
    replay=None,
    learner=OnPolicyConfig(total_updates=3_750, rollout_steps=32, num_epochs=3, num_minibatches=4, learning_rate=5e-4),
    checkpoint=CheckpointConfig(period_updates=1_000),
)
