"""Players: chance, nobody, scripts, functions of frames, in the real game."""

from typing import Any

import numpy as np
import pytest

from gvz.core.env_config import EnvConfig
from gvz.core.errors import ConfigError
from gvz.core.registry import discover
from gvz.env import DoomEnv
from gvz.evaluation.play import play_episode
from gvz.evaluation.players import CLASSES, FramePlayer, IdlePlayer
from gvz.evaluation.scenarios.base import script_of, stated
from gvz.evaluation.simple import player_env
from gvz.tasks import all_scenarios


def play(kind: str, task: str, **fields) -> dict:
    env = DoomEnv(task, player_env(kind, EnvConfig()), **fields)
    try:
        return play_episode(env, CLASSES[kind](), 0)
    finally:
        env.close()


def test_every_scenario_has_a_script_and_a_sweep_of_its_buttons():
    assert discover("gvz.evaluation.scenarios").keys() == {*all_scenarios(), "base"}
    for scenario in all_scenarios().values():
        assert {button for button, _ in stated(scenario.id, "SWEEP")} <= set(scenario.buttons)
        assert callable(script_of(scenario.id))


def test_a_scenario_without_a_script_says_where_to_write_one():
    with pytest.raises(ConfigError, match=r"new: there is no script .* write one in gvz/evaluation/scenarios/new.py"):
        script_of("new")


@pytest.mark.engine
def test_the_script_of_dodge_projectiles_is_the_sweep_episode_by_episode():
    task = "dodge_projectiles/revenants"
    assert play("sweep", task) == play("scripted", task)


@pytest.mark.engine
@pytest.mark.parametrize("scenario", list(all_scenarios()))
def test_a_script_outdoes_doing_nothing(scenario):
    idle, scripted = (play(kind, f"{scenario}/default") for kind in ("idle", "scripted"))
    assert scripted["score"] > 1.5 * idle["score"]
    assert scripted["score"] >= 2


@pytest.mark.engine
def test_a_scripted_episode_can_be_played_again():
    assert play("scripted", "seek_and_kill/mixed_enemies") == play("scripted", "seek_and_kill/mixed_enemies")


@pytest.mark.engine
@pytest.mark.parametrize("kind", ["random", "idle", "sweep"])
def test_who_looks_at_nothing_scores_the_same_at_any_render_size(kind):
    task = "defend_the_center/complete"
    assert play(kind, task) == play(kind, task, render_width=320, render_height=180, recycle_episodes=0)


@pytest.mark.engine
def test_the_idle_player_presses_nothing():
    row = play("idle", "defend_the_center/default")
    assert row["reward_components"]["ammo_spent"] == 0
    env = DoomEnv("seek_and_kill/default", player_env("idle", EnvConfig()))
    player = IdlePlayer()
    observation, info = env.reset(seed=1)
    player.begin(env, observation, info, 1)
    assert env.action_meanings[player.act()] == ()
    env.close()


@pytest.mark.engine
def test_a_function_of_frames_is_given_the_newest_frames_oldest_first():
    seen, frames = [], []

    def choose(stack: np.ndarray) -> int:
        seen.append(stack.copy())
        return len(seen) % 3

    player = FramePlayer(choose, stack_size=3)
    env = DoomEnv("defend_the_center/default", frame_height=24, frame_width=32)
    for seed in (1, 2):
        seen.clear()
        frame, info = env.reset(seed=seed)
        player.begin(env, frame, info, seed)
        frames = [frame] * 3
        for _ in range(5):
            frame, _, _, _, info = env.step(player.act())
            player.observe(frame, info)
            np.testing.assert_array_equal(seen[-1], np.concatenate(frames[-3:], axis=-1))
            frames.append(frame)
    env.close()


@pytest.mark.engine
def test_a_function_of_frames_may_choose_several_buttons():
    env = DoomEnv("defend_the_center/default", action_set="multi_discrete_v1")
    pressed = np.zeros_like(env.action_space.sample())
    try:
        row = play_episode(env, FramePlayer(lambda _stack: pressed), 0)
    finally:
        env.close()
    assert row["length_steps"] > 5


def test_a_function_of_frames_needs_frames_alone():
    with pytest.raises(ConfigError, match="stack_size: got 0, want at least 1"):
        FramePlayer(lambda _stack: 0, stack_size=0)
    buffers: Any = {"screen": np.zeros((4, 4, 3), np.uint8), "depth": np.zeros((4, 4, 1), np.uint8)}
    env: Any = None
    with pytest.raises(ConfigError, match=r"got observations of screen, depth \(env\.buffers\), want frames alone"):
        FramePlayer(lambda _stack: 0).begin(env, buffers, {}, 1)
