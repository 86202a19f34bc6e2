"""A `gvz.make_vec` as a VecEnv of Stable-Baselines3: `Sb3VecEnv(gvz.make_vec(task, 8, autoreset_mode="SameStep"))`."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode
from stable_baselines3.common.vec_env import VecEnv

from gvz.core.env_config import given_episode_seed
from gvz.core.errors import ConfigError
from gvz.vector.env import DoomVectorEnv


class Sb3VecEnv(VecEnv):
    """Games in worker processes; an episode begins in the same step in which the last one ends.

    Infos have the episode's `score` so far in every step, and in its last one the final score (`VecMonitor` takes it by
    `info_keywords=("score",)`), `terminal_observation`, `TimeLimit.truncated` and `engine_crash`: leave these out.

    Args:
        envs: of `gvz.make_vec(..., autoreset_mode="SameStep")`; closed together with this object.

    Raises:
        ConfigError: another autoreset mode, or a batch size.
    """

    def __init__(self, envs: DoomVectorEnv):
        mode = envs.metadata["autoreset_mode"]
        if mode != AutoresetMode.SAME_STEP:
            raise ConfigError(
                f'Sb3VecEnv: got envs with autoreset_mode {mode.value!r}; want autoreset_mode="SameStep", because '
                "Stable-Baselines3 expects an episode's first observation together with the end of the last one"
            )
        if envs.batch_size != envs.num_envs:
            raise ConfigError(
                f"Sb3VecEnv: got envs with batch_size {envs.batch_size}; leave it out, because Stable-Baselines3 steps "
                f"all {envs.num_envs} games together"
            )
        self.envs, self.render_mode = envs, envs.render_mode
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)
        self.metadata = envs.metadata  # VecVideoRecorder takes the pictures per second from it

    def reset(self) -> np.ndarray:
        """First observations, u8[N, 84, 84, C]; with the seeds of `seed()` and the `episode_seed` of `set_options()`
        if these were called before.

        Raises:
            ValueError: an option that is not `episode_seed`, or another one for each game.
        """
        episode_seeds = {given_episode_seed(options) for options in self._options}
        if len(episode_seeds) != 1:
            raise ConfigError(f"Sb3VecEnv.set_options: got {self._options}, want the same for all games")
        observations, _ = self.envs.reset(seed=self._seeds, options={"episode_seed": episode_seeds.pop()})
        self._reset_seeds()
        self._reset_options()
        return observations

    def step_async(self, actions: np.ndarray) -> None:
        """Sends the actions, i[N]."""
        self.envs.send(actions)

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations u8[N, 84, 84, C], rewards f32[N], whether episodes are over bool[N], and N infos."""
        observations, rewards, terminated, truncated, infos = self.envs.recv()
        over = terminated | truncated
        of_game: list[dict[str, Any]] = [{"score": score} for score in infos["score"].tolist()]
        for i in over.nonzero()[0]:
            of_game[i] = {
                "score": float(infos["final_info"]["score"][i]),
                "engine_crash": bool(infos["final_info"]["engine_crash"][i]),
                "terminal_observation": infos["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
            }
        return observations, rewards.astype(np.float32), over, of_game

    def get_images(self) -> Sequence[np.ndarray | None]:
        """The screens of all games, u8[H, W, 3] each; None without a render mode. `render()` tiles them."""
        return self.envs.render() or [None] * self.num_envs

    def close(self) -> None:
        """Ends the games and their processes."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: int | Sequence[int] | None = None) -> list[Any]:
        """The attribute of the vector environment, once for each game."""
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: object, indices: int | Sequence[int] | None = None) -> None:
        """Not possible: the games are in other processes."""
        raise NotImplementedError("Sb3VecEnv: the games are in other processes; set it by an argument of gvz.make_vec")

    def env_method(self, method_name: str, *args: Any, indices: int | Sequence[int] | None = None, **kwargs: Any):
        """`action_masks` of each game, bool[A], as sb3-contrib's MaskablePPO asks for it.

        Raises:
            NotImplementedError: another method; the games are in other processes.
        """
        if method_name != "action_masks":
            raise NotImplementedError(f"Sb3VecEnv: the games are in other processes; {method_name!r} cannot be called")
        return list(self.envs.action_masks()[list(self._get_indices(indices))])

    def env_is_wrapped(self, wrapper_class: type, indices: int | Sequence[int] | None = None) -> list[bool]:
        """False for each game: they have no wrappers."""
        return [False for _ in self._get_indices(indices)]
