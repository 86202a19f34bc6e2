"""Small pixel games in JAX with known optima, and playing them in lanes. Imports jax and the records of learner.store.

A lane is a dict of what its next record holds, and the game's state.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from learner.agents.base import Agent
from learner.observation import Observation
from learner.store import StepArrays


class Game(NamedTuple):
    """One game as pure functions of one player; the tests vectorize them."""

    reset: Callable[[Array], Any]
    """key -> state"""
    frame: Callable[[Any], Array]
    """state -> bool[H, W]"""
    step: Callable[[Any, Array, Array], tuple[Any, Array, Array]]
    """(state, action, key) -> (state, reward, terminated)"""
    frame_shape: tuple[int, int]
    num_actions: int
    max_steps: int
    optimum: float
    """undiscounted return of the best policy"""


def pixels(shape: tuple[int, int], *points: tuple[Array, Array]) -> Array:
    image = jnp.zeros(shape, bool)
    for row, column in points:
        image = image.at[row, column].set(True)
    return image


def catch(rows: int = 8, columns: int = 5) -> Game:
    """A ball falls one row a step; a paddle in the last row catches it (+1) or not (-1)."""

    def reset(key):
        return {"row": jnp.int32(0), "ball": jax.random.randint(key, (), 0, columns), "paddle": jnp.int32(columns // 2)}

    def frame(s):
        return pixels((rows, columns), (s["row"], s["ball"]), (jnp.int32(rows - 1), s["paddle"]))

    def step(s, action, key):
        del key
        s = s | {"row": s["row"] + 1, "paddle": jnp.clip(s["paddle"] + action - 1, 0, columns - 1)}
        done = s["row"] == rows - 1
        return s, jnp.where(done, jnp.where(s["ball"] == s["paddle"], 1.0, -1.0), 0.0), done

    return Game(reset, frame, step, (rows, columns), 3, rows - 1, 1.0)


def umbrella(length: int = 10, num_actions: int = 2) -> Game:
    """A cue is shown once; the first action must match it, and the answer is paid `length` steps later, +1 or -1.

    Even actions answer cue 0, odd ones cue 1; after the first step nothing the player does matters.
    """

    def reset(key):
        return {"t": jnp.int32(0), "cue": jax.random.randint(key, (), 0, 2), "right": jnp.int32(0)}

    def frame(s):
        mark = jnp.where(s["t"] == 0, s["cue"], 2 + s["right"])
        return pixels((4, length + 1), (jnp.int32(0), s["t"]), (jnp.int32(2), mark))

    def step(s, action, key):
        del key
        right = jnp.where(s["t"] == 0, (action % 2 == s["cue"]).astype(jnp.int32), s["right"])
        s = s | {"t": s["t"] + 1, "right": right}
        done = s["t"] == length
        return s, jnp.where(done, 2.0 * right - 1.0, 0.0), done

    return Game(reset, frame, step, (4, length + 1), num_actions, length, 1.0)


def noisy_rewards(length: int = 8, num_actions: int = 8) -> Game:
    """Every action pays N(0, 1), so every value is 0: what an agent believes beyond that is overestimation."""

    def step(s, action, key):
        del action
        return s | {"t": s["t"] + 1}, jax.random.normal(key), s["t"] == length - 1

    def frame(s):
        return pixels((4, length), (jnp.int32(1), s["t"]))

    return Game(lambda _: {"t": jnp.int32(0)}, frame, step, (4, length), num_actions, length, 0.0)


def lottery() -> Game:
    """One decision: action 0 pays 8 in one of five plays and else nothing; action 1 always pays 0.5."""

    def step(s, action, key):
        ticket = jnp.where(jax.random.uniform(key) < 0.2, 8.0, 0.0)
        return s, jnp.where(action == 0, ticket, 0.5), jnp.bool_(True)

    return Game(lambda _: {"t": jnp.int32(0)}, lambda s: pixels((4, 4), (s["t"], s["t"])), step, (4, 4), 2, 1, 1.6)


def deep_sea(length: int = 6) -> Game:
    """`length` decisions, each with one right action that looks like the other; only all of them together pay 1."""
    right = jnp.asarray(np.random.default_rng(0).integers(0, 2, length))

    def step(s, action, key):
        del key
        s = {"t": s["t"] + 1, "depth": s["depth"] + (action == right[s["t"]])}
        return s, jnp.where(s["depth"] == length, 1.0, 0.0), s["t"] == length

    def frame(s):
        return pixels((length + 1, length + 1), (s["t"], s["depth"]))

    def reset(key):
        del key
        return {"t": jnp.int32(0), "depth": jnp.int32(0)}

    return Game(reset, frame, step, (length + 1, length + 1), 2, length, 1.0)


def rare_door(one_in: int = 500) -> Game:
    """One decision, mostly at a wall where nothing pays; once in `one_in` plays at a door, where action 1 pays 1."""

    def reset(key):
        return {"door": jax.random.randint(key, (), 0, one_in) == 0}

    def frame(s):
        return pixels((4, 4), (s["door"].astype(jnp.int32), jnp.int32(2)))

    def step(s, action, key):
        del key
        return s, jnp.where(s["door"] & (action == 1), 1.0, 0.0), jnp.bool_(True)

    return Game(reset, frame, step, (4, 4), 2, 1, 1.0)


def observe(game: Game, states: Any) -> Array:
    """White pixels on black, uint8[B, H, W, 1]."""
    return 255 * jax.vmap(game.frame)(states)[..., None].astype(jnp.uint8)


def observation(agent: Agent, frames: Array, task: Any = None) -> Observation:
    """What the agent observes of frames uint8[B, H, W, C], of task 0 if none is given; the rest is empty."""
    empty = agent.spec.zeros(len(frames))
    return replace(empty, frames=frames, task=empty.task if task is None else jnp.asarray(task))


def first_records(game: Game, keys: Array) -> dict[str, Any]:
    """What each lane shows at the start of its first episode."""
    states = jax.vmap(game.reset)(keys)
    no = jnp.zeros(len(keys), bool)
    return {
        "state": states,
        "frame": observe(game, states),
        "reward": jnp.zeros(len(keys)),
        "first": ~no,
        "terminated": no,
    }


def play(game: Game, lanes: dict[str, Any], action: Array, key: Array) -> dict[str, Any]:
    """The next record of each lane: a step of its game, or the start of the next episode after the last record."""
    keys_step, keys_reset = jax.random.split(key, (2, len(action)))
    states, reward, terminated = jax.vmap(game.step)(lanes["state"], action, keys_step)
    ended = lanes["terminated"]
    on = {
        "state": states,
        "frame": observe(game, states),
        "reward": reward,
        "first": jnp.zeros(len(action), bool),
        "terminated": terminated,
    }

    def choose(start: Array, go_on: Array) -> Array:
        return jnp.where(ended.reshape(-1, *[1] * (start.ndim - 1)), start, go_on)

    return jax.tree.map(choose, first_records(game, keys_reset), on)


def records(lanes: dict[str, Any], action: Array) -> StepArrays:
    """The lanes' next records, with the actions taken at them."""
    return StepArrays(
        frames=lanes["frame"],
        action=action,
        reward=lanes["reward"],
        lane=jnp.arange(len(action)),
        task=jnp.zeros(len(action), int),
        first=lanes["first"],
        terminated=lanes["terminated"],
        truncated=jnp.zeros(len(action), bool),
        num_valid=jnp.int32(len(action)),
    )


def greedy_returns(game: Game, agent: Agent, params: Any, key: Array, num_episodes: int = 64) -> Array:
    """Undiscounted returns of greedy episodes."""
    key, key_reset = jax.random.split(key)

    def step(carry, key):
        states, alive, total = carry
        action = agent.evaluate(params, observation(agent, observe(game, states))).action
        states, reward, done = jax.vmap(game.step)(states, action, jax.random.split(key, num_episodes))
        return (states, alive & ~done, total + alive * reward), None

    states = jax.vmap(game.reset)(jax.random.split(key_reset, num_episodes))
    carry = (states, jnp.ones(num_episodes, bool), jnp.zeros(num_episodes))
    return jax.lax.scan(step, carry, jax.random.split(key, game.max_steps))[0][2]
