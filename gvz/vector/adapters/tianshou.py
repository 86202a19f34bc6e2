"""A `gvz.make_vec` for Tianshou's collectors.

`TianshouVectorEnv(gvz.make_vec(task, 8, batch_size=1, autoreset_mode="Disabled"))`
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode

from gvz.core.errors import ConfigError
from gvz.vector.env import DoomVectorEnv


class TianshouVectorEnv:
    """Games in worker processes. Observations are stacks of the last frames, u8[N, num_stack, 84, 84, C], newest last.

    Tianshou itself resets the games whose episodes are over, and it steps any set of games. So `gvz.make_vec` needs the
    two arguments below.

    Args:
        envs: of `gvz.make_vec(..., batch_size=1, autoreset_mode="Disabled")`; closed together with this object.
        num_stack: frames of an observation.

    Raises:
        ConfigError: another batch size or autoreset mode.
    """

    is_async = False

    def __init__(self, envs: DoomVectorEnv, num_stack: int = 4):
        mode = envs.metadata["autoreset_mode"]
        if envs.batch_size != 1 or mode != AutoresetMode.DISABLED:
            raise ConfigError(
                f"TianshouVectorEnv: got envs with batch_size {envs.batch_size} and autoreset_mode {mode.value!r}; "
                'want batch_size=1 and autoreset_mode="Disabled", because Tianshou steps and resets any set of games'
            )
        self.envs, self.env_num = envs, envs.num_envs
        self.action_space = [envs.single_action_space] * envs.num_envs
        self._stacks = np.zeros((envs.num_envs, num_stack, *envs.single_observation_space.shape), np.uint8)

    def __len__(self) -> int:
        return self.env_num

    def reset(self, env_id: Sequence[int] | None = None, **_: Any) -> tuple[np.ndarray, np.ndarray]:
        """Begins episodes of these games, of all by default: observations, and infos with the `env_id` of each."""
        games = np.arange(self.env_num) if env_id is None else np.asarray(env_id)
        frames, _ = self.envs.reset(options={"reset_mask": np.isin(np.arange(self.env_num), games)})
        self._stacks[games] = frames[games, None]
        return self._stacks[games], np.array([{"env_id": game} for game in games])

    def step(self, action: np.ndarray, id: np.ndarray) -> tuple[np.ndarray, ...]:
        """One decision of each of these games: observations, rewards, terminated, truncated, infos."""
        self.envs.send(np.asarray(action), id)
        answers = {int(answer[-1]["env_id"][0]): answer for answer in (self.envs.recv() for _ in id)}
        frames, rewards, terminated, truncated = (
            np.concatenate([answers[game][part] for game in id]) for part in range(4)
        )
        self._stacks[id] = np.concatenate([self._stacks[id][:, 1:], frames[:, None]], axis=1)
        return self._stacks[id], rewards, terminated, truncated, np.array([{"env_id": game} for game in id])

    def close(self) -> None:
        """Ends the games and their processes."""
        self.envs.close()
