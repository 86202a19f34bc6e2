"""A run's configuration reaches its learner: sizes of the records that are kept, and how batches are drawn of them."""

from pathlib import Path

import pytest

from actors.config import ActorsConfig
from gvz.core.env_config import EnvConfig
from gvz.run.assemble import assemble
from gvz.run.config import RunConfig
from gvz.run.group_config import GroupConfig
from learner.agents.configs.ppo import PPOConfig
from learner.agents.configs.rainbow import RainbowConfig
from learner.config import LearnerConfig, OnPolicyConfig, ReplayConfig
from learner.off_policy import OffPolicyParts
from learner.on_policy import OnPolicyParts
from learner.replay import ReplaySpec
from learner.rollouts import RolloutSpec

OBSERVED = {
    "discount": 0.9,
    "stack_size": 3,
    "past_actions": 5,
    "game_variables": True,
    "scale_rewards": True,
    "conv_channels": (2,),
    "conv_kernels": (8,),
    "conv_strides": (8,),
    "hidden_units": 4,
}


def run_of(**fields) -> RunConfig:
    """Two tasks of two scenarios, three games of each."""
    return RunConfig(
        name="two",
        tasks=("defend_the_center/default", "health_gathering/default"),
        env=EnvConfig(frame_height=24, frame_width=32, action_set="unified_v1"),
        actors=ActorsConfig(num_actors=3, games_per_actor=2),
        **fields,
    )


def sizes_of(config: RunConfig) -> dict[str, object]:
    """What the store of its records is to have; masks and scales are of the tasks."""
    table = config.table
    assert table.action_masks is not None
    assert table.reward_scales is not None
    return {
        "num_lanes": 6,
        "frame_shape": (24, 32, 3),
        "num_tasks": 2,
        "stack_size": 3,
        "num_past_actions": 5,
        "num_variables": len(table.variables),
        "action_masks": table.action_masks,
        "reward_scales": table.reward_scales,
    }


@pytest.mark.parametrize("prioritized", [True, False])
def test_a_replay_has_every_setting_of_the_run(prioritized: bool, tmp_path: Path):
    drawn = {"priority_exponent": 0.7, "min_priority": 0.2} if prioritized else {}
    replay = ReplayConfig(capacity=777, prioritized=prioritized, equal_shares=True, num_newest=3, **drawn)
    learner = LearnerConfig(warmup_steps=100, num_updates_per_call=5)
    agent = RainbowConfig(**OBSERVED, n_steps=2, sight_weight=0.5)
    group = GroupConfig(num_processes=2, process_id=1, coordinator="here:1")
    config = run_of(agent=agent, replay=replay, learner=learner, group=group)
    made = assemble(config, tmp_path)
    parts, footprint = made.learner, made.footprint
    assert made.pool_config.seed == config.games_seed != config.seed
    assert (footprint.num_actors, footprint.num_games, footprint.replay_bytes) == (3, 6, parts.device_bytes())
    assert isinstance(parts, OffPolicyParts)
    assert parts.replay_spec == ReplaySpec(
        **sizes_of(config),
        num_sights=5 * 12,
        capacity=777,
        n_steps=2,
        discount=0.9,
        priority_exponent=replay.priority_exponent,
        min_priority=replay.min_priority,
        prioritized=prioritized,
        equal_shares=True,
        num_newest=3,
    )
    assert (parts.config, parts.replay_config, parts.num_updates_per_call) == (learner, replay, 5)


def test_rollouts_have_every_setting_of_the_run(tmp_path: Path):
    """PPO records two numbers with an action. A window has room for the 6 records that its first observation reads."""
    learner = OnPolicyConfig(rollout_steps=16)
    config = run_of(agent=PPOConfig(**OBSERVED), replay=None, learner=learner)
    parts = assemble(config, tmp_path).learner
    assert isinstance(parts, OnPolicyParts)
    assert parts.spec == RolloutSpec(**sizes_of(config), num_extras=2, capacity=6 * (6 + 16))
    assert (parts.config, parts.spec.num_steps) == (learner, 16)
