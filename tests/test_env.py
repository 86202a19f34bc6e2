"""A task as an environment: what comes out of it, when it ends, its seeds, its arguments, its window."""

import dataclasses
import json
import re
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path

import cv2
import gymnasium
import numpy as np
import pytest
from gymnasium.error import ResetNeeded

import gvz
from gvz.actions import AXES_V1
from gvz.core.errors import ConfigError, TaskError
from gvz.engine.engine import Engine
from gvz.env import DoomEnv, make_env
from gvz.tasks import parse_task
from tests.episodes import TURN, fingerprint, idle_to_the_end, play

pytestmark = pytest.mark.engine


@pytest.fixture(scope="module")
def shared() -> Iterator[DoomEnv]:
    """One environment for all tests that leave it as good as they found it."""
    env = DoomEnv("defend_the_center/default", render_mode="rgb_array")
    yield env
    env.close()


def make_invulnerable(env: DoomEnv) -> None:
    assert env._engine is not None
    env._engine.command("god")


# ------------------------------------------------------------------------------------------- what comes out


def test_observations_are_the_rendered_screen_made_smaller(shared: DoomEnv):
    observation, _ = shared.reset(seed=1)
    screen = shared.render()
    assert screen is not None
    assert (screen.shape, screen.dtype) == ((144, 256, 3), np.uint8)
    np.testing.assert_array_equal(observation, cv2.resize(screen, (84, 84), interpolation=cv2.INTER_LINEAR))
    again, *_ = shared.step(TURN)
    assert (again != observation).any()


def test_sizes_colours_and_interpolation_are_as_configured():
    fields = {"frame_height": 40, "frame_width": 60, "grayscale": True, "interpolation": "area"}
    env = gvz.make("defend_the_center/default", render_mode="rgb_array", render_width=320, render_height=240, **fields)
    observation, _ = env.reset(seed=1)
    screen = env.render()
    env.close()
    assert screen is not None
    assert screen.shape == (240, 320, 3)
    assert observation.shape == (40, 60, 1)
    small = cv2.resize(screen, (60, 40), interpolation=cv2.INTER_AREA).astype(float)
    luminance = small @ [0.299, 0.587, 0.114]
    assert np.abs(observation[:, :, 0] - luminance).max() <= 1


def test_labels_need_their_buffer(shared: DoomEnv):
    with pytest.raises(ValueError, match="want 'labels' among the buffers"):
        shared.labels()


def test_info_has_everything_and_the_reward_is_the_sum_of_its_components(shared: DoomEnv):
    _, rewards, infos = play(shared, episode_seed=3, max_steps=400)
    assert infos[0]["episode_frames"] == 0
    for reward, info in zip(rewards, infos[1:], strict=True):
        assert reward == pytest.approx(sum(info["reward_components"].values()))
        assert info["score"] == info["episode_frames"]
        assert info["normalized_score"] == pytest.approx(info["score"] / 11)
        assert info["upper_bound"] == 1100
        assert list(info["variables"]) == ["KILLCOUNT", "AMMO2", "HEALTH"]
        assert info["kills"] == info["variables"]["KILLCOUNT"] >= info["player_kills"] >= 0
        assert info["episode_seed"] == 3
        assert info["engine_crash"] is False
    assert infos[-1]["reward_components"]["death"] == -1
    assert infos[-1]["solved_episode"] is False
    assert "solved_episode" not in infos[-2]
    assert sum(r["reward_components"]["ammo_spent"] for r in infos) < 0
    json.dumps(infos)


def test_reward_weights_can_be_chosen():
    env = DoomEnv("defend_the_center/default", reward_weights={"death": -7.0, "kill": 0.5})
    env.reset(seed=1)
    assert idle_to_the_end(env)[-1][4]["reward_components"]["death"] == -7.0
    env.close()
    with pytest.raises(ConfigError, match=r"env.reward_weights: unknown component 'deth' \(did you mean 'death'\?\)"):
        DoomEnv("defend_the_center/default", reward_weights={"deth": 1.0})


def test_kills_are_the_score_where_the_scenario_says_so():
    env = DoomEnv("seek_and_kill/default", frame_skip=35)
    env.reset(seed=1)
    *_, info = env.step(0)
    assert info["score"] == info["kills"]
    assert info["normalized_score"] == 100 * info["kills"] / 20
    env.close()


def test_kills_beyond_the_upper_bound_do_not_score():
    task = parse_task("seek_and_kill/invulnerable")  # enemies kill each other
    few = dataclasses.replace(task.scenario, upper_bounds={"thesis": 1, "levdoom": 1})
    env = DoomEnv(dataclasses.replace(task, scenario=few), frame_skip=35)
    env.reset(seed=1)
    steps = idle_to_the_end(env, action=2)
    for *_, info in steps:
        assert info["score"] == min(info["kills"], 1)
        assert info["normalized_score"] == 100 * info["score"]
        assert type(info["score"]) is type(info["upper_bound"]) is float, "arrays of a vector environment have its type"
    assert steps[-1][4]["kills"] > 1 > steps[-1][4]["player_kills"], "the agent has not shot"
    assert (*steps[-1][2:4], steps[-1][4]["solved_episode"]) == (False, True, False), "to survive is not its objective"
    env.close()


def test_unified_actions_differ_where_they_are_allowed_and_forbidden_ones_do_nothing():
    env = DoomEnv("defend_the_center/default", action_set="unified_v1")
    played = {}
    for action in range(env.action_space.n):
        env.reset(options={"episode_seed": 1})
        played[action] = np.stack([env.step(action)[0] for _ in range(5)])
    env.close()
    allowed = np.flatnonzero(env.action_masks())
    assert [env.action_meanings[a] for a in allowed] == [
        *((), ("ATTACK",), ("TURN_LEFT",), ("TURN_RIGHT",)),
        *(("ATTACK", "TURN_LEFT"), ("ATTACK", "TURN_RIGHT")),
    ]
    assert len({played[action].tobytes() for action in allowed}) == len(allowed)
    assert all((played[action] == played[0]).all() for action in played if action not in allowed)


def test_the_mask_of_a_multi_discrete_action_has_an_entry_for_each_choice_of_each_axis():
    env = DoomEnv("seek_and_kill/default", action_set="multi_discrete_v1")
    assert isinstance(env.action_space, gymnasium.spaces.MultiDiscrete)
    choices = [button for axis in AXES_V1 for button in axis]
    assert len(env.action_masks()) == len(choices) == env.action_space.nvec.sum()
    forbidden = [button for button, allowed in zip(choices, env.action_masks(), strict=True) if not allowed]
    assert forbidden == ["MOVE_BACKWARD", "MOVE_LEFT", "MOVE_RIGHT", "USE"]
    env.close()


def test_a_multi_discrete_action_holds_one_button_of_each_axis():
    one, other = (DoomEnv("seek_and_kill/default", action_set=name) for name in ("multi_discrete_v1", "unified_v1"))
    assert one.action_space == gymnasium.spaces.MultiDiscrete([3, 3, 3, 2, 2, 2])
    for env in (one, other):
        env.reset(options={"episode_seed": 3})
    # turn right, go, strafe left (no such button here), shoot, use (none), do not run
    same = other.action_meanings.index(("ATTACK", "MOVE_FORWARD", "TURN_RIGHT"))
    for _ in range(10):
        assert (one.step(np.array([2, 1, 1, 1, 1, 0]))[0] == other.step(same)[0]).all()
    with pytest.raises(ValueError, match="want integers of MultiDiscrete"):
        one.step(np.array([3, 0, 0, 0, 0, 0]))
    for env in (one, other):
        env.close()


# --------------------------------------------------------------------------------------------- how it ends


def test_death_terminates_with_the_frame_of_its_moment(shared: DoomEnv):
    shared.reset(seed=1)
    steps = idle_to_the_end(shared)
    observation, _, terminated, truncated, info = steps[-1]
    assert (terminated, truncated) == (True, False)
    assert info["variables"]["HEALTH"] <= 0
    red, _, blue = (observation.astype(int) - steps[-2][0]).mean((0, 1))
    assert red > blue, "the screen turns red"
    assert 4 * (len(steps) - 1) < info["episode_frames"] <= 4 * len(steps)
    timeouts = {**shared.task.scenario.timeouts, "thesis": info["episode_frames"]}
    scenario = dataclasses.replace(shared.task.scenario, timeouts=timeouts)
    with closing(DoomEnv(dataclasses.replace(shared.task, scenario=scenario))) as env:
        env.reset(seed=1)
        last = idle_to_the_end(env)[-1]
        assert (*last[2:4], last[4]["solved_episode"]) == (True, False, False), "also in the frame of the time-out"


@pytest.mark.parametrize(("frame_skip", "decisions"), [(4, 275), (7, 158)])
def test_the_time_out_truncates_exactly_there_with_its_own_frame(frame_skip: int, decisions: int):
    env = DoomEnv("defend_the_center/default", render_mode="rgb_array", frame_skip=frame_skip)
    env.reset(seed=1)
    make_invulnerable(env)
    steps = idle_to_the_end(env)
    observation, _, terminated, truncated, info = steps[-1]
    assert len(steps) == decisions
    assert (terminated, truncated) == (False, True)
    assert info["score"] == info["episode_frames"] == 1100
    assert info["normalized_score"] == 100
    assert info["solved_episode"] is True
    assert (observation != steps[-2][0]).any()
    np.testing.assert_array_equal(observation, cv2.resize(env.render(), (84, 84), interpolation=cv2.INTER_LINEAR))
    env.close()


def test_steps_outside_an_episode_are_refused(shared: DoomEnv):
    shared.reset(seed=1)
    idle_to_the_end(shared)
    with pytest.raises(ResetNeeded, match="no episode is running"):
        shared.step(0)
    with pytest.raises(ResetNeeded, match="nothing was rendered, or the environment was closed"):
        DoomEnv("defend_the_center/default", render_mode="rgb_array").render()


# --------------------------------------------------------------------------------------------------- seeds


def test_sticky_actions_hold_the_buttons_of_the_decision_before_with_their_probability(monkeypatch):
    """What was held is read on its way to the engine, and played again without sticky actions: the same episode."""
    held, advance = [], Engine.advance
    monkeypatch.setattr(Engine, "advance", lambda engine, *how: held.append(how[0]) or advance(engine, *how))

    def played(actions: Sequence[int], probability: float) -> list[bytes]:
        with closing(DoomEnv("dodge_projectiles/default", repeat_action_probability=probability)) as env:
            env.reset(options={"episode_seed": 1})
            env.step(1)  # another episode's last decision
            held.clear()
            env.reset(options={"episode_seed": 3})
            return [env.step(action)[0].tobytes() for action in actions]

    actions = np.random.default_rng(0).integers(3, size=80).tolist()
    frames = played(actions, 0.25)
    was_held = [buttons.index(True) for buttons in held]
    could_repeat = [n for n in range(1, 80) if actions[n] != was_held[n - 1]]
    repeated = [n for n in could_repeat if was_held[n] == was_held[n - 1]]
    assert all(was_held[n] == actions[n] for n in range(80) if n not in repeated)
    assert 0.1 <= len(repeated) / len(could_repeat) <= 0.4
    assert played(actions, 0.25) == frames, "an episode's seed decides what is repeated"
    assert played(was_held, 0.0) == frames


@pytest.mark.parametrize(
    "task",
    [
        "defend_the_center/complete",
        "defend_the_center/fuzzy_enemies=0.5",
        "health_gathering/lava+supreme+short_agent",
    ],
)
def test_an_episode_is_replayed_from_its_seed_alone(task: str):
    env = DoomEnv(task)
    first = fingerprint(env, 7)
    assert fingerprint(env, 8) != first
    assert fingerprint(env, 7) == first, "after another episode"
    env.close()
    recycled = DoomEnv(task, recycle_episodes=1)
    assert fingerprint(recycled, 8) != first
    assert fingerprint(recycled, 7) == first, "in a recycled engine"
    recycled.close()
    code = (
        "import importlib.util, sys; spec = importlib.util.spec_from_file_location('t', sys.argv[1])\n"
        "t = importlib.util.module_from_spec(spec); spec.loader.exec_module(t)\n"
        "env = t.DoomEnv(sys.argv[2]); print(t.fingerprint(env, 7)); env.close()"
    )
    command = [sys.executable, "-c", code, __file__, task]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == first, "in another process"


def test_without_fresh_engines_fuzzy_enemies_replay_the_same_game_but_for_their_shimmer():
    env = DoomEnv("defend_the_center/fuzzy_enemies", recycle_episodes=0)
    played = [play(env, 7) for _ in range(3)]
    env.close()
    for frames, rewards, infos in played[1:]:
        assert (rewards, infos) == played[0][1:]
        assert 0 < (frames != played[0][0]).any(-1).mean() < 0.02, "fresh engines would not be needed, or do not help"


def test_engines_are_recycled_after_so_many_episodes_and_with_fuzzy_enemies_after_each():
    def engines(task: str, episodes: int) -> list[int]:
        env = DoomEnv(task, recycle_episodes=2)
        pids = []
        for _ in range(episodes):
            env.reset()
            assert env._engine is not None
            pids.append(env._engine.pid)
        env.close()
        return pids

    pids = engines("defend_the_center/default", 5)
    assert pids[0] == pids[1] != pids[2] == pids[3] != pids[4]
    pids = engines("defend_the_center/fuzzy_enemies", 2)
    assert pids[0] != pids[1], "a bound from outside does not take from the task what it needs"


def test_a_seed_gives_a_sequence_of_episodes(shared: DoomEnv):
    def seeds(seed: int | None) -> list[int]:
        first = shared.reset(seed=seed)[1]["episode_seed"]
        return [first, *(shared.reset()[1]["episode_seed"] for _ in range(3))]

    one = seeds(5)
    assert len(set(one)) == 4
    assert seeds(5) == one
    assert not set(seeds(6)) & set(one)
    shared.reset(seed=5)
    shared.reset(options={"episode_seed": 77})
    assert shared.reset()[1]["episode_seed"] == one[1], "a replay does not move the sequence"


# ---------------------------------------------------------------------------------------- arguments, errors


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"task": "defend_the_center/blood"}, TaskError, "unknown attribute 'blood'"),
        ({"frame_skp": 4}, ConfigError, "unexpected keyword argument 'frame_skp', want one of frame_height"),
        ({"frame_skip": 0}, ConfigError, r"env.frame_skip: got 0, want 1\.\.35"),
        (
            {"action_set": "all"},
            ConfigError,
            "env.action_set: got 'all', want one of buttons, combinations, unified_v1",
        ),
        ({"buffers": ("depth", "sound")}, ConfigError, "env.buffers: got 'sound', want one of depth, labels, automap"),
        ({"buffers": "depth"}, ConfigError, "env.buffers: got 'depth', want a list"),
        ({"frame_skip": 2.5}, ConfigError, "env.frame_skip: got 2.5, want int"),
        ({"frame_width": 84.5}, ConfigError, "env.frame_width: got 84.5, want int"),
        ({"render_width": 256.0}, ConfigError, "env.render_width: got 256.0, want int"),
        ({"grayscale": "no"}, ConfigError, "env.grayscale: got 'no', want bool"),
        (
            {"reward_weights": {"kill": float("nan")}},
            ConfigError,
            r"env.reward_weights, \('kill', nan\): got nan, want a",
        ),
        ({"config": ["frame_skip", 4]}, ConfigError, r"config: got \['frame_skip', 4\], want EnvConfig"),
        ({"task": None}, TaskError, "task: got None, want '<scenario>/<task>'"),
        ({"render_width": 300}, ConfigError, "got 300x144, want one of"),
        ({"render_mode": "ansi"}, ValueError, "render_mode: got 'ansi'"),
        ({"recycle_episodes": -1}, ConfigError, "recycle_episodes: got -1, want 0 or more"),
        ({"recycle_episodes": 0.5}, ConfigError, "recycle_episodes: got 0.5, want int"),
    ],
)
def test_wrong_arguments_fail_at_construction(options: dict, error: type[Exception], message: str):
    with pytest.raises(error, match=message):
        DoomEnv(**{"task": "defend_the_center/default", **options})


def test_wrong_calls_say_what_is_wanted(shared: DoomEnv):
    for options, message in (
        ({"sed": 1}, r"unknown options \['sed'\]"),
        (["episode_seed"], r"options: got \['episode_seed'\], want a dict"),
        ({"episode_seed": 2**31}, r"episode_seed 2147483648, want an integer, 0\.\.2147483647"),
        ({"episode_seed": 1.9}, r"episode_seed 1\.9, want an integer"),
    ):
        with pytest.raises(ValueError, match=message):
            shared.reset(options=options)
    running = shared.reset(seed=1)[1]["episode_seed"]
    with pytest.raises(ValueError, match="episode_seed -5, want an integer"):
        shared.reset(options={"episode_seed": -5})
    assert shared.step(0)[-1]["episode_seed"] == running, "a refused reset changes nothing"
    for action in (-1, 3, 1.0, None, np.array([1])):
        with pytest.raises(ValueError, match=f"action {re.escape(repr(action))}, want 0..2"):
            shared.step(action)


def test_plain_data_makes_an_environment():
    env = make_env("defend_the_center/default", {"frame_height": 42, "frame_width": 42, "buffers": []})
    assert env.reset(seed=1)[0].shape == (42, 42, 3)
    env.close()


def engine_memory() -> list[str]:
    """The mappings and descriptors of engines' shared memory that this process holds."""
    mappings = [line for line in Path("/proc/self/maps").read_text().splitlines() if "ViZDoom" in line]
    links = [str(link.readlink()) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    return mappings + [link for link in links if "ViZDoom" in link]


def test_closed_environments_hold_no_memory_of_their_engines():
    others = engine_memory()
    fields = {"render_mode": "rgb_array", "render_width": 160, "render_height": 120, "buffers": ("labels",)}
    envs = [DoomEnv("defend_the_center/default", **fields) for _ in range(2)]
    for env in envs:
        env.reset(seed=1)
        assert len(engine_memory()) > len(others)
        env.step(TURN)
        env.close()
        assert engine_memory() == others
        with pytest.raises(ResetNeeded, match="nothing was rendered, or the environment was closed"):
            env.render()


# ------------------------------------------------------------------------------------------------ rendering


def test_pictures_per_second_follow_the_frame_skip(shared: DoomEnv):
    """What Gymnasium's RecordVideo takes, so that a video plays at the game's speed."""
    assert shared.metadata["render_fps"] == 35 / 4
    for frame_skip in (1, 7):
        env = gymnasium.make("GViZDoom/DefendTheCenter-Gore-v0", frame_skip=frame_skip, render_mode="rgb_array")
        assert env.metadata["render_fps"] == 35 / frame_skip
    assert shared.metadata["render_fps"] == 35 / 4
