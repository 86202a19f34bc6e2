"""Rainbow on Defend the Center's default task, small enough for two CPU cores to learn it within five minutes.

Against `rainbow_4task`: grey frames of 48x84, two small convolutions, 128 hidden units, a higher learning rate,
importance weights with an exponent of 0.4 throughout, a moving average of the parameters for evaluation, and a replay,
warm-up and target period that fit 15,000 gradient steps.
"""

from gvz.core.env_config import EnvConfig
from gvz.run.config import CheckpointConfig, RunConfig
from learner.agents.configs.rainbow import RainbowConfig
from learner.config import LearnerConfig, ReplayConfig

CONFIG = RunConfig(
    name="rainbow_quick",
    scenario="defend_the_center",
    training_set=1,
    env=EnvConfig(frame_height=48, frame_width=84, grayscale=True),
    agent=RainbowConfig(conv_channels=(16, 32), conv_kernels=(8, 4), conv_strides=(4, 2), hidden_units=128),
    replay=ReplayConfig(capacity=50_000, importance_sampling_exponent_end=0.4),
    learner=LearnerConfig(
        total_updates=15_000,
        warmup_steps=2_000,
        learning_rate=5e-4,
        target_period_updates=1_000,
        average_ema=0.999,
    ),
    checkpoint=CheckpointConfig(period_updates=5_000),
)
