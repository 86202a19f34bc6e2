"""Acting on the learner's device, as a whole: actors, requests, replay, learner."""

from functools import partial
from pathlib import Path

import jax
import pytest

from actors.config import ActorsConfig
from actors.pool import PoolConfig
from actors.process_pool import ProcessPool
from gvz.transport.messages import Fault, ParamsHeader
from learner.acting import DevicePolicy
from learner.agents.base import AgentSpec, OffPolicyAgent, make_agent
from learner.agents.configs.rainbow import RainbowConfig
from learner.config import LearnerConfig, ReplayConfig
from learner.off_policy import OffPolicyParts
from learner.replay import ReplaySpec
from tests.learner.games import catch, greedy_returns

RAINBOW = RainbowConfig(
    conv_channels=(8,), conv_kernels=(3,), conv_strides=(1,), hidden_units=32, stack_size=1, num_atoms=21
)
LEARNER = LearnerConfig(
    learning_rate=2e-3, adam_eps=1e-5, target_period_updates=50, warmup_steps=400, total_updates=1500
)


@pytest.mark.slow
def test_an_agent_that_acts_on_the_learners_device_learns_catch(tmp_path: Path):
    """Rainbow, which explores by noise, in the loop of docs/ARCHITECTURE.md. Its greedy episodes are those of another
    program of the same game. At random the mean return is -0.6.
    """
    game = catch()
    spec = AgentSpec(obs_shape=(8, 5, 1), num_actions=3, num_tasks=1, v_min=-1.5, v_max=1.5)
    agent = make_agent(RAINBOW, spec)
    assert isinstance(agent, OffPolicyAgent)
    pool_config = PoolConfig(
        tasks=("catch",),
        num_actors=2,
        games_per_actor=2,
        seed=1,
        env_entry_point="catch_env:make",
        env_config={},
        frame_shape=(8, 5, 1),
        stack_size=1,
        num_actions=3,
        policy=b"",
        num_params=0,
        layout_hash=0,
        actors=ActorsConfig(inference="device"),
        work_dir=tmp_path,
    )
    replay_spec = ReplaySpec(
        num_lanes=4,
        capacity=4000,
        frame_shape=(8, 5, 1),
        num_tasks=1,
        stack_size=1,
        n_steps=3,
        discount=0.99,
        priority_exponent=0.5,
        min_priority=1e-6,
        prioritized=True,
        num_newest=0,
    )
    parts = OffPolicyParts(
        agent=agent,
        config=LEARNER,
        replay_config=ReplayConfig(),
        replay_spec=replay_spec,
        num_updates_per_call=1,
    )
    learner = parts.make(jax.random.key(1), ["catch"], tmp_path)
    num_updates, env_steps, version = 0, 0, 0
    with ProcessPool(pool_config, None, partial(DevicePolicy, agent)) as pool:
        while num_updates < LEARNER.total_updates:
            if num_updates % 10 == 0 or env_steps < LEARNER.warmup_steps:
                version += 1
                header = ParamsHeader(version=version, num_updates=num_updates, epsilon=learner.epsilon(env_steps))
                pool.publish(learner.acting_params(), header)
            wait_s = 0.0 if learner.can_update() else 0.02
            env_steps += learner.add(pool.drain(min(learner.num_steps_allowed(), 256), wait_s=wait_s), version)
            assert not [message for message in pool.poll() if isinstance(message, Fault)]
            num_updates += learner.update()
    assert greedy_returns(game, agent, learner.params, jax.random.key(2)).mean() > 0.5
