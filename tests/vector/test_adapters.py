"""Adapters to other libraries, as far as they can be tried without these (`make test-interop` has them)."""

import importlib
import os
import signal
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from gymnasium.spaces import Box, Discrete
from gymnasium.vector import AutoresetMode

import gvz
from gvz.core.errors import ConfigError
from gvz.vector.adapters.tianshou import TianshouVectorEnv


class FakeVecEnv:
    """What `Sb3VecEnv` needs of Stable-Baselines3's class."""

    def __init__(self, num_envs: int, *_: object):
        self.num_envs, self._seeds = num_envs, [None] * num_envs
        self.metadata = {"render_modes": []}
        self._reset_options()

    def set_options(self, options: dict | list[dict]) -> None:
        self._options = [options] * self.num_envs if isinstance(options, dict) else options

    def _reset_options(self) -> None:
        self._options = [{} for _ in range(self.num_envs)]

    def _reset_seeds(self) -> None:
        self._seeds = [None] * self.num_envs

    def _get_indices(self, indices: int | list[int] | None) -> list[int]:
        return list(range(self.num_envs)) if indices is None else [indices] if isinstance(indices, int) else indices

    def has_attr(self, attr_name: str) -> bool:
        try:
            self.get_attr(attr_name)
        except AttributeError:
            return False
        return True


@pytest.fixture
def sb3_vec_env(monkeypatch):
    name = "gvz.vector.adapters.stable_baselines3"
    for package in ("stable_baselines3", "stable_baselines3.common", "stable_baselines3.common.vec_env"):
        monkeypatch.setitem(sys.modules, package, ModuleType(package))
    sys.modules["stable_baselines3.common.vec_env"].VecEnv = FakeVecEnv
    monkeypatch.delitem(sys.modules, name, raising=False)
    yield importlib.import_module(name).Sb3VecEnv
    sys.modules.pop(name)


@pytest.mark.engine
def test_an_episode_of_stable_baselines3_ends_with_its_own_score(sb3_vec_env):
    """The next one has begun by then, and its score is 0."""
    envs = sb3_vec_env(gvz.make_vec("defend_the_center/fast_enemies", 2, autoreset_mode="SameStep", frame_skip=35))
    envs.reset()
    before, ended = [0.0, 0.0], 0
    while ended < 2:
        envs.step_async(np.zeros(2, np.int64))
        _, _, over, infos = envs.step_wait()
        for game, info in enumerate(infos):
            if over[game]:
                assert info["score"] > before[game] > 0
                assert info["terminal_observation"].shape == envs.envs.single_observation_space.shape
                assert not info["TimeLimit.truncated"], "it died"
                ended += 1
            before[game] = 0.0 if over[game] else info["score"]
    assert envs.get_images() == [None, None]
    envs.close()


@pytest.mark.parametrize("action_set", ["unified_v1", "multi_discrete_v1"])
def test_sb3_contrib_is_told_which_actions_each_game_allows(sb3_vec_env, action_set):
    """Its `is_masking_supported` and `get_action_masks` ask so."""
    tasks = ["defend_the_center/default", "health_gathering/default"]
    envs = sb3_vec_env(gvz.make_vec(tasks, 3, autoreset_mode="SameStep", action_set=action_set))
    assert envs.has_attr("action_masks")
    assert not envs.has_attr("no_such_thing")
    alone = [gvz.make(task, action_set=action_set).action_masks() for task in (*tasks, tasks[0])]
    masks = np.stack(envs.env_method("action_masks"))
    assert masks.dtype == bool
    np.testing.assert_array_equal(masks, alone)
    np.testing.assert_array_equal(envs.env_method("action_masks", indices=[1]), alone[1:2])
    assert (masks[0] != masks[1]).any()
    with pytest.raises(NotImplementedError, match="'reset' cannot be called"):
        envs.env_method("reset")
    envs.close()


@pytest.mark.engine
def test_stable_baselines3_can_render(sb3_vec_env):
    envs = sb3_vec_env(gvz.make_vec("defend_the_center/gore", 2, autoreset_mode="SameStep", render_mode="rgb_array"))
    envs.reset()
    images = envs.get_images()
    assert len(images) == 2
    assert images[0].shape[2] == 3
    assert images[0].dtype == np.uint8
    envs.close()


@pytest.mark.engine
def test_a_video_of_stable_baselines3_has_the_speed_of_the_game(sb3_vec_env):
    """VecVideoRecorder takes it from the metadata, or else 30 pictures per second."""
    envs = sb3_vec_env(gvz.make_vec("defend_the_center/gore", 1, autoreset_mode="SameStep", frame_skip=5))
    assert envs.metadata["render_fps"] == 7
    envs.close()


@pytest.mark.engine
def test_stable_baselines3_chooses_the_seed_of_the_next_episodes(sb3_vec_env):
    envs = sb3_vec_env(gvz.make_vec("seek_and_kill/default", 2, autoreset_mode="SameStep"))
    envs.set_options({"episode_seed": 5})
    frames = envs.reset()
    assert (frames[0] == frames[1]).all()
    assert (envs.reset() != frames).any(axis=(1, 2, 3)).all(), "an option is for one reset"
    for options, message in (
        ([{"episode_seed": 5}, {}], "want the same for all games"),
        ({"reset_mask": np.ones(2, bool)}, "unknown options"),
    ):
        envs.set_options(options)
        with pytest.raises(ValueError, match=message):
            envs.reset()
    envs.close()


def test_stable_baselines3_steps_all_games_together(sb3_vec_env):
    envs = gvz.make_vec("defend_the_center/default", 2, batch_size=1, autoreset_mode="SameStep")
    with pytest.raises(ConfigError, match="got envs with batch_size 1; leave it out"):
        sb3_vec_env(envs)
    envs.close()


@pytest.mark.engine
def test_stable_baselines3_is_told_that_an_episode_ended_because_its_engine_died(sb3_vec_env):
    envs = sb3_vec_env(gvz.make_vec("defend_the_center/default", 2, num_workers=1, autoreset_mode="SameStep"))
    envs._seeds = [1, 2]
    before = envs.reset()
    os.kill(envs.envs._crew.pids[0], signal.SIGKILL)
    envs.step_async(np.zeros(2, np.int64))
    frames, _, over, infos = envs.step_wait()
    assert over.all()
    assert [info["engine_crash"] for info in infos] == [True, True]
    assert [info["TimeLimit.truncated"] for info in infos] == [True, True], "the value of its end is not 0"
    np.testing.assert_array_equal([info["terminal_observation"] for info in infos], before)
    assert (frames != before).any(axis=(1, 2, 3)).all(), "the next episode's first"
    envs.close()


def test_tianshou_has_the_answers_in_the_order_of_its_games_and_the_newest_frame_last():
    sent: list[tuple[int, int]] = []

    def recv() -> tuple[Any, ...]:
        game, action = sent.pop()  # the last one answers first
        games = np.array([game])
        infos = {"env_id": games, "score": 2.0 * games, "engine_crash": games == 0}
        return np.full((1, 1, 1, 1), 10 * game + action, np.uint8), 1.0 * games, games == 1, games == 2, infos

    made: Any = SimpleNamespace(
        metadata={"autoreset_mode": AutoresetMode.DISABLED},
        batch_size=1,
        num_envs=3,
        single_observation_space=Box(0, 255, (1, 1, 1), np.uint8),
        single_action_space=Discrete(9),
        send=lambda actions, games: sent.extend(zip(games.tolist(), actions.tolist(), strict=True)),
        recv=recv,
    )
    envs, games = TianshouVectorEnv(made, num_stack=2), np.array([2, 0, 1])
    envs.step(np.array([1, 2, 3]), games)
    stacks, rewards, terminated, truncated, infos = envs.step(np.array([4, 5, 6]), games)
    assert stacks[..., 0, 0, 0].tolist() == [[21, 24], [2, 5], [13, 16]]
    assert rewards.tolist() == [2.0, 0.0, 1.0]
    assert terminated.tolist() == [False, False, True]
    assert truncated.tolist() == [True, False, False]
    assert infos.tolist() == [
        {"env_id": game, "score": 2.0 * game, "engine_crash": game == 0} for game in games.tolist()
    ]


@pytest.mark.engine
def test_tianshou_seeds_its_games_and_is_told_that_an_episode_ended_because_its_engine_died():
    envs = TianshouVectorEnv(gvz.make_vec("seek_and_kill/default", 2, batch_size=1, autoreset_mode="Disabled"))
    first, infos = envs.reset(seed=7)
    assert [space.contains(stack) for space, stack in zip(envs.observation_space, first, strict=True)] == [True, True]
    assert [info["env_id"] for info in infos] == [0, 1]
    assert (envs.reset(seed=7)[0] == first).all()
    seeds = envs.seed(7)
    assert seeds == [[7], [8]]
    second = envs.reset()[0]
    assert (second != first).any()
    envs.seed(7)
    assert (envs.reset()[0] == second).all()
    one, _ = envs.reset(1, options={"episode_seed": 5})
    assert (envs.reset([1], options={"episode_seed": 5})[0] == one).all()
    with pytest.raises(TypeError, match="episode_seed"):
        envs.reset(episode_seed=5)
    with pytest.raises(ValueError, match="numbers from 0 to 1"):
        envs.reset(2)
    _, _, terminated, truncated, infos = envs.step(np.zeros(2, np.int64))
    assert not (terminated | truncated).any()
    assert [info["engine_crash"] for info in infos] == [False, False]
    assert [info["score"] for info in infos] == [0.0, 0.0]
    os.kill(envs.envs._crew.pids[0], signal.SIGKILL)
    _, _, _, truncated, infos = envs.step(np.zeros(1, np.int64), 0)
    assert truncated.all()
    assert infos[0]["engine_crash"]
    envs.close()


@pytest.mark.engine
def test_tianshou_can_render():
    """Its collectors do, if `collect` has `render`."""
    for mode, shapes in ((None, []), ("rgb_array", [(144, 256, 3)])):
        made = gvz.make_vec("seek_and_kill/red", 1, batch_size=1, autoreset_mode="Disabled", render_mode=mode)
        envs = TianshouVectorEnv(made)
        envs.reset()
        assert [screen.shape for screen in envs.render()] == shapes
        envs.close()


def test_buffers_are_refused_where_tianshous_frames_are_stacked():
    fields = {"batch_size": 1, "autoreset_mode": "Disabled", "buffers": ("depth",)}
    envs = gvz.make_vec("seek_and_kill/red", 1, **fields)
    with pytest.raises(ConfigError, match="TianshouVectorEnv: got envs with buffers, want none"):
        TianshouVectorEnv(envs)
    envs.close()
