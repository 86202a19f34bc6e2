"""PQN at the size of `rainbow_quick`: same frames and convolutions, for 80,000 decisions.

Windows of 32 steps, two epochs and lambda are the paper's for Atari (Gallici et al. 2024); epsilon falls over a tenth
of the decisions as there. There are 8 games instead of its 128, and 8 minibatches of 32 steps instead of 32 of 128.
"""

from actors.config import ActorsConfig
from configs.rainbow_quick import CONFIG as RAINBOW
from gvz.run.config import CheckpointConfig, RunConfig
from learner.agents.configs.pqn import PQNConfig
from learner.config import OnPolicyConfig

CONFIG = RunConfig(
    name="pqn_quick",
    scenario=RAINBOW.scenario,
    training_set=RAINBOW.training_set,
    env=RAINBOW.env,
    actors=ActorsConfig(num_actors=2, games_per_actor=4),
    agent=PQNConfig(
        conv_channels=(16, 32), conv_kernels=(8, 4), conv_strides=(4, 2), hidden_units=128, epsilon_decay_steps=8_000
    ),
    replay=None,
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
