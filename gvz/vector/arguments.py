"""What a user gives to a vector environment, checked."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Discrete, MultiDiscrete
from gymnasium.vector import AutoresetMode

from gvz.core.env_config import as_integer, given_episode_seed, typed
from gvz.core.errors import ConfigError
from gvz.scenarios.base import Task
from gvz.tasks import id_for_processes


def task_ids(tasks: Task | str | Sequence[Task | str]) -> list[str]:
    """Ids of one task or of several.

    Raises:
        ConfigError: there is none. TaskError: as `id_for_processes`.
    """
    several = list(tasks) if isinstance(tasks, Iterable) and not isinstance(tasks, str) else [tasks]
    if not several:
        raise ConfigError("make_vec: got no task, want at least one, for example 'defend_the_center/gore'")
    return [id_for_processes(task) for task in several]


def number(name: str, value: int | None, *, default: int, most: int | None = None) -> int:
    """A number of things.

    Raises:
        ConfigError: it is no int, or outside 1..most.
    """
    count: int = default if value is None else typed(int, value, f"make_vec: {name}")
    if count < 1 or (most is not None and count > most):
        raise ConfigError(f"make_vec: got {name}={count}, want {'1 or more' if most is None else f'1..{most}'}")
    return count


def autoreset_mode(mode: AutoresetMode | str) -> AutoresetMode:
    """Gymnasium's mode, or the one with this value.

    Raises:
        ConfigError: there is none.
    """
    values = [known.value for known in AutoresetMode]
    if mode not in (*AutoresetMode, *values):
        raise ConfigError(f"make_vec: got autoreset_mode {mode!r}, want one of {', '.join(values)}")
    return AutoresetMode(mode)


def game_numbers(env_ids: np.ndarray | None, num_envs: int) -> np.ndarray:
    """int[B], each game at most once; None stands for all.

    Raises:
        ValueError: no such game, or one twice.
    """
    if env_ids is None:
        return np.arange(num_envs)
    games = np.asarray(env_ids)
    if games.ndim != 1 or not np.issubdtype(games.dtype, np.integer) or not np.isin(games, np.arange(num_envs)).all():
        raise ValueError(f"env_ids: got {games.tolist()}, want a list of numbers from 0 to {num_envs - 1}")
    if len(np.unique(games)) < len(games):
        raise ValueError(f"env_ids: got {games.tolist()}, want each game once")
    return games


def action_numbers(actions: np.ndarray, games: np.ndarray, space: Discrete | MultiDiscrete) -> list[int | list[int]]:
    """One action of `space` for each of these games.

    Raises:
        ValueError: another number of actions, another type, or no such action.
    """
    actions = np.asarray(actions)
    numbers = np.asarray(space.nvec if isinstance(space, MultiDiscrete) else space.n)
    shape = (*games.shape, *numbers.shape)
    if actions.shape != shape or not np.issubdtype(actions.dtype, np.integer):
        raise ValueError(f"actions: got {actions.dtype}{list(actions.shape)}, want int{list(shape)}")
    if ((actions < 0) | (actions >= numbers)).any():
        raise ValueError(f"actions: got {actions.tolist()}, want integers from 0 to {(numbers - 1).tolist()}")
    return actions.tolist()


def seeds(seed: Any, num_envs: int) -> list[int | None]:
    """The seed of each game: seed + i, or seed[i], which may be None.

    Raises:
        ValueError: not one seed for each game, or one that is no integer from 0 on.
    """
    if seed is None:
        return [None] * num_envs
    if (first := as_integer(seed)) >= 0:
        return [first + game for game in range(num_envs)]
    try:
        given: list[object] = list(seed)
    except TypeError:
        raise ValueError(f"reset: seed: got {seed!r}, want an integer, 0 or more, or one for each game") from None
    if len(given) != num_envs:
        raise ValueError(f"reset: got {len(given)} seeds, want {num_envs}, one for each game")
    for game, one in enumerate(given):
        if one is not None and as_integer(one) < 0:
            raise ValueError(f"reset: seed of game {game}: got {one!r}, want an integer, 0 or more")
    return [None if one is None else as_integer(one) for one in given]


def reset_options(options: dict[str, object] | None, num_envs: int) -> tuple[int | None, np.ndarray]:
    """(episode seed, mask bool[N] of the games to reset) of the options of `reset`.

    Raises:
        ValueError: an unknown option, an episode seed outside [0, 2^31), or what is no mask.
    """
    options = options or {}
    episode_seed, mask = given_episode_seed(options, ("reset_mask",)), options.get("reset_mask")
    if mask is None:
        return episode_seed, np.ones(num_envs, bool)
    if not isinstance(mask, np.ndarray) or mask.dtype != bool or mask.shape != (num_envs,) or not mask.any():
        raise ValueError(f"reset: reset_mask {mask!r}, want a numpy array bool[{num_envs}] with at least one True")
    return episode_seed, mask
