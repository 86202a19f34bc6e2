"""An episode shown is the episode evaluated, however large it is drawn."""

from contextlib import closing

import pytest

from gvz.core.env_config import EnvConfig
from gvz.core.errors import EngineError
from gvz.env import DoomEnv
from gvz.evaluation.episode_log import simple_player
from gvz.evaluation.play import Episode, PlayerSpec, play_episode
from gvz.evaluation.playback import SCREEN_HEIGHT, SCREEN_WIDTH, perform
from gvz.evaluation.players import RandomPlayer

EPISODE = Episode("defend_the_center/complete", 3, 1)


@pytest.mark.engine
def test_what_is_shown_is_what_is_evaluated():
    player_spec = simple_player("random", EnvConfig(reward_weights=(("death", -2.0),)))
    with closing(DoomEnv(EPISODE.task, player_spec.env)) as env:
        row = play_episode(env, RandomPlayer(), EPISODE.episode, EPISODE.base_seed)
    decisions, rewards, actions = [], [0.0], {}
    for tic, moment in enumerate(perform(player_spec, EPISODE)):
        assert moment.frames == tic
        assert moment.screen.shape == (SCREEN_HEIGHT, SCREEN_WIDTH, 3)
        if moment.decided:
            decisions.append(tic)
        if moment.reward != rewards[-1]:
            assert (tic % 4 == 0) or moment.terminated, "a decision's reward comes with its last tic"
        rewards.append(moment.reward)
        actions.setdefault((tic + 3) // 4, set()).add(moment.action)
    assert decisions[:4] == [0, 1, 5, 9]
    assert len(decisions) == 1 + row["length_steps"]
    assert actions.pop(0) == {None}
    assert all(len(held) == 1 for held in actions.values())
    assert (moment.score, moment.frames) == (row["score"], row["length_frames"])
    assert (moment.terminated, moment.truncated) == (row["terminated"], row["truncated"])
    assert moment.reward == pytest.approx(row["reward"])
    assert moment.reward_components == pytest.approx(row["reward_components"])
    assert moment.reward_components["death"] == -2.0


class Meddler(RandomPlayer):
    """Does something to the engine of its game after three decisions."""

    def __init__(self, meddle):
        self._meddle = meddle
        self._decisions = 0

    def begin(self, env, observation, info, seed):
        self._engine = env._engine
        super().begin(env, observation, info, seed)

    def observe(self, observation, info):
        self._decisions += 1
        if self._decisions == 3:
            self._meddle(self._engine)


@pytest.mark.engine
@pytest.mark.parametrize(
    ("meddle", "message"),
    [
        (lambda engine: engine.kill(), "complete, episode 3, tic 12: the engine died; try again"),
        (
            lambda engine: engine.advance([0, 0, 0], 1),
            r"episode 3, tic 17: the game that draws differs from the player's: episode_frames: got 16, want 17",
        ),
    ],
)
def test_games_that_part_are_an_error(meddle, message):
    env = simple_player("random", EnvConfig()).env
    player_spec = PlayerSpec(make_player=lambda: Meddler(meddle), env=env, identity={"player": "meddler"})
    with pytest.raises(EngineError, match=message):
        list(perform(player_spec, EPISODE))
