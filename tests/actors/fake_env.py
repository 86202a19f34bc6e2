"""A game that counts, for faults of the pool itself, and what its records must look like.

Bytes 0..3 of a frame are the episode's seed, bytes 4..7 the decisions since it began, all others (seed + decisions)
mod 251. The reward of the t-th decision is t, the score the sum of the actions.
"""

import os
import signal
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from actors.config import ActorsConfig
from actors.loop import derive_seed
from actors.pool import PoolConfig
from actors.preprocess import ObservationBatch
from gvz.transport.messages import StepBlock

FRAME_SHAPE = (12, 10, 3)


def frame(seed: int, num_steps: int) -> np.ndarray:
    flat = np.full(int(np.prod(FRAME_SHAPE)), (seed + num_steps) % 251, np.uint8)
    flat[:4] = np.frombuffer(np.uint32(seed).tobytes(), np.uint8)
    flat[4:8] = np.frombuffer(np.uint32(num_steps).tobytes(), np.uint8)
    return flat.reshape(FRAME_SHAPE)


class CountingEnv(gymnasium.Env[np.ndarray, int]):
    """A game made of options.

    length: decisions an episode. end: "terminated" or "truncated". step_s: seconds a decision takes.
    fault: raise, segfault, hang, crash (the engine's own way) at decision `fault_at` of the process's life, or
    crash_between (the same, seen at the next episode's start), or no_start; each time, or once if there is a
    `fault_file`; in all tasks, or in `fault_task`.
    """

    def __init__(self, task: str, options: dict[str, Any]):
        self.observation_space = gymnasium.spaces.Box(0, 255, FRAME_SHAPE, np.uint8)
        self.action_space = gymnasium.spaces.Discrete(5)
        self.task = task
        self.options = options
        self.seed_, self.num_steps, self.life_steps, self.action_sum = 0, 0, 0, 0
        if options.get("fault") == "no_start" and self.strike():
            raise RuntimeError("no engine today")

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        assert options is not None
        self.seed_, self.num_steps, self.action_sum = options["episode_seed"], 0, 0
        info = self.info({})
        if self.options.get("fault") == "crash_between" and self.life_steps > 0 and self.strike():
            info |= {"engine_crash": True, "engine_error": "it is no more"}
        return frame(self.seed_, 0), info

    def step(self, action: int):
        assert self.action_space.contains(int(action)), action
        time.sleep(self.options.get("step_s", 0.0))
        self.num_steps += 1
        self.life_steps += 1
        self.action_sum += action
        crashed = self.life_steps == self.options.get("fault_at") and self.strike() and self.options["fault"] == "crash"
        over = self.num_steps >= self.options["length"]
        terminated = over and self.options.get("end", "terminated") == "terminated"
        info = self.info({"count": float(self.num_steps), "action": 0.0})
        if crashed:
            info["engine_crash"] = True
        reward = float(self.num_steps)
        return frame(self.seed_, self.num_steps), reward, terminated, (over and not terminated) or crashed, info

    def info(self, components: dict[str, float]) -> dict[str, Any]:
        return {
            "score": float(self.action_sum),
            "normalized_score": 0.0,
            "reward_components": components,
            "variables": {"STEPS": float(self.num_steps), "SEED": float(self.seed_ % 1000)},
            "episode_frames": 4 * self.num_steps,
            "episode_seed": self.seed_,
        }

    def strike(self) -> bool:
        """Does the fault if it is this task's and has not struck before."""
        if self.options.get("fault_task", self.task) != self.task:
            return False
        if (file := self.options.get("fault_file")) is not None:
            try:
                os.close(os.open(file, os.O_CREAT | os.O_EXCL))
            except FileExistsError:
                return False
        match self.options["fault"]:
            case "raise":
                raise RuntimeError("this step was meant to fail")
            case "segfault":
                os.kill(os.getpid(), signal.SIGSEGV)
            case "hang":
                time.sleep(3600)
        return True


def export_act(act: Any, param_shapes: Sequence[tuple[int, ...]], obs: ObservationBatch, num_extras: int = 0) -> bytes:
    """An acting function, act(leaves, obs, key, epsilon) -> actions (and extras, if there are any), as bytes."""
    import jax  # not by an actor that imports this file: it takes longer than all else there
    import jax.export
    import jax.numpy as jnp

    def policy(leaves, arrays, key, epsilon):
        found = act(leaves, arrays, key, epsilon)
        return found if num_extras else (found, jnp.zeros((len(found), 0)))

    arguments = (
        [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in param_shapes],
        {name: jax.ShapeDtypeStruct(array.shape, array.dtype) for name, array in obs.arrays.items()},
        jax.ShapeDtypeStruct((2,), jnp.uint32),
        jax.ShapeDtypeStruct((), jnp.float32),
    )
    return bytes(jax.export.export(jax.jit(policy), platforms=["cpu"])(*arguments).serialize())


def first_param_policy(num_params: int) -> bytes:
    """The acting function of two games that plays its first parameter."""

    def act(params, obs, _key, _epsilon):
        return params[0][0].astype("int32") + 0 * obs["task"]

    return export_act(act, [(num_params,)], ObservationBatch(2, FRAME_SHAPE, 4))


def make(task: str, options: dict[str, Any]) -> CountingEnv:
    return CountingEnv(task, options)


def config(
    work_dir: Path, options: dict[str, Any], *, actors: ActorsConfig | None = None, **changes: Any
) -> PoolConfig:
    """A pool of 2 actors with 2 games each of tasks a and b, that play at random."""
    defaults: dict[str, Any] = {
        "tasks": ("a", "b"),
        "num_actors": 2,
        "games_per_actor": 2,
        "seed": 1,
        "stack_size": 4,
        "policy": b"",
        "num_params": 0,
        "layout_hash": 0,
    }
    return PoolConfig(
        env_entry_point="fake_env:make",
        env_config={"length": 10, **options},
        frame_shape=FRAME_SHAPE,
        num_actions=5,
        actors=ActorsConfig() if actors is None else actors,
        work_dir=work_dir,
        **{**defaults, **changes},
    )


class Checker:
    """Follows every lane's stream of records and counts; anything lost, repeated, torn or mixed up fails."""

    def __init__(self, config: PoolConfig):
        self.config = config
        self.num_records = 0
        self.num_cuts = 0
        """episodes whose stream stopped before its last record"""
        self.last: dict[int, np.void] = {}
        """the newest record of each lane"""
        self.assigned: dict[int, int] = {}
        """the task that a lane was given later"""

    def add(self, blocks: list[StepBlock]) -> None:
        for block in blocks:
            for step, picture in zip(block.steps, block.frames, strict=True):
                self._add(step, picture)

    def _add(self, step: np.void, picture: np.ndarray) -> None:
        lane, task, episode = int(step["lane"]), int(step["task"]), int(step["episode"])
        assert task in (lane % len(self.config.tasks), self.assigned.get(lane))
        last = self.last.get(lane)
        t = int(step["reward"])
        seed = derive_seed(self.config.seed, task, lane, episode)
        np.testing.assert_array_equal(picture, frame(seed, t))
        over = t == self.config.env_config["length"]
        assert bool(step["first"]) == (t == 0)
        assert bool(step["terminated"]) == (over and self.config.env_config.get("end") != "truncated")
        if self.config.env_config.get("fault") != "crash":
            assert bool(step["truncated"]) == (over and self.config.env_config.get("end") == "truncated")
        assert 0 <= step["action"] < self.config.num_actions
        if last is not None and not step["first"]:
            assert episode == last["episode"]
            assert t == last["reward"] + 1
        elif last is not None:
            assert episode > last["episode"]
            self.num_cuts += not (last["terminated"] or last["truncated"])
        else:
            assert step["first"]
        self.last[lane] = step.copy()
        self.num_records += 1
