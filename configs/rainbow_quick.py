"""Rainbow on Defend the Center's default task, small enough for two CPU cores to learn it within 20 minutes.

Against `rainbow_4task`: grey frames of 48x84, two small convolutions, 128 hidden units, a higher learning rate, and
replay, warm-up and target period in proportion to a run of 20,000 gradient steps.
"""

from gvz.core.env_config import EnvConfig
from gvz.run.config import CheckpointConfig, RunConfig
from learner.config import AgentConfig, LearnerConfig, ReplayConfig

CONFIG = RunConfig(
    name="rainbow_quick",
    scenario="defend_the_center",
    training_set=1,
    env=EnvConfig(frame_height=48, frame_width=84, grayscale=True),
    agent=AgentConfig(conv_channels=(16, 32), conv_kernels=(8, 4), conv_strides=(4, 2), hidden_units=128),
    replay=ReplayConfig(capacity=50_000),
    learner=LearnerConfig(total_updates=20_000, warmup_steps=2_000, learning_rate=5e-4, target_period_updates=1_000),
    checkpoint=CheckpointConfig(period_updates=5_000),
)
