"""`gvz.make_vec` beside gymnasium's SyncVectorEnv over the same games, and its own way of `send` and `recv`."""

import contextlib
import copy
import os
import pickle
import resource
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.error import AlreadyPendingCallError, ClosedEnvironmentError, NoAsyncCallError, ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv

import gvz
from gvz.core import watchdog
from gvz.core.errors import ConfigError, TaskError
from gvz.env import DoomEnv
from gvz.vector import crew
from gvz.vector.env import DoomVectorEnv
from gvz.vector.infos import batch_infos

TASKS = ("defend_the_center/gore", "health_gathering/default", "dodge_projectiles/default")


def assert_same(ours: Any, theirs: Any, where: str = "") -> None:
    """Equal in type, dtype and value, through dicts and arrays of objects."""
    if isinstance(theirs, dict):
        assert ours.keys() == theirs.keys(), where
        for key, value in theirs.items():
            assert_same(ours[key], value, f"{where}/{key}")
    elif isinstance(theirs, np.ndarray) and theirs.dtype == object:
        assert ours.shape == theirs.shape, where
        for index, value in enumerate(theirs):
            assert_same(ours[index], value, f"{where}[{index}]")
    else:
        assert type(ours) is type(theirs), where
        assert np.asarray(ours).dtype == np.asarray(theirs).dtype, where
        np.testing.assert_array_equal(ours, theirs, where)


def without_ids(infos: dict[str, Any]) -> dict[str, Any]:
    """Infos as gymnasium has them; checks what we add to them."""
    infos = dict(infos)
    mask = infos.pop("_env_id")
    np.testing.assert_array_equal(mask, infos["_task"])
    np.testing.assert_array_equal(infos.pop("env_id"), np.where(mask, np.arange(len(TASKS)), 0))
    return infos


@pytest.mark.engine
@pytest.mark.parametrize(
    ("mode", "action_set"),
    [
        (AutoresetMode.NEXT_STEP, "unified_v1"),
        (AutoresetMode.SAME_STEP, "multi_discrete_v1"),
        (AutoresetMode.DISABLED, "unified_v1"),
    ],
)
def test_it_equals_gymnasiums_over_the_same_games(mode: AutoresetMode, action_set: str):
    """Tasks of three scenarios, a dict of observations, seeds of all kinds, some episodes of every game."""
    fields = {"action_set": action_set, "buffers": ("labels",), "frame_skip": 35, "grayscale": True}
    ours = gvz.make_vec(TASKS, autoreset_mode=mode, num_workers=2, **fields)
    theirs = SyncVectorEnv([partial(DoomEnv, task, **fields) for task in TASKS], autoreset_mode=mode)
    try:
        assert ours.metadata == theirs.metadata
        assert ours.observation_space == theirs.observation_space
        assert ours.action_space == theirs.action_space
        num_ends = np.zeros(len(TASKS), int)
        ours.action_space.seed(1)
        for start in ({"seed": 7}, {"seed": [3, None, 5]}, {"options": {"episode_seed": 11}}, {}):
            (observations, infos), wanted = ours.reset(**start), theirs.reset(**start)
            assert_same(observations, wanted[0])
            assert_same(without_ids(infos), wanted[1])
            assert ours.np_random_seed == theirs.np_random_seed == ((7, 8, 9) if start == {"seed": 7} else (3, 8, 5))
            for _ in range(30):
                actions = ours.action_space.sample()
                *batch, infos = ours.step(actions)
                *wanted, wanted_infos = theirs.step(actions)
                for got, want in zip(batch, wanted, strict=True):
                    assert_same(got, want)
                assert_same(without_ids(infos), wanted_infos)
                ended = batch[2] | batch[3]
                num_ends += ended
                if ended.any() and mode is AutoresetMode.DISABLED:
                    observations, infos = ours.reset(options={"reset_mask": ended})
                    wanted = theirs.reset(options={"reset_mask": ended})
                    assert_same(observations, wanted[0])
                    assert_same(without_ids(infos), wanted[1])
        assert (num_ends > 0).all()
    finally:
        ours.close()
        theirs.close()


@pytest.fixture(scope="module")
def envs() -> Iterator[DoomVectorEnv]:
    """Three games of one worker and one of another, in batches of two."""
    made = gvz.make_vec("defend_the_center/default", 3, batch_size=2, num_workers=2, frame_skip=35)
    yield made
    made.close()


@pytest.mark.engine
def test_recv_gives_a_batch_of_those_that_are_ready_and_every_game_its_own_way(envs: DoomVectorEnv):
    alone = [DoomEnv("defend_the_center/default", frame_skip=35) for _ in range(3)]
    first, _ = envs.reset(seed=4)
    for game, env in enumerate(alone):
        np.testing.assert_array_equal(first[game], env.reset(seed=4 + game)[0])
    over, num_answers = [False] * 3, [0] * 3
    envs.send(np.full(3, 1))
    for _ in range(40):
        observations, rewards, terminated, truncated, infos = envs.recv()
        games = infos["env_id"]
        assert games.tolist() in ([0, 1], [0, 2], [1, 2])
        assert observations.shape == (2, 84, 84, 3)
        assert infos["task"].tolist() == ["defend_the_center/default"] * 2
        assert infos["_score"].tolist() == [True, True]
        for row, game in enumerate(games.tolist()):
            env = alone[game]
            want = (env.reset()[0], 0.0, False, False) if over[game] else env.step(1)[:4]
            np.testing.assert_array_equal(observations[row], want[0])
            assert (rewards[row], terminated[row], truncated[row]) == want[1:]
            over[game] = terminated[row] or truncated[row]
            num_answers[game] += 1
        envs.send(np.full(2, 1), games)
    assert min(num_answers) > 5
    assert envs._frames.progress.min() > 5, "else a worker that always has something to do would count as stuck"
    assert envs.reset(seed=4)[0].tobytes() == first.tobytes(), "reset drops what is on its way"
    for env in alone:
        env.close()


def test_a_worker_is_silent_from_its_last_decision_on(monkeypatch: pytest.MonkeyPatch):
    now_s, worker = [0.0], crew._Worker.__new__(crew._Worker)
    monkeypatch.setattr(watchdog, "time", SimpleNamespace(monotonic=lambda: now_s[0]))
    worker.progress, worker.clock = 0, watchdog.AwakeClock(10.0)
    silent_s = []
    for now_s[0], progress in ((5.0, 0), (9.0, 3), (10.0, 3), (12.0, 4), (14.0, 4)):
        silent_s.append(worker.silent_s(progress))
    assert silent_s == [5.0, 0.0, 1.0, 0.0, 2.0]


@pytest.mark.engine
def test_calls_out_of_turn_are_errors_and_change_nothing(envs: DoomVectorEnv):
    envs.reset(seed=1)
    with pytest.raises(NoAsyncCallError, match="recv: 0 games have an action, want 2; send first"):
        envs.recv()
    for actions, env_ids, message in (
        ([0, 1], None, r"actions: got int64\[2\], want int\[3\]"),
        ([0.0, 1.0, 1.0], None, r"actions: got float64\[3\], want int\[3\]"),
        ([0, 1, 3], None, r"actions: got \[0, 1, 3\], want integers from 0 to 2"),
        ([0], [3], r"env_ids: got \[3\], want a list of numbers from 0 to 2"),
        ([0, 0], [1, 1], r"env_ids: got \[1, 1\], want each game once"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.send(np.array(actions), env_ids if env_ids is None else np.array(env_ids))
    envs.send(np.array([1]), np.array([2]))
    with pytest.raises(AlreadyPendingCallError, match=r"send: recv has not taken the answers of games \[2\]"):
        envs.step(np.array([1, 1, 1]))
    for options, message in (
        ({"seed": 1}, "unknown options \\['seed'\\], want episode_seed or reset_mask"),
        ({"episode_seed": -1}, "episode_seed -1, want an integer, 0..2147483647"),
        ({"episode_seed": 2**31}, "episode_seed 2147483648, want an integer, 0..2147483647"),
        ({"episode_seed": 3.7}, r"episode_seed 3\.7, want an integer"),
        ({"episode_seed": [1]}, r"episode_seed \[1\], want an integer"),
        ({"reset_mask": [True] * 3}, r"want a numpy array bool\[3\] with at least one True"),
        ({"reset_mask": np.zeros(3, bool)}, r"want a numpy array bool\[3\] with at least one True"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.reset(options=options)
    for seed, message in (
        ([1, 2], "reset: got 2 seeds, want 3, one for each game"),
        ([7, 8, -1], "reset: seed of game 2: got -1, want an integer, 0 or more"),
        ([7, 8.0, None], r"reset: seed of game 1: got 8\.0, want an integer"),
        (np.array([0.0, 1.0, 2.0]), r"reset: seed of game 0: got .*0\.0.*, want an integer"),
        (1.0, r"reset: seed: got 1\.0, want an integer, 0 or more, or one for each game"),
        (-1, "reset: seed: got -1, want an integer, 0 or more, or one for each game"),
        ("one", "reset: seed of game 0: got 'o', want an integer"),
    ):
        with pytest.raises(ValueError, match=message):
            envs.reset(seed=seed)
    assert envs.num_playing == 1, "what is on its way is still there"
    drawn = envs.reset()[1]["episode_seed"].tolist()
    envs.reset(seed=1)
    assert envs.reset()[1]["episode_seed"].tolist() == drawn, "no game was seeded"
    firsts = [envs.reset(seed=seed)[1]["episode_seed"].tolist() for seed in (5, [5, 6, 7], np.array([5, 6, 7]))]
    assert firsts[0] == firsts[1] == firsts[2] == envs.reset(seed=np.int64(5))[1]["episode_seed"].tolist()
    _, infos = envs.reset(seed=1)
    assert infos["episode_frames"].tolist() == [0, 0, 0]


@pytest.mark.engine
def test_views_show_the_shared_memory_and_last_until_the_call_after_the_next_one():
    copies, views = (
        gvz.make_vec("defend_the_center/default", 2, copy=copy, render_mode="rgb_array") for copy in (True, False)
    )
    with pytest.raises(ResetNeeded, match=r"send: games \[0, 1\] have not begun; call reset first"):
        views.step(np.array([1, 1]))
    before_copy, before_view = copies.reset(seed=1)[0], views.reset(seed=1)[0]
    for _ in range(3):
        copy, view = copies.step(np.array([1, 2]))[0], views.step(np.array([1, 2]))[0]
        np.testing.assert_array_equal(view, copy)
        np.testing.assert_array_equal(before_view, before_copy)
        before_copy, before_view = copy, view
    mask = np.array([False, True])
    copy, view = (envs.reset(options={"reset_mask": mask, "episode_seed": 9})[0] for envs in (copies, views))
    np.testing.assert_array_equal(view, copy)
    np.testing.assert_array_equal(view[0], before_copy[0], "it was not reset")
    assert view.base is not None
    assert copy.base is None or copy.base.nbytes == copy.nbytes
    screens = views.render()
    assert screens is not None
    assert [screen.shape for screen in screens] == [(144, 256, 3)] * 2
    assert all(screen.flags.writeable for screen in screens), "as DoomEnv's, to draw into"
    env = DoomEnv("defend_the_center/default", render_mode="rgb_array")
    env.reset(options={"episode_seed": 9})
    np.testing.assert_array_equal(screens[1], env.render())
    env.close()
    for envs in (copies, views):
        envs.close()
        envs.close()
    assert view.shape == (2, 84, 84, 3), "a view outlives the environment"
    with pytest.raises(ClosedEnvironmentError, match="send: the vector environment was closed"):
        views.step(np.array([1, 1]))


@pytest.mark.engine
def test_a_seed_that_nobody_gave_can_be_read_and_used_again(envs: DoomVectorEnv):
    made = gvz.make_vec("defend_the_center/default", 3, num_workers=1)
    drawn = made.reset()[1]["episode_seed"]
    assert len(set(made.np_random_seed)) == 3
    np.testing.assert_array_equal(envs.reset(seed=made.np_random_seed)[1]["episode_seed"], drawn)
    made.close()


@pytest.mark.engine
@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, pickle.dumps])
def test_it_is_not_copied_or_pickled(envs: DoomVectorEnv, copied: Callable[[DoomVectorEnv], object]):
    """A copy had the same workers, and got answers that were not its own."""
    with pytest.raises(TypeError, match="its worker processes can be neither copied nor pickled; make another one"):
        copied(envs)


@pytest.mark.engine
def test_gymnasium_makes_it_by_the_tasks_id():
    envs = gymnasium.make_vec(
        "GViZDoom/DefendTheCenter-Gore-v0", num_envs=2, vectorization_mode="vector_entry_point", grayscale=True
    )
    assert isinstance(envs, DoomVectorEnv)
    assert envs.tasks == ("defend_the_center/gore",) * 2
    assert envs.autoreset_mode is envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    envs = gymnasium.wrappers.vector.RecordEpisodeStatistics(envs)
    assert envs.reset(seed=1)[0].shape == (2, 84, 84, 1)
    assert envs.step(np.array([1, 1]))[4]["task"].tolist() == ["defend_the_center/gore"] * 2
    envs.close()


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        (([],), ConfigError, "got no task, want at least one"),
        ((None,), TaskError, "task: got None, want '<scenario>/<task>'"),
        (([None],), TaskError, "task: got None, want '<scenario>/<task>'"),
        (("defend_the_center/gor", 2), TaskError, "did you mean"),
        (("defend_the_center/gore", 0), ConfigError, "got num_envs=0, want 1 or more"),
        (("defend_the_center/gore", 2, None, {"batch_size": 3}), ConfigError, "got batch_size=3, want 1..2"),
        (("defend_the_center/gore", 2, None, {"num_workers": 3}), ConfigError, "got num_workers=3, want 1..2"),
        (("defend_the_center/gore", 2, None, {"num_workers": 1.0}), ConfigError, "num_workers: got 1.0, want int"),
        (("defend_the_center/gore", 2, None, {"autoreset_mode": "next"}), ConfigError, "want one of NextStep, SameSt"),
        (("defend_the_center/gore", 2, None, {"copy": False, "batch_size": 1}), ConfigError, "batch_size=1, want 2"),
        (("defend_the_center/gore", 2, None, {"render_mode": "human"}), ConfigError, "want None or 'rgb_array'"),
        (("defend_the_center/gore", 2, None, {"frame_skp": 4}), ConfigError, "keyword argument 'frame_skp'"),
        (("defend_the_center/gore", 2, "thesis"), ConfigError, "config: got 'thesis', want EnvConfig"),
        (
            (("defend_the_center/default", "seek_and_kill/default"),),
            ConfigError,
            "whose actions differ; want one sc",
        ),
    ],
)
def test_wrong_arguments_are_refused_before_a_process_starts(arguments: tuple, error: type[Exception], message: str):
    positional, options = arguments[:3], arguments[3] if len(arguments) > 3 else {}
    with pytest.raises(error, match=message):
        DoomVectorEnv(*positional, **options)


def test_each_game_has_the_mask_of_its_own_task():
    envs = gvz.make_vec(["defend_the_center/gore", "seek_and_kill/default"], 3, action_set="unified_v1")
    masks = envs.action_masks()
    for game, task in enumerate(envs.tasks):
        np.testing.assert_array_equal(masks[game], gvz.make(task, action_set="unified_v1").action_masks())
    masks[:] = False
    assert envs.action_masks().any(axis=1).all(), "it is a copy"
    envs.close()


def test_infos_of_some_games_have_masks():
    batch = batch_infos([{"a": 1, "b": {"c": 0.5}, "final_obs": {"x": 1}}, None, {"a": 2, "d": "text", "b": {}}])
    assert_same(
        batch,
        {
            "a": np.array([1, 0, 2]),
            "_a": np.array([True, False, True]),
            "b": {"c": np.array([0.5, 0.0, 0.0]), "_c": np.array([True, False, False])},
            "_b": np.array([True, False, True]),
            "final_obs": np.array([{"x": 1}, None, None], object),
            "_final_obs": np.array([True, False, False]),
            "d": np.array([None, None, "text"], object),
            "_d": np.array([False, False, True]),
        },
    )
    batch["_a"][:] = False
    assert batch["_b"].tolist() == [True, False, True], "each key has a mask of its own"


@pytest.mark.engine
def test_a_program_may_have_many_open_files():
    """More than `select` could wait for."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 2048:
        pytest.skip(f"this machine allows {hard} open files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (2048, hard))
    with contextlib.ExitStack() as opened:
        opened.callback(resource.setrlimit, resource.RLIMIT_NOFILE, (soft, hard))
        for _ in range(1030):
            opened.enter_context(Path(os.devnull).open())
        envs = gvz.make_vec("defend_the_center/default", 1)
        opened.callback(envs.close)
        assert envs.reset(seed=1)[0].shape == (1, 84, 84, 3)


@pytest.mark.engine
def test_views_show_every_games_newest_frame_after_an_answer_of_one_was_dropped():
    copies, views = (gvz.make_vec("defend_the_center/default", 2, num_workers=1, copy=copy) for copy in (True, False))
    before_copy, before_view = copies.reset(seed=1)[0], views.reset(seed=1)[0]
    for mask in ([True, True], [False, True], [True, False]):
        for envs in (copies, views):
            envs.send(np.array([1]), np.array([0]))
        options = {"reset_mask": np.array(mask)}
        for step in range(2):
            copy, view = (
                (envs.step(np.array([1, 2])) if step else envs.reset(seed=5, options=options))[0]
                for envs in (copies, views)
            )
            np.testing.assert_array_equal(view, copy)
            np.testing.assert_array_equal(before_view, before_copy)
            before_copy, before_view = copy, view
    copies.close()
    views.close()
