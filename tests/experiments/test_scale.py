"""What --scale makes of experiments and of runs."""

import dataclasses

import pytest

from gvz.core.errors import ConfigError
from gvz.experiments.base import experiments
from gvz.experiments.scale import scaled, scaled_settings
from gvz.run.config_files import load_config

FULL = experiments()["training_set_size"]


def test_full_scale_changes_nothing():
    assert scaled(FULL, 1) is FULL
    assert scaled_settings(load_config("rainbow_4task"), 200_000, 1) == {}


def test_a_tenth_has_a_tenth_of_updates_and_episodes_and_keeps_grid_and_checkpoints():
    tenth = scaled(FULL, 0.1)
    assert (tenth.total_updates, tenth.episodes, tenth.num_checkpoints, tenth.table_checkpoints) == (20_000, 10, 20, 5)
    assert len(tenth.runs()) == len(FULL.runs())
    settings = scaled_settings(load_config("rainbow_4task"), 20_000, 0.1)
    assert settings["learner.warmup_steps"] == 2_048  # not below the floor
    assert settings["learner.target_period_updates"] == 300
    assert settings["agent.epsilon_decay_steps"] == 5_000
    assert settings["replay.capacity"] == 16_384  # not below the floor
    assert "env.frame_height" not in settings
    assert scaled(experiments()["general_short"], 0.1).max_processor_s == 90.0


def test_a_scale_makes_nothing_larger_than_the_config_has_it():
    config = load_config("rainbow_quick")
    learner = dataclasses.replace(config.learner, warmup_steps=100)
    config = dataclasses.replace(config, learner=learner, replay=dataclasses.replace(config.replay, capacity=10_000))
    settings = scaled_settings(config, 7_500, 0.5)
    assert (settings["learner.warmup_steps"], settings["replay.capacity"]) == (100, 10_000)


def test_below_a_tenth_there_is_one_seed():
    assert scaled(FULL, 0.05).seeds == (1111,)
    assert len(scaled(FULL, 0.05).scenarios) == 4
    assert (scaled(FULL, 0.05).num_checkpoints, scaled(FULL, 0.05).table_checkpoints) == (10, 2), "a quarter of them"


def test_a_check_of_the_pipeline_has_one_scenario_one_task_a_level_two_checkpoints_and_small_frames():
    check = scaled(experiments()["training_difficulty"], 0.001)
    assert [run.training for run in check.runs()] == ["default", "gore", "fast_enemies+flying_enemies", *_last_two()]
    assert (check.total_updates, check.num_checkpoints, check.table_checkpoints, check.episodes) == (500, 2, 2, 2)
    settings = scaled_settings(load_config("rainbow_4task"), 500, 0.001)
    assert (settings["env.frame_height"], settings["agent.hidden_units"]) == (36, 32)
    assert settings["learner.warmup_steps"] == 2_048


def _last_two() -> list[str]:
    return ["flying_enemies+mossy_bricks+resized_enemies", "complete"]


def test_the_four_experiments_of_a_check_share_a_handful_of_runs():
    names = ("training_difficulty", "training_set_size", "algorithm_comparison", "rainbow_evaluation")
    runs = {run.id for name in names for run in scaled(experiments()[name], 0.001).runs()}
    assert len(runs) == 5 + 3 + 1  # levels, training sets, DQN


@pytest.mark.parametrize("scale", [0, -1, 1.5])
def test_a_scale_outside_its_range_is_refused(scale):
    with pytest.raises(ConfigError, match=rf"--scale: got {scale}, want more than 0 and at most 1"):
        scaled(FULL, scale)
