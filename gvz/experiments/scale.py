"""Experiments made small: what `--scale` does, all of it.

Budgets shrink in proportion, with floors below which nothing runs. Where budgets alone leave an experiment too large
(starting and compiling a run takes some 20 s, however few its updates), the grid is thinned as well.
"""

import dataclasses
from typing import Any

from gvz.core.errors import ConfigError
from gvz.experiments.base import Experiment
from gvz.run.config import RunConfig

ONE_SEED_BELOW = 0.1
"""a smaller scale has one seed"""
CHECK_BELOW = 0.01
"""a smaller scale is a check of the pipeline: one scenario, one task of a level, small frames and networks"""

MIN_UPDATES = 20
MIN_EPISODES = 2
MIN_CHECKPOINT_PERIOD_UPDATES = 1_000
"""nearer checkpoints are not worth their evaluation; but two there are always"""
MIN_WARMUP_STEPS = 2_048
"""three decisions in each of 682 games; a warm-up that depended on the machine could not be resumed on another"""
MIN_TARGET_PERIOD_UPDATES = 10
MIN_REPLAY_CAPACITY = 16_384
"""room for the games of some 500 actors; a capacity that depended on the machine could not be resumed on another"""

Settings = dict[str, Any]
"""field of RunConfig, dotted -> value"""

CHECK_SETTINGS: Settings = {
    "env.frame_height": 36,
    "env.frame_width": 44,
    "env.grayscale": True,
    "agent.conv_channels": (8, 8),
    "agent.conv_kernels": (8, 4),
    "agent.conv_strides": (4, 2),
    "agent.hidden_units": 32,
}


def scaled(experiment: Experiment, scale: float) -> Experiment:
    """The experiment at a scale.

    Args:
        experiment: at full size.
        scale: 1 leaves it as it is; 0.1 has a tenth of the gradient steps and episodes; see ONE_SEED_BELOW and
            CHECK_BELOW for what else changes.

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
        num_checkpoints=num_checkpoints,
        table_checkpoints=max(1, round(table_share * num_checkpoints)),
        episodes=max(MIN_EPISODES, round(scale * experiment.episodes)),
        seeds=experiment.seeds[:1] if scale < ONE_SEED_BELOW else experiment.seeds,
        scenarios=experiment.scenarios[:1] if scale < CHECK_BELOW else experiment.scenarios,
        tasks_per_level=1 if scale < CHECK_BELOW else experiment.tasks_per_level,
    )


def scaled_settings(config: RunConfig, total_updates: int, scale: float) -> Settings:
    """What a run at a scale has different from its config, beside its budget of updates.

    Args:
        config: the run's, at full size.
        total_updates: of the run, at this scale.
        scale: see `scaled`.
    """
    if scale == 1:
        return {}
    learner = config.learner
    warmup = max(MIN_WARMUP_STEPS, learner.batch_size, round(scale * learner.warmup_steps))
    settings: Settings = {
        "learner.warmup_steps": min(learner.warmup_steps, warmup),
        "learner.target_period_updates": max(MIN_TARGET_PERIOD_UPDATES, round(scale * learner.target_period_updates)),
        "agent.epsilon_decay_steps": max(1, round(scale * config.agent.epsilon_decay_steps)),
        "replay.capacity": min(config.replay.capacity, max(MIN_REPLAY_CAPACITY, round(scale * config.replay.capacity))),
        "log.period_updates": min(config.log.period_updates, max(1, total_updates // 20)),
    }
    return settings | CHECK_SETTINGS if scale < CHECK_BELOW else settings
