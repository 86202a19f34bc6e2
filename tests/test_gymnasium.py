"""The environments as Gymnasium's own: its checker, registration by name, vector environments, wrappers."""

import copy
import dataclasses
import pickle
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.utils.env_checker import check_env

import gvz
from gvz.core.env_config import EnvConfig
from gvz.core.errors import ConfigError
from gvz.env import DoomEnv
from gvz.registration import gymnasium_id, register_envs
from gvz.tasks import named_tasks, parse_task, scenario_named, scenarios
from tests.episodes import TURN

pytestmark = pytest.mark.engine


LATER = tuple(
    parse_task(f"{scenario}/{name}") for scenario in scenarios("extended") for name in ("default", "complete")
)


@pytest.mark.parametrize("task", [*named_tasks(), *LATER], ids=str)
def test_gymnasiums_checker_passes(task):
    env = DoomEnv(task)
    check_env(env, skip_render_check=True)
    env.close()


def test_gymnasiums_checker_passes_in_every_form():
    for fields in (
        {"action_set": "combinations"},
        {"action_set": "unified_v1", "buffers": ("depth",)},
        {"action_set": "multi_discrete_v1"},
        {"grayscale": True},
    ):
        env = DoomEnv("seek_and_kill/default", render_mode="rgb_array", **fields)
        check_env(env, skip_render_check=True)
        env.close()


def test_ids_are_names():
    ids = [gymnasium_id(task) for task in named_tasks()]
    assert len(set(ids)) == len(ids) == 76
    assert gymnasium_id(parse_task("defend_the_center/default")) == "GViZDoom/DefendTheCenter-Default-v0"
    assert (
        gymnasium_id(parse_task("defend_the_center/mossy_bricks+gore"))
        == "GViZDoom/DefendTheCenter-Gore-MossyBricks-v0"
    )
    assert gymnasium_id(parse_task("seek_and_kill/complete")) == "GViZDoom/SeekAndKill-Complete-v0"


def test_a_scenario_with_the_title_of_another_one_is_refused(monkeypatch: pytest.MonkeyPatch):
    """Else an id would play the tasks of whichever scenario came first."""
    copied = dataclasses.replace(scenario_named("seek_and_kill"), id="hunt")
    monkeypatch.setattr("gvz.tasks.all_scenarios", lambda: {"hunt": copied})
    said = r"hunt/default: got the id GViZDoom/SeekAndKill-Default-v0 in Gymnasium, which seek_and_kill/default has"
    with pytest.raises(ConfigError, match=said):
        register_envs()


@pytest.mark.parametrize("task", ["defend_the_center/default", ["defend_the_center/default"]], ids=["one", "several"])
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
def test_a_running_game_is_not_copied_or_pickled_and_a_closed_one_is(copied: Callable[..., object], task: Any):
    env = gvz.make(task, frames="segmented")
    env.reset(seed=1)
    with pytest.raises(TypeError, match="a running game can be neither copied nor pickled; close it, or make another"):
        copied(env)
    env.close()
    copied(env)


@pytest.mark.parametrize("task", ["seek_and_kill/default", ["seek_and_kill/default"]], ids=["one", "several"])
def test_a_copy_is_a_game_of_its_own(task: Any):
    """They had one history of rewards: the distance moved was that between the two agents."""
    env = gvz.make(task)
    other = copy.copy(env)
    rewards = []
    for with_other in (False, True):
        env.reset(seed=1)
        if with_other:
            other.reset(seed=2)
        rewards.append(env.step(2)[1])
    assert rewards[0] == rewards[1]
    env.close()
    other.step(2)
    other.close()


def test_every_named_task_is_registered():
    for task in (*named_tasks(), *named_tasks(suite="extended")):
        spec = gymnasium.spec(gymnasium_id(task))
        assert spec.kwargs == {"task": task.id}
    env = gymnasium.make("GViZDoom/DefendTheCenter-Gore-v0", frame_skip=2, render_mode="rgb_array")
    assert isinstance(env.unwrapped, DoomEnv)
    env.reset(seed=1)
    assert env.step(TURN)[4]["episode_frames"] == 2
    assert env.render().shape == (144, 256, 3)
    env.close()


def test_an_environment_is_made_again_from_the_json_of_its_spec():
    """A configuration became a dict there, which was refused."""
    name = "GViZDoom/SeekAndKill-Default-v0"
    env = gymnasium.make(name, config=EnvConfig(frame_skip=8), buffers=("depth",), reward_weights={"kill": 2.0})
    assert env.spec is not None
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert again.unwrapped.config == env.unwrapped.config
    with pytest.raises(ConfigError, match="unexpected keyword argument 'frame_skp', want one of"):
        gymnasium.make(name, config={"frame_skp": 8})


def test_an_unknown_keyword_is_pythons_own_error():
    """TorchRL's GymEnv tries `frameskip` on every environment, and goes without it after a TypeError of these words."""
    with pytest.raises(TypeError, match="unexpected keyword argument 'frameskip'"):
        gymnasium.make("GViZDoom/SeekAndKill-Default-v0", frameskip=1)


@pytest.mark.parametrize(
    ("imports", "prefix"),
    [
        ("import gymnasium, gvz", ""),
        ("import gvz, gymnasium", ""),
        ("import gvz.core.errors, gymnasium.spaces", ""),
        ("import gvz, importlib.util; importlib.util.find_spec('gymnasium'); import gymnasium", ""),
        ("import gymnasium", "gvz:"),
        ("import gvz, gymnasium", "gvz:"),
    ],
)
def test_ids_are_known_in_whatever_order_of_imports(imports: str, prefix: str):
    code = f"{imports}; env = gymnasium.make('{prefix}GViZDoom/DefendTheCenter-Gore-v0'); print(env.unwrapped.task)"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout.strip() == "defend_the_center/gore", done.stderr


def test_a_vector_environment_resets_itself_and_keeps_the_final_frame():
    envs = gymnasium.vector.SyncVectorEnv(
        [lambda: DoomEnv("defend_the_center/default", frame_skip=35)] * 2,
        autoreset_mode=gymnasium.vector.AutoresetMode.SAME_STEP,
    )
    envs.reset(seed=1)
    for _ in range(40):
        observations, _, terminated, _, infos = envs.step(np.array([TURN, TURN]))
        if terminated.any():
            break
    done = int(terminated.argmax())
    assert infos["final_obs"][done].shape == (84, 84, 3)
    assert (infos["final_obs"][done] != observations[done]).any()
    envs.close()


def test_frame_stacking_is_gymnasiums():
    env = gymnasium.wrappers.FrameStackObservation(DoomEnv("defend_the_center/default"), 4)
    observation, _ = env.reset(seed=1)
    assert observation.shape == (4, 84, 84, 3)
    env.close()
