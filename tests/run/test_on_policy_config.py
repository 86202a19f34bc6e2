"""Configurations of on-policy agents: which learners fit, and how many decisions a gradient step has."""

import re
from dataclasses import dataclass

import pytest

from gvz.core.errors import ConfigError
from gvz.run.config import RunConfig
from gvz.run.config_files import load_config
from learner.agents.configs.ppo import PPOConfig
from learner.config import OnPolicyConfig


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"agent": PPOConfig()}, "got LearnerConfig and a replay for agent.name 'ppo', which learns on-policy"),
        ({"agent": PPOConfig(), "replay": None}, "got LearnerConfig and no replay for agent.name 'ppo'"),
        (
            {"learner": OnPolicyConfig()},
            "got OnPolicyConfig and a replay for agent.name 'rainbow', which learns from a",
        ),
        ({"replay": None}, "got LearnerConfig and no replay for agent.name 'rainbow'"),
        (
            {
                "agent": PPOConfig(),
                "replay": None,
                "learner": OnPolicyConfig(rollout_steps=5, num_minibatches=3),
                "mode": "sync",
            },
            "learner.num_minibatches: got 3, want a divisor of the 20 steps of a rollout, which are "
            "learner.rollout_steps 5 for each of 4 games",
        ),
    ],
)
def test_an_agent_with_another_agents_learner_is_refused(fields, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        RunConfig(name="x", **fields)


def test_a_loss_of_sight_on_rollouts_is_refused():
    @dataclass(frozen=True, kw_only=True)
    class Seeing(PPOConfig):
        learns_sight = True

    with pytest.raises(
        ConfigError, match=r"'ppo' learns on-policy .*: a loss of sight is for agents that learn from a"
    ):
        RunConfig(name="x", agent=Seeing(), replay=None, learner=OnPolicyConfig())


def test_decisions_for_a_gradient_step_follow_from_the_learner():
    assert load_config("rainbow_4task").env_steps_per_update == 16.0
    assert load_config("ppo_quick").env_steps_per_update == 8 * 32 / (3 * 4)
