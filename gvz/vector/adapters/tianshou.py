"""A `gvz.make_vec` for Tianshou's collectors.

`TianshouVectorEnv(gvz.make_vec(task, 8, batch_size=1, autoreset_mode="Disabled"))`
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from gvz.core.errors import ConfigError
from gvz.vector.arguments import game_numbers
from gvz.vector.env import DoomVectorEnv

Games = np.ndarray | Sequence[int] | int | None
"""numbers of games; None stands for all"""


class TianshouVectorEnv:
    """Games in worker processes. Observations are stacks of the last frames, u8[N, num_stack, 84, 84, C], newest last.

    Tianshou itself resets the games whose episodes are over, and it steps any set of games. So `gvz.make_vec` needs the
    two arguments below.

    Args:
        envs: of `gvz.make_vec(..., batch_size=1, autoreset_mode="Disabled")`; closed together with this object.
        num_stack: frames of an observation.

    Raises:
        ConfigError: another batch size or autoreset mode, or buffers.
    """

    is_async = False

    def __init__(self, envs: DoomVectorEnv, num_stack: int = 4):
        mode = envs.metadata["autoreset_mode"]
        if envs.batch_size != 1 or mode != AutoresetMode.DISABLED:
            raise ConfigError(
                f"TianshouVectorEnv: got envs with batch_size {envs.batch_size} and autoreset_mode {mode.value!r}; "
                'want batch_size=1 and autoreset_mode="Disabled", because Tianshou steps and resets any set of games'
            )
        shape = envs.single_observation_space.shape
        if shape is None:
            raise ConfigError("TianshouVectorEnv: got envs with buffers, want none: it stacks the frames of the screen")
        self.envs, self.env_num = envs, envs.num_envs
        self.action_space = [envs.single_action_space] * envs.num_envs
        self.observation_space = [batch_space(envs.single_observation_space, num_stack)] * envs.num_envs
        self._stacks = np.zeros((envs.num_envs, num_stack, *shape), np.uint8)

    def __len__(self) -> int:
        return self.env_num

    def reset(
        self, env_id: Games = None, *, seed: Any = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Begins episodes of these games, of all by default: observations, and infos.

        Args:
            env_id: numbers of the games.
            seed, options: as for `DoomVectorEnv.reset`.
        """
        games = self._games(env_id)
        mask = np.isin(np.arange(self.env_num), games)
        frames, infos = self.envs.reset(seed=seed, options={**(options or {}), "reset_mask": mask})
        self._stacks[games] = frames[games, None]
        return self._stacks[games], np.array([_info(game, infos, game) for game in games])

    def seed(self, seed: int | Sequence[int | None] | None = None) -> list[list[int]]:
        """Begins new sequences of episodes in all games, as Tianshou's own do: game i gets seed + i, or seed[i].

        Returns the seeds; the next `reset` without one begins the second episodes.
        """
        self.reset(seed=seed)
        return [[one] for one in self.envs.np_random_seed]

    def step(self, action: np.ndarray, id: Games = None) -> tuple[np.ndarray, ...]:
        """One decision of each of these games, of all by default: observations, rewards, terminated, truncated, infos.

        An info has the game's `env_id`, the episode's `score` so far, and whether it ended in an `engine_crash`.
        """
        id = self._games(id)
        self.envs.send(np.atleast_1d(action), id)
        answers = {int(answer[-1]["env_id"][0]): answer for answer in (self.envs.recv() for _ in id)}
        frames, rewards, terminated, truncated = (
            np.concatenate([answers[game][part] for game in id]) for part in range(4)
        )
        self._stacks[id] = np.concatenate([self._stacks[id][:, 1:], frames[:, None]], axis=1)
        return (
            self._stacks[id],
            rewards,
            terminated,
            truncated,
            np.array([_info(game, answers[game][-1], 0) for game in id]),
        )

    def _games(self, given: Games) -> np.ndarray:
        """int[B]; ValueError if there is no such game."""
        return game_numbers(None if given is None else np.atleast_1d(given), self.env_num)

    def render(self) -> Sequence[np.ndarray]:
        """The screens of all games, u8[H, W, 3] each; none without a render mode."""
        return self.envs.render() or ()

    def close(self) -> None:
        """Ends the games and their processes."""
        self.envs.close()


def _info(game: int, infos: dict[str, Any], row: int) -> dict[str, Any]:
    score, crashed = infos["score"][row], infos["engine_crash"][row]
    return {"env_id": int(game), "score": float(score), "engine_crash": bool(crashed)}
