"""Evaluation episodes: their seeds, the same rows however they are shared out, engines that die."""

import contextlib
import dataclasses
import multiprocessing
import os
import time
from importlib.metadata import version

import pytest

import gvz.evaluation.play as play_module
from gvz.core.env_config import EnvConfig
from gvz.core.errors import EngineError, GvzError, WaitTimeoutError
from gvz.env import DoomEnv
from gvz.evaluation.episode_log import simple_player
from gvz.evaluation.play import Episode, PlayerSpec, _Worker, episode_seed, play, play_episode
from gvz.evaluation.players import RandomPlayer
from gvz.evaluation.simple import player_env
from gvz.tasks import named_tasks

TASK = "defend_the_center/fast_enemies"
SMALL = player_env("random", EnvConfig(frame_height=8, frame_width=8))


def test_the_seed_of_an_episode_never_changes():
    assert episode_seed("defend_the_center/default", 0) == 289007959
    assert episode_seed("defend_the_center/default", 1) == 1919382300
    assert episode_seed("defend_the_center/default", 1, base_seed=0) == 1919382300
    assert episode_seed("defend_the_center/default", 1, base_seed=1) == 1979913219


def test_no_two_evaluation_episodes_share_a_seed():
    seeds = [episode_seed(task.id, n) for task in named_tasks() for n in range(100)]
    assert len(set(seeds)) == len(seeds) == 7600
    assert all(0 <= seed < 2**31 for seed in seeds)


@pytest.mark.engine
def test_rows_do_not_depend_on_how_episodes_are_shared_out():
    random, scripted = simple_player("random", SMALL), simple_player("scripted", EnvConfig())
    episodes = [Episode(TASK, 1), Episode(TASK, 0), Episode("defend_the_center/default", 0), Episode(TASK, 0, 7)]
    jobs = [(random, episode) for episode in episodes] + [(scripted, episodes[0])]
    here = list(play(jobs, num_workers=0))
    shared = list(play(jobs, num_workers=2))
    assert sorted(map(str, here)) == sorted(map(str, shared))
    assert {(e, Episode(row["task"], row["episode"], row["base_seed"])) for e, row in here} == set(jobs)
    one, other = (row for _, row in here if (row["task"], row["episode"]) == (TASK, 1))
    assert one != other, "a worker that goes on with another player's episodes plays as that player"
    for _, row in here:
        assert row["seed"] == episode_seed(row["task"], row["episode"], row["base_seed"])
        assert row["terminated"] != row["truncated"]
        assert row["vizdoom"] == version("vizdoom")
        assert row["reward"] == pytest.approx(sum(row["reward_components"].values()))
        assert 4 * row["length_steps"] >= row["length_frames"] > 4 * (row["length_steps"] - 1)


@pytest.mark.engine
def test_rewards_are_counted_by_the_profiles_weights_whatever_the_players_are():
    player_specs = [
        simple_player("random", dataclasses.replace(SMALL, reward_weights=weights))
        for weights in ((), (("kill", 9.0),))
    ]
    (_, default), (_, other) = play([(player_spec, Episode(TASK, 0)) for player_spec in player_specs], num_workers=0)
    assert other == default


@pytest.mark.engine
def test_a_worker_keeps_its_game_only_for_the_same_rules():
    """A player that sees fuzz may need a fresh engine for each episode."""
    blind = simple_player("random", SMALL)
    seeing = dataclasses.replace(blind, recycle_episodes=None)
    assert blind.recycle_episodes == 0
    with contextlib.closing(_Worker()) as worker:
        game = worker._game(blind, "defend_the_center/fuzzy_enemies")
        assert worker._game(blind, "defend_the_center/fuzzy_enemies") is game
        assert worker._game(seeing, "defend_the_center/fuzzy_enemies") is not game


class Assassin:
    """Ends the engine in the middle of its first `num_kills` episodes; plays by chance."""

    def __init__(self, num_kills: int):
        self.num_kills = num_kills
        self._player = RandomPlayer()

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
    env = DoomEnv(TASK, SMALL)
    undisturbed = play_episode(env, Assassin(0), 0)
    assert play_episode(env, Assassin(2), 0) == undisturbed
    with pytest.raises(EngineError, match=rf"{TASK}, evaluation episode 0 \(seed \d+\): the engine died 3 times"):
        play_episode(env, Assassin(3), 0)
    env.close()


class Suicide:
    """Ends the process it is made in."""

    def __init__(self):
        os._exit(1)


def test_a_worker_that_dies_is_an_error():
    player_spec = PlayerSpec(make_player=Suicide, env=SMALL, identity={"player": "suicide"})
    with pytest.raises(GvzError, match="a worker process died; what it had not finished can be played again"):
        list(play([(player_spec, Episode(TASK, 0))], num_workers=1))


class Sleeper:
    """Never gets ready to play."""

    def __init__(self):
        time.sleep(3600)


def test_workers_that_hang_are_killed_and_named(monkeypatch):
    monkeypatch.setattr(play_module, "EPISODE_TIMEOUT_S", 3.0)
    player_spec = PlayerSpec(make_player=Sleeper, env=SMALL, identity={"player": "sleeper"})
    with pytest.raises(WaitTimeoutError, match=r"waited 3 s for one of 2 workers to end an episode; 3 are left"):
        list(play([(player_spec, Episode(TASK, number)) for number in range(3)], num_workers=2))
    assert multiprocessing.active_children() == []
