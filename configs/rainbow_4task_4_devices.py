"""`rainbow_4task` on four devices: the batch, and the decisions for a gradient step, are four times as large.

So a decision is learnt from as often as with one device, and every number of gradient steps is a quarter. The learning
rate grows with the square root of the batch, as is usual with Adam. Not measured.
"""

from gvz.run.config import CheckpointConfig, LogConfig, RunConfig
from learner.config import LearnerConfig

CONFIG = RunConfig(
    name="rainbow_4task_4_devices",
    scenario="defend_the_center",
    training_set=4,
    learner=LearnerConfig(
        devices=4,
        batch_size=128,
        env_steps_per_update=64.0,
        step_tolerance=1024,
        total_updates=50_000,
        target_period_updates=750,
        publish_period_updates=3,
        learning_rate=2e-4,
    ),
    checkpoint=CheckpointConfig(period_updates=2_500),
    log=LogConfig(period_updates=25),
)
