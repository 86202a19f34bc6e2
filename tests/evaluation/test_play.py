"""Evaluation episodes: their seeds, the same rows however they are shared out, engines that die."""

import dataclasses

import pytest

from gvz.env import DoomEnv
from gvz.errors import EngineError, GvzError
from gvz.evaluation.play import episode_seed, play, play_episode
from gvz.evaluation.players import PlayerSpec, make_player, player_env
from gvz.specs import EnvConfig
from gvz.tasks import named_tasks

TASK = "defend_the_center/fast_enemies"
SMALL = dataclasses.asdict(player_env("random", EnvConfig(frame_height=8, frame_width=8)))


def test_the_seed_of_an_episode_never_changes():
    assert episode_seed("defend_the_center/default", 0) == 289007959
    assert episode_seed("defend_the_center/default", 1) == 1919382300


def test_no_two_evaluation_episodes_share_a_seed():
    seeds = [episode_seed(task.id, n) for task in named_tasks() for n in range(100)]
    assert len(set(seeds)) == len(seeds) == 7600
    assert all(0 <= seed < 2**31 for seed in seeds)


@pytest.mark.engine
def test_rows_do_not_depend_on_how_episodes_are_shared_out():
    jobs = [(TASK, 2), (TASK, 0), ("defend_the_center/default", 0), (TASK, 1)]
    alone = list(play(jobs, PlayerSpec(kind="random"), SMALL, num_workers=1, chunk=4))
    shared = list(play(jobs, PlayerSpec(kind="random"), SMALL, num_workers=2, chunk=1))
    assert sorted(alone, key=str) == sorted(shared, key=str)
    assert {(row["task"], row["episode"]) for row in alone} == set(jobs)
    for row in alone:
        assert row["seed"] == episode_seed(row["task"], row["episode"])
        assert row["terminated"] != row["truncated"]
        assert row["reward"] == pytest.approx(sum(row["reward_components"].values()))
        assert 4 * row["length_steps"] >= row["length_frames"] > 4 * (row["length_steps"] - 1)


class Assassin:
    """Ends the engine in the middle of its first `num_kills` episodes; plays by chance."""

    def __init__(self, num_kills: int):
        self.num_kills = num_kills
        self._player = make_player(PlayerSpec(kind="random"))

    def begin(self, env, observation, info, seed):
        self._env, self._decisions = env, 0
        self._player.begin(env, observation, info, seed)

    def act(self):
        self._decisions += 1
        if self._decisions == 20 and self.num_kills > 0:
            self.num_kills -= 1
            self._env._engine.kill()
        return self._player.act()

    def observe(self, observation, info):
        self._player.observe(observation, info)


@pytest.mark.engine
def test_an_episode_whose_engine_died_is_played_again_whole():
    env = DoomEnv(TASK, **SMALL)
    undisturbed = play_episode(env, Assassin(0), 0)
    assert play_episode(env, Assassin(2), 0) == undisturbed
    with pytest.raises(EngineError, match=rf"{TASK}, evaluation episode 0 \(seed \d+\): the engine died 3 times"):
        play_episode(env, Assassin(3), 0)
    env.close()


def test_a_worker_that_dies_is_an_error():
    with pytest.raises(GvzError, match="a worker process died"):
        list(play([(TASK, 0)], PlayerSpec(kind="policy"), SMALL, num_workers=1))
