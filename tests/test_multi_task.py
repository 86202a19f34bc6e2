"""Several tasks as one environment: the games are those of the single environments."""

import dataclasses
import gc

import numpy as np
import psutil
import pytest
from gymnasium.utils.env_checker import check_env

import gvz
from gvz.core.errors import ConfigError, TaskError
from gvz.env import DoomEnv
from gvz.multi_task import MultiTaskEnv
from gvz.scenarios.base import Attribute, Content, Task, Textures
from gvz.tasks import parse_task

TASKS = ("defend_the_center/default", "seek_and_kill/default", "dodge_projectiles/default")


def play(env, options) -> tuple[np.ndarray, dict]:
    frame, info = env.reset(options={"episode_seed": 5} | options)
    return np.stack([frame, *(env.step(1)[0] for _ in range(6))]), info


@pytest.mark.engine
def test_an_episode_is_the_single_environments():
    several = gvz.make(TASKS, action_set="unified_v1", max_engines=2)
    assert isinstance(several, MultiTaskEnv)
    order = (*TASKS, TASKS[1], TASKS[0])
    for n, task in enumerate(order):
        alone = DoomEnv(task, action_set="unified_v1")
        frames, info = play(alone, {})
        same, same_info = play(several, {"task": task})
        assert (frames == same).all()
        assert info == same_info
        assert info["task"] == several.task.id == task
        assert (several.action_masks() == alone.action_masks()).all()
        assert several.action_meanings == alone.action_meanings
        wanted = (TASKS[:1], TASKS[:2], TASKS[1:], (TASKS[2], TASKS[1]), (TASKS[1], TASKS[0]))[n]
        assert tuple(game.task.id for game in several._running) == wanted, "the engine that rests longest is closed"
        alone.close()
    several.close()
    assert not several._running


@pytest.mark.engine
def test_labels_are_those_of_the_game_that_plays():
    with gvz.make(TASKS[:1], buffers=("labels",)) as env:
        env.reset(seed=1)
        assert "MarineChainsawVzd" in {label.object_name for label in env.labels()}


@pytest.mark.engine
def test_the_sampler_chooses_and_the_seed_repeats_the_sequence():
    with gvz.make(TASKS, action_set="unified_v1") as env:
        first = [env.reset(seed=3 if n == 0 else None)[1] for n in range(6)]
        again = [env.reset(seed=3 if n == 0 else None)[1] for n in range(6)]
        pairs = [[(info["task"], info["episode_seed"]) for info in infos] for infos in (first, again)]
        assert pairs[0] == pairs[1]
        assert len(set(pairs[0])) == 6
        assert len({task for task, _ in pairs[0]}) > 1
        for n in range(6):
            info = env.reset(seed=3 if n == 0 else None)[1]
            assert (info["task"], info["episode_seed"]) == pairs[0][n], "episodes between are none of the sequence"
            env.reset(options={"task": TASKS[0], "episode_seed": 5})
    with gvz.make(TASKS[:2], action_set="unified_v1", sampler=lambda _rng: TASKS[1]) as env:
        assert env.reset(seed=1)[1]["task"] == TASKS[1]


@pytest.mark.engine
def test_a_task_may_be_chosen_by_any_of_its_names():
    written = ["defend_the_center/resized_enemies+fuzzy_enemies", "defend_the_center/default"]
    with gvz.make(written, sampler=lambda _rng: written[0]) as env:
        assert env.reset(seed=1)[1]["task"] == env.tasks[0] == "defend_the_center/fuzzy_enemies+resized_enemies"
        assert env.reset(options={"task": written[0]})[1]["task"] == env.tasks[0]


@pytest.mark.engine
def test_engines_end_with_the_last_reference():
    """At once: the cyclic garbage collector may come late."""
    env = gvz.make(TASKS[:1])
    env.reset(seed=1)
    pid = env._game._engine.pid
    gc.disable()
    try:
        del env
        assert not psutil.pid_exists(pid)
    finally:
        gc.enable()


@pytest.mark.engine
def test_gymnasiums_checker_passes():
    env = gvz.make(["health_gathering/default", "health_gathering/lava"])
    check_env(env, skip_render_check=True)
    env.close()


def test_bad_input_is_named():
    with pytest.raises(ConfigError, match='whose actions differ; want one scenario, or action_set="unified_v1"'):
        gvz.make(TASKS)
    with pytest.raises(ConfigError, match="want at least one, each once"):
        gvz.make([TASKS[0], TASKS[0]])
    for no_task in (None, 3, [None]):
        with pytest.raises(TaskError, match=r"task: got (None|3), want '<scenario>/<task>'"):
            gvz.make(no_task)
    for number, message in ((0, "got 0, want at least 1"), (1.5, "got 1.5, want int")):
        with pytest.raises(ConfigError, match=f"max_engines: {message}"):
            gvz.make(TASKS, action_set="unified_v1", max_engines=number)
    with pytest.raises(ConfigError, match="sampler: got 'uniform', want a function of a random number generator"):
        gvz.make(TASKS, action_set="unified_v1", sampler="uniform")
    env = gvz.make(TASKS, action_set="unified_v1")
    with pytest.raises(
        TaskError, match="got task 'defend_the_center/gore', want one of defend_the_center/default, seek"
    ):
        env.reset(options={"task": "defend_the_center/gore"})
    before = env.np_random.bit_generator.state
    for options in ({"task": "doom"}, {"task": ["doom"]}, {"task": TASKS[0], "episode_seed": -5}):
        with pytest.raises((TaskError, ValueError), match=r"doom|episode_seed -5"):
            env.reset(seed=9, options=options)
    assert (env.np_random.bit_generator.state, env._running) == (before, [])


@pytest.mark.engine
def test_a_task_of_an_attribute_that_is_in_no_file_is_played():
    (scenario,) = {parse_task(task).scenario for task in TASKS[:1]}
    ice = Textures("FLAT14", "FWATER1", "CEIL4_3")
    own = dataclasses.replace(
        scenario,
        attributes=(
            *scenario.attributes,
            Attribute(name="on_ice", groups=("textures",), content=Content(textures=ice)),
        ),
    )
    with gvz.make([Task(own, ("on_ice",)), TASKS[0]]) as env:
        assert {env.reset(seed=seed)[1]["task"] for seed in range(4)} == set(env.tasks)
