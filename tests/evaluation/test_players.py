"""Players: chance, nobody, scripts, policies, in the real game."""

import dataclasses

import jax
import numpy as np
import pytest

from gvz.env import DoomEnv
from gvz.errors import ConfigError
from gvz.evaluation.play import play_episode
from gvz.evaluation.players import PlayerSpec, make_player, player_env
from gvz.evaluation.scripted import SCRIPTS
from gvz.specs import EnvConfig
from gvz.tasks import scenarios
from learner.agents.base import AgentSpec, make_agent
from learner.config import AgentConfig
from learner.policy import export_policy, flatten_params


def play(kind: str, task: str, **fields) -> dict:
    env = DoomEnv(task, player_env(kind, EnvConfig()), **fields)
    try:
        return play_episode(env, make_player(PlayerSpec(kind=kind)), 0)
    finally:
        env.close()


def test_every_scenario_has_a_script():
    assert SCRIPTS.keys() == scenarios().keys()


@pytest.mark.engine
@pytest.mark.parametrize("scenario", list(scenarios()))
def test_a_script_outdoes_doing_nothing(scenario):
    idle, scripted = (play(kind, f"{scenario}/default") for kind in ("idle", "scripted"))
    assert scripted["score"] > 1.5 * idle["score"]
    assert scripted["score"] >= 2


@pytest.mark.engine
def test_a_scripted_episode_can_be_played_again():
    assert play("scripted", "seek_and_kill/mixed_enemies") == play("scripted", "seek_and_kill/mixed_enemies")


@pytest.mark.engine
@pytest.mark.parametrize("kind", ["random", "idle"])
def test_who_looks_at_nothing_scores_the_same_at_any_render_size(kind):
    task = "defend_the_center/complete"
    assert play(kind, task) == play(kind, task, render_width=320, render_height=180, recycle_episodes=0)


@pytest.mark.engine
def test_the_idle_player_presses_nothing():
    row = play("idle", "defend_the_center/default")
    assert row["reward_components"]["ammo_spent"] == 0
    env = DoomEnv("seek_and_kill/default", player_env("idle", EnvConfig()))
    player = make_player(PlayerSpec(kind="idle"))
    observation, info = env.reset(seed=1)
    player.begin(env, observation, info, 1)
    assert env.action_meanings[player.act()] == ()
    env.close()


@pytest.mark.engine
@pytest.mark.parametrize("conditioned", [False, True])
def test_a_policy_acts_greedily_on_the_stack_it_was_trained_on(conditioned):
    config = AgentConfig(
        conv_channels=(4,), conv_kernels=(8,), conv_strides=(4,), hidden_units=8, task_conditioned=conditioned
    )
    tasks = ("defend_the_center/gore", "defend_the_center/default")
    agent = make_agent(config, AgentSpec(obs_shape=(24, 32, 4), num_actions=3, num_tasks=2, v_min=-1, v_max=1))
    params = agent.init(jax.random.key(3))
    spec = PlayerSpec(
        kind="policy",
        policy=export_policy(agent, params, 1, explore=False),
        params=np.asarray(flatten_params(params)),
        obs_shape=agent.spec.obs_shape,
        conditioned_on=tasks if conditioned else (),
    )
    player = make_player(spec)
    env = DoomEnv(tasks[1], frame_height=24, frame_width=32, grayscale=True)
    frame, info = env.reset(seed=1)
    player.begin(env, frame, info, 1)
    stack, task = [frame] * 4, np.array([int(conditioned)], np.int32)
    for _ in range(12):
        wanted = agent.evaluate(params, np.concatenate(stack, axis=-1)[None], task).action
        action = player.act()
        assert action == int(wanted[0])
        frame, _, _, _, info = env.step(action)
        player.observe(frame, info)
        stack = [*stack[1:], frame]
    env.close()


def test_a_policy_without_parameters_is_an_error():
    with pytest.raises(ConfigError, match="want its exported function and its parameters"):
        make_player(dataclasses.replace(PlayerSpec(kind="policy"), policy=b"x"))
