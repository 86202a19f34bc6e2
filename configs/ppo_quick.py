"""PPO at the size of `rainbow_quick`: same frames and convolutions, for 80,000 decisions.

8 games, 3 epochs and 4 minibatches are the paper's for Atari (Schulman et al. 2017, Table 5); windows have 32 steps
instead of its 128, so that there are 312 rollouts and not 78.
"""

from actors.config import ActorsConfig
from configs.rainbow_quick import CONFIG as RAINBOW
from gvz.run.config import CheckpointConfig, RunConfig
from learner.agents.configs.ppo import PPOConfig
from learner.config import OnPolicyConfig

CONFIG = RunConfig(
    name="ppo_quick",
    scenario=RAINBOW.scenario,
    training_set=RAINBOW.training_set,
    env=RAINBOW.env,
    actors=ActorsConfig(num_actors=2, games_per_actor=4),
    agent=PPOConfig(conv_channels=(16, 32), conv_kernels=(8, 4), conv_strides=(4, 2), hidden_units=128),
    replay=None,
    learner=OnPolicyConfig(total_updates=3_750, rollout_steps=32, num_epochs=3, num_minibatches=4, learning_rate=5e-4),
    checkpoint=CheckpointConfig(period_updates=1_000),
)
