"""The acting loop by way of the inline pool: what it records, and that it goes on bit for bit."""

from collections import defaultdict
from functools import cache
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import msgpack
import msgspec
import numpy as np
import pytest
from fake_env import FRAME_SHAPE, Checker, config, export_act
from watched_pool import gather, segments

from actors.inline import InlinePool
from actors.loop import derive_seed
from actors.pool import PoolConfig
from actors.preprocess import ObservationBatch
from gvz.core.errors import ConfigError, ResumeError
from gvz.transport.messages import EpisodeStats, Fault, Message, ParamsHeader, StepBlock

LENGTH = 7
STACKED = (*FRAME_SHAPE[:2], 4 * FRAME_SHAPE[2])

WEIGHTS = np.arange(np.prod(STACKED), dtype=np.uint32)[None] * np.uint32(2654435761) + np.uint32(12345)


def inline_config(work_dir: Path, options: dict[str, Any] | None = None, **changes: Any) -> PoolConfig:
    return config(work_dir, {"length": LENGTH, **(options or {})}, num_actors=1, games_per_actor=3, **changes)


@cache
def hashing_policy(num_games: int) -> bytes:
    """The action is a hash of every byte of the observation, of the parameters, the task and the key."""

    def act(params, obs, key, epsilon):
        mixed = (obs["frames"].reshape(num_games, -1).astype(jnp.uint32) * WEIGHTS).sum(1)
        mixed += params[0].sum().astype(jnp.uint32) + key.sum() * epsilon.astype(jnp.uint32)
        return (((mixed >> 7) + obs["task"].astype(jnp.uint32)) % 5).astype(jnp.int32)

    return export_act(act, [(3,)], ObservationBatch(num_games, FRAME_SHAPE, 4))


def params(version: int) -> tuple[np.ndarray, ParamsHeader]:
    return np.full(3, version, np.float32), ParamsHeader(version=version, num_updates=version, epsilon=1.0)


@pytest.mark.parametrize("end", ["terminated", "truncated"])
def test_every_lane_is_an_unbroken_stream_of_whole_episodes(tmp_path: Path, end: str):
    pool_config = inline_config(tmp_path, {"end": end})
    checker = Checker(pool_config)
    with InlinePool(pool_config) as pool:
        for count in (1, 2, 3, 50, 100):
            blocks = pool.drain(count)
            assert sum(len(block) for block in blocks) == count
            checker.add(blocks)
        stats = pool.statistics()
    assert (checker.num_records, checker.num_cuts) == (156, 0)
    assert stats.env_steps == 156 - 18  # 6 episodes of 7 decisions in each lane's 52 records, each with a last record


def test_an_episode_is_reported_after_its_last_record_and_with_its_sums(tmp_path: Path):
    with InlinePool(inline_config(tmp_path)) as pool:
        pool.drain(3 * LENGTH)
        assert pool.poll() == []
        steps, _ = gather(pool.drain(3 * (LENGTH + 1)))
        episodes = pool.poll()
    assert [type(e) for e in episodes] == [EpisodeStats] * 3
    for lane, stats in enumerate(episodes):
        assert isinstance(stats, EpisodeStats)
        played = steps[(steps["lane"] == lane) & (steps["episode"] == 0)]
        assert stats == EpisodeStats(
            lane=lane,
            task=lane % 2,
            episode=0,
            seed=derive_seed(1, lane % 2, lane, 0),
            score=stats.score,
            reward=28.0,
            reward_components={"count": 28.0, "action": 0.0},
            length_frames=28,
            length_steps=7,
            params_version=0,
            terminated=True,
            truncated=False,
        )
        assert played["terminated"].tolist() == [1]
        assert played["action"].tolist() == [0]


def test_the_policy_saw_the_stack_of_the_recorded_frames(tmp_path: Path):
    """Stacks rebuilt from the records alone give the recorded actions, across ends of episodes."""
    pool_config = inline_config(tmp_path, policy=hashing_policy(3), num_params=3)
    with InlinePool(pool_config) as pool:
        pool.publish(params(0)[0], ParamsHeader(version=0, num_updates=0))
        steps, frames = gather(pool.drain(3 * 40))
    seen = set()
    for lane in range(3):
        history: list[np.ndarray] = []
        for step, frame in zip(steps[steps["lane"] == lane], frames[steps["lane"] == lane], strict=True):
            history = [frame] * 4 if step["first"] else [*history[1:], frame]
            if not step["terminated"]:
                mixed = int((np.concatenate(history, -1).ravel().astype(np.uint32) * WEIGHTS[0]).sum(dtype=np.uint32))
                assert step["action"] == ((mixed >> 7) + lane % 2) % 5
                seen.add(int(step["action"]))
    assert len(seen) > 2


def test_game_variables_past_actions_masks_and_extras_are_acted_on_and_recorded(tmp_path: Path):
    """The action is 1 + 2 (last two actions) + the game's step count, mod 5, or 4 where that is masked."""
    masks = ((True,) * 5, (True, False, True, False, True))
    observed = ObservationBatch(3, FRAME_SHAPE, 4, past_actions=2, variables=("STEPS", "ABSENT"), action_masks=masks)

    def act(_params, obs, _key, _epsilon):
        wanted = (1 + 2 * obs["actions"].sum(1) + obs["vector"][:, 0].astype(jnp.int32)) % 5
        allowed = jnp.take_along_axis(obs["mask"], wanted[:, None], axis=1)[:, 0]
        return jnp.where(allowed, wanted, 4).astype(jnp.int32), jnp.stack([obs["vector"][:, 0] / 2], axis=1)

    pool_config = inline_config(
        tmp_path,
        policy=export_act(act, [(3,)], observed, num_extras=1),
        num_params=3,
        past_actions=2,
        variables=("STEPS", "ABSENT"),
        num_extras=1,
        action_masks=masks,
    )
    with InlinePool(pool_config) as pool:
        pool.publish(params(0)[0], ParamsHeader(version=0, num_updates=0))
        steps, _ = gather(pool.drain(3 * 40))
        state = pool.state()
        onward, _ = gather(pool.drain(3 * 20))
    with InlinePool(pool_config, state) as pool:
        np.testing.assert_array_equal(gather(pool.drain(3 * 20))[0], onward)
    assert steps.dtype.itemsize == 48 + 4 + 3 * 4
    for lane in range(3):
        past, t = [-1, -1], 0
        for step in steps[steps["lane"] == lane]:
            if step["first"]:
                past, t = [-1, -1], 0
            np.testing.assert_array_equal(step["vector"], [t, 0])
            assert step["extras"] == t / 2
            if not step["terminated"]:
                wanted = (1 + 2 * sum(past) + t) % 5
                assert step["action"] == (wanted if masks[lane % 2][wanted] else 4)
            past, t = [past[1], int(step["action"])], t + 1


def test_an_assigned_task_begins_with_the_lanes_next_episode(tmp_path: Path):
    pool_config, states, played = inline_config(tmp_path), [], []
    with InlinePool(pool_config) as pool:
        pool.drain(5)
        pool.assign(0, 1)
        for _ in range(2):  # it waits for its episode; it is played
            states.append(pool.state())
            played.append(gather(pool.drain(3 * 12))[0])
    for state, steps in zip(states, played, strict=True):
        with InlinePool(pool_config, state) as pool:
            np.testing.assert_array_equal(gather(pool.drain(3 * 12))[0], steps)
    own = played[0][played[0]["lane"] == 0]
    np.testing.assert_array_equal(own["task"], own["episode"] > 0)
    assert own["episode"].max() > 0


def test_the_same_seed_plays_the_same_and_another_seed_or_actor_does_not(tmp_path: Path):
    def play(**changes: Any) -> tuple[np.ndarray, np.ndarray]:
        with InlinePool(inline_config(tmp_path, **changes)) as pool:
            return gather(pool.drain(60))

    steps, frames = play()
    again_steps, again_frames = play()
    np.testing.assert_array_equal(steps, again_steps)
    np.testing.assert_array_equal(frames, again_frames)
    for change in ({"seed": 2}, {"first_actor": 1}):  # actors of one run do not all explore alike
        assert (play(**change)[0]["action"] != steps["action"]).any()


def test_seeds_are_31_bits_and_all_different():
    seeds = {
        derive_seed(run, task, lane, episode)
        for run in (0, 1)
        for task in (0, 1)
        for lane in (0, 1)
        for episode in range(500)
    }
    assert len(seeds) == 4000
    assert all(0 <= seed < 2**31 for seed in seeds)


@pytest.mark.parametrize("cut", [0, 1, 20, 21, 24, 25, 59])
def test_resumed_equals_uninterrupted_bit_for_bit(tmp_path: Path, cut: int):
    """At every kind of cut: before the first record, within a step of the games, at and after ends of episodes."""
    pool_config = inline_config(tmp_path, policy=hashing_policy(3), num_params=3)

    def play(pool: InlinePool, start: int, stop: int) -> tuple[list[StepBlock], list[Message]]:
        blocks, messages = [], []
        for number in range(start, stop):
            if number % 10 == 0:
                pool.publish(*params(number))
            blocks += pool.drain(1)
            if number % 7 == 0:
                messages += pool.poll()
        return blocks, messages

    with InlinePool(pool_config) as pool:
        blocks, messages = play(pool, 0, 100)
        messages += pool.poll()
        wanted_steps, wanted_frames = gather(blocks)
    with InlinePool(pool_config) as pool:
        blocks, heard = play(pool, 0, cut)
        state = msgpack.unpackb(msgpack.packb(pool.state()))
    with InlinePool(pool_config, state) as pool:
        more, more_heard = play(pool, cut, 100)
        heard += more_heard + pool.poll()
    steps, frames = gather(blocks + more)
    np.testing.assert_array_equal(steps, wanted_steps)
    np.testing.assert_array_equal(frames, wanted_frames)
    assert heard == messages
    assert len(set(wanted_steps["action"].tolist())) > 2


def test_taking_the_state_changes_nothing(tmp_path: Path):
    with InlinePool(inline_config(tmp_path)) as pool, InlinePool(inline_config(tmp_path)) as other:
        pool.drain(10)
        other.drain(10)
        assert pool.state() == pool.state()
        np.testing.assert_array_equal(gather(pool.drain(30))[0], gather(other.drain(30))[0])


def test_a_game_that_does_not_come_back_is_named(tmp_path: Path):
    with InlinePool(inline_config(tmp_path)) as pool:
        pool.drain(10)
        state = pool.state()
    with pytest.raises(
        ResumeError, match=r"lane 0, task a: replaying 4 actions of episode 0 \(seed \d+\) did not come"
    ):
        InlinePool(inline_config(tmp_path, seed=2), state)


def test_a_state_of_another_size_is_refused(tmp_path: Path):
    with InlinePool(inline_config(tmp_path)) as pool:
        state = pool.state()
    with pytest.raises(ResumeError, match="got 3 games, want 2"):
        InlinePool(config(tmp_path, {}, num_actors=1), state)


def test_playing_without_parameters_is_refused(tmp_path: Path):
    pool_config = inline_config(tmp_path, policy=hashing_policy(3), num_params=3)
    with InlinePool(pool_config) as pool, pytest.raises(ValueError, match="publish parameters first"):
        pool.drain(1)


def test_two_actors_do_not_fit_into_one_process(tmp_path: Path):
    with pytest.raises(ValueError, match="num_actors: got 2, want 1"):
        InlinePool(config(tmp_path, {}))


def test_frames_of_another_shape_are_refused(tmp_path: Path):
    pool_config = msgspec.structs.replace(inline_config(tmp_path), frame_shape=(12, 10, 1))
    with pytest.raises(
        ConfigError, match=r"fake_env:make\('a'\): got a frame uint8\[12, 10, 3\], want uint8\[12, 10, 1\]"
    ):
        InlinePool(pool_config)


def test_an_engine_that_died_between_episodes_is_told_of(tmp_path: Path):
    options = {"fault": "crash_between", "fault_task": "b", "fault_file": str(tmp_path / "struck")}
    pool_config = inline_config(tmp_path / "work", options)
    with InlinePool(pool_config) as pool:
        checker = Checker(pool_config)
        checker.add(pool.drain(100))
        messages = pool.poll()
    (fault,) = [m for m in messages if isinstance(m, Fault)]
    assert (fault.kind, fault.lane, fault.traceback) == ("engine_crash", 1, "it is no more")
    assert "episode 1, seed " in fault.message
    assert fault.message.endswith("the engine died before the first decision; a new one is started")
    assert checker.num_cuts == 0
    assert not any(m.cut for m in messages if isinstance(m, EpisodeStats))


def test_a_crashed_engine_cuts_its_episode_and_the_lane_goes_on(tmp_path: Path):
    options = {"fault": "crash", "fault_at": 10, "fault_task": "b"}
    pool_config = inline_config(tmp_path, options)
    checker = Checker(pool_config)
    with InlinePool(pool_config) as pool:
        blocks = pool.drain(3 * 30)
        messages = pool.poll()
    checker.add(blocks)
    assert checker.num_cuts == 0, "the cut is in the stream: the last record is marked truncated"
    steps, _ = gather(blocks)
    cut = steps[steps["truncated"] == 1]
    assert [(int(s["lane"]), int(s["episode"]), s["reward"]) for s in cut] == [(1, 1, 3.0)]
    faults = [m for m in messages if isinstance(m, Fault)]
    assert [(f.lane, f.kind) for f in faults] == [(1, "engine_crash")]
    assert "lane 1, task b, episode 1, seed" in faults[0].message
    assert "the engine died at decision 3" in faults[0].message
    stats = defaultdict(list)
    for message in messages:
        if isinstance(message, EpisodeStats):
            stats[message.lane].append((message.episode, message.length_steps, message.cut, message.truncated))
    assert stats[1][:3] == [(0, 7, False, False), (1, 3, True, True), (2, 7, False, False)]
    assert not any(cut for lane in (0, 2) for _, _, cut, _ in stats[lane])


def test_an_episode_is_told_of_before_another_game_plays_on_which_may_end_the_process(tmp_path: Path):
    def reset(**_: Any) -> None:
        raise RuntimeError("no engine today")

    with InlinePool(inline_config(tmp_path)) as pool:
        pool._loop.games[0].env.reset = reset
        with pytest.raises(RuntimeError, match="no engine today"):
            pool.drain(3 * (LENGTH + 2))
        ended = [int(lane) for lane in pool._ring.read(100).steps[-3:]["lane"]]
        assert [m.lane for m in pool.poll() if isinstance(m, EpisodeStats)] == ended == [0, 1, 2]


def test_what_is_published_is_copied_and_recorded(tmp_path: Path):
    pool_config = inline_config(tmp_path, policy=hashing_policy(3), num_params=3)
    with InlinePool(pool_config) as pool, InlinePool(pool_config) as other:
        vector, header = params(4)
        pool.publish(vector, header)
        vector[:] = 99.0
        other.publish(*params(4))
        steps, _ = gather(pool.drain(60))
        np.testing.assert_array_equal(steps, gather(other.drain(60))[0])
        assert (steps["params_version"] == 4).all()
        pool.drain(3 * 3)
        pool.publish(*params(5))
        last, _ = gather(pool.drain(3))
        assert last["terminated"].all()
        assert {m.params_version for m in pool.poll() if isinstance(m, EpisodeStats)} == {4}, "of the last action"


def test_closing_can_be_repeated_and_leaves_no_shared_memory(tmp_path: Path):
    pool = InlinePool(inline_config(tmp_path))
    pool.drain(5)
    assert len(segments()) == 1
    pool.close()
    pool.close()
    assert not segments()
