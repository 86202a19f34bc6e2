"""One Rainbow agent on the 16 training tasks of the four scenarios, small enough for two CPU cores.

Against `rainbow_quick`: the actions of `unified_v1`, a larger network, which sees the game variables and its past
actions, rewards scaled to one size of return, equal shares of every batch for all games, and losses weighted by the
tasks' scores. `--agent.task-conditioned` tells the policy which task it plays; then it cannot play any other.
"""

from gvz.core.env_config import EnvConfig
from gvz.run.config import CheckpointConfig, RunConfig
from gvz.tasks import named_tasks
from learner.agents.configs.rainbow import RainbowConfig
from learner.config import LearnerConfig, ReplayConfig

SCENARIOS = ("defend_the_center", "dodge_projectiles", "health_gathering", "seek_and_kill")

CONFIG = RunConfig(
    name="rainbow_all",
    tasks=tuple(task.id for scenario in SCENARIOS for task in named_tasks(scenario, split="train4")),
    env=EnvConfig(frame_height=48, frame_width=84, grayscale=True, action_set="unified_v1"),
    agent=RainbowConfig(
        conv_channels=(16, 32),
        conv_kernels=(8, 4),
        conv_strides=(4, 2),
        hidden_units=256,
        past_actions=8,
        game_variables=True,
        scale_rewards=True,
    ),
    replay=ReplayConfig(capacity=160_000, importance_sampling_exponent_end=0.4, equal_shares=True),
    learner=LearnerConfig(
        total_updates=60_000,
        warmup_steps=8_000,
        learning_rate=5e-4,
        target_period_updates=1_000,
        average_ema=0.999,
        kpi_weighting=True,
    ),
    checkpoint=CheckpointConfig(period_updates=10_000),
)
