"""What `--scale` does.

Budgets shrink in proportion, down to the smallest with which runs work. At small scales the grid has fewer runs, too,
because each takes some 20 s to start and compile.
"""

import dataclasses

from gvz.core.errors import ConfigError
from gvz.experiments.base import Experiment
from gvz.run.config import RunConfig, off_policy
from gvz.run.config_files import Settings
from learner.agents.configs.pqn import PQNConfig
from learner.config import ValueConfig

ONE_SEED_BELOW = 0.1
"""a smaller scale has one seed"""
CHECK_BELOW = 0.01
"""a smaller scale is a check of the pipeline: one scenario, one task of a level, small frames and networks"""

MIN_UPDATES = 20
MIN_EPISODES = 2
MIN_CHECKPOINT_PERIOD_UPDATES = 1_000
"""checkpoints are at least this far apart; but there are always two"""
MIN_WARMUP_STEPS = 2_048
"""three decisions in each of 682 games; a warm-up that depended on the machine could not be resumed on another"""
MIN_TARGET_PERIOD_UPDATES = 10
MIN_REPLAY_CAPACITY = 16_384
"""room for the games of some 500 actors; a capacity that depended on the machine could not be resumed on another"""

CHECK_SETTINGS: Settings = {
    "env.frame_height": 36,
    "env.frame_width": 44,
    "agent.conv_channels": (8, 8),
    "agent.conv_kernels": (8, 4),
    "agent.conv_strides": (4, 2),
    "agent.hidden_units": 32,
}


def scaled(experiment: Experiment, scale: float) -> Experiment:
    """The experiment at a scale: 1 leaves it as it is, 0.1 has a tenth of the gradient steps and episodes.

    ONE_SEED_BELOW and CHECK_BELOW say what else changes.

    Raises:
        ConfigError: a scale that is not in (0, 1].
    """
    if not 0 < scale <= 1:
        raise ConfigError(f"--scale: got {scale:g}, want more than 0 and at most 1")
    if scale == 1:
        return experiment
    updates = max(MIN_UPDATES, round(scale * experiment.total_updates))
    num_checkpoints = min(experiment.num_checkpoints, max(2, updates // MIN_CHECKPOINT_PERIOD_UPDATES))
    table_share = experiment.table_checkpoints / experiment.num_checkpoints
    return dataclasses.replace(
        experiment,
        total_updates=updates,
        max_processor_s=None if experiment.max_processor_s is None else scale * experiment.max_processor_s,
        num_checkpoints=num_checkpoints,
        table_checkpoints=max(1, round(table_share * num_checkpoints)),
        episodes=max(MIN_EPISODES, round(scale * experiment.episodes)),
        seeds=experiment.seeds[:1] if scale < ONE_SEED_BELOW else experiment.seeds,
        scenarios=experiment.scenarios[:1] if scale < CHECK_BELOW else experiment.scenarios,
        tasks_per_level=1 if scale < CHECK_BELOW else experiment.tasks_per_level,
    )


def scaled_settings(config: RunConfig, total_updates: int, scale: float) -> Settings:
    """The settings in which a run of so many gradient steps at a scale differs from its config, without that number."""
    if scale == 1:
        return {}
    settings: Settings = {"log.period_updates": min(config.log.period_updates, max(1, total_updates // 20))}
    if not config.agent.on_policy:
        learner, replay = off_policy(config)
        warmup = max(MIN_WARMUP_STEPS, learner.batch_size, round(scale * learner.warmup_steps))
        target_period = round(scale * learner.target_period_updates)
        settings |= {
            "learner.warmup_steps": min(learner.warmup_steps, warmup),
            "learner.target_period_updates": max(MIN_TARGET_PERIOD_UPDATES, target_period),
            "replay.capacity": min(replay.capacity, max(MIN_REPLAY_CAPACITY, round(scale * replay.capacity))),
        }
    if isinstance(config.agent, ValueConfig | PQNConfig):
        settings["agent.epsilon_decay_steps"] = max(1, round(scale * config.agent.epsilon_decay_steps))
    return settings | CHECK_SETTINGS if scale < CHECK_BELOW else settings
