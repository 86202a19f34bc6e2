"""An evaluation episode, moment by moment, for a window or a video.

What a player sees must not depend on the size of the picture. So the episode is played in two games: the player's own,
and one that draws a large picture and takes the same actions, tic by tic. The engine is deterministic; if
the two games differ at a tic, that is an error.
"""

from collections.abc import Generator
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np

from gvz.core.env_config import EnvConfig
from gvz.core.errors import EngineError
from gvz.env import DoomEnv
from gvz.evaluation.play import Episode, PlayerSpec, Row, Tally, episode_seed
from gvz.evaluation.trained import TrainedPlayer, Values

SCREEN_WIDTH, SCREEN_HEIGHT = 800, 450
"""of the large game's screen, pixels; a resolution of ViZDoom's"""
END_S = 1.5
"""for how long the last picture stays, seconds"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Moment:
    """What a picture of a game tic shows."""

    screen: np.ndarray
    """uint8[SCREEN_HEIGHT, SCREEN_WIDTH, 3]"""
    decided: bool
    """the player has just decided, or the episode has just begun: `action`, `values` are new"""
    action: int | None = None
    """that is held; None before the first"""
    values: Values | None = None
    """the policy's estimates of its actions when it decided"""
    reward: float
    """since the episode's start"""
    reward_components: dict[str, float]
    """by name, since the episode's start"""
    score: float
    frames: int
    """tics since the episode's start"""
    terminated: bool = False
    truncated: bool = False
    row: Row | None = None
    """of the last moment: the episode's row of an evaluation"""

    @property
    def ending(self) -> str:
        """Of the last moment that is shown: "died at tic 312, score 312"."""
        how = "died" if self.terminated else "reached the time-out" if self.truncated else "was cut off"
        return f"{how} at tic {self.frames}, score {self.score:g}"


def perform(player_spec: PlayerSpec, episode: Episode) -> Generator[Moment, None, None]:
    """Plays an episode: the first moment is its start, then comes one a tic.

    Raises:
        EngineError: an engine died, or the two games differ.
    """
    seed = episode_seed(*episode)
    player = player_spec.make_player()
    large = EnvConfig(
        profile=player_spec.env.profile,
        action_set=player_spec.env.action_set,
        frame_skip=1,
        render_width=SCREEN_WIDTH,
        render_height=SCREEN_HEIGHT,
    )
    with (
        closing(DoomEnv(episode.task, player_spec.env, recycle_episodes=player_spec.recycle_episodes)) as env,
        closing(DoomEnv(episode.task, large, render_mode="rgb_array")) as stage,
    ):
        observation, info = env.reset(options={"episode_seed": seed})
        stage_info = stage.reset(options={"episode_seed": seed})[1]
        player.begin(env, observation, info, seed)
        rewards: dict[str, float] = dict.fromkeys(info["reward_components"], 0.0)
        tally = Tally(episode)
        yield _moment(stage, stage_info, rewards, decided=True)
        ended = False
        while not ended:
            action = player.act()
            values = player.values if isinstance(player, TrainedPlayer) else None
            observation, reward, terminated, truncated, info = env.step(action)
            ended = terminated or truncated
            tally.add(float(reward), info)
            before, rewards = rewards, dict(tally.components)
            for tic in range(player_spec.env.frame_skip):
                _, _, stage_terminated, stage_truncated, stage_info = stage.step(action)
                stage_ended = stage_terminated or stage_truncated
                done = (stage_info["episode_frames"], stage_ended) == (info["episode_frames"], ended)
                yield _moment(
                    stage,
                    stage_info,
                    rewards if done else before,
                    decided=tic == 0,
                    action=int(action),
                    values=values,
                    terminated=stage_terminated,
                    truncated=stage_truncated,
                    row=tally.row(info, terminated, truncated) if ended and done else None,
                )
                if done or stage_ended:
                    break
            _check_together(episode, info, stage_info)
            player.observe(observation, info)


def _moment(stage: DoomEnv, info: dict[str, Any], rewards: dict[str, float], **fields: Any) -> Moment:
    screen = stage.render()
    assert screen is not None, "the stage renders"
    return Moment(
        screen=screen,
        reward=sum(rewards.values()),
        reward_components=rewards,
        score=float(info["score"]),
        frames=int(info["episode_frames"]),
        **fields,
    )


def _check_together(episode: Episode, info: dict[str, Any], stage_info: dict[str, Any]) -> None:
    """Raises EngineError unless both games are at the same point."""
    where = f"{episode.task}, episode {episode.episode}, tic {info['episode_frames']}"
    if info["engine_crash"] or stage_info["engine_crash"]:
        raise EngineError(f"{where}: the engine died; try again")
    for name in ("episode_frames", "score", "variables"):
        if info[name] != stage_info[name]:
            raise EngineError(
                f"{where}: the game that draws differs from the player's: {name}: got {stage_info[name]}, "
                f"want {info[name]}"
            )
