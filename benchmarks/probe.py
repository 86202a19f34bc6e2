"""A supervised probe of encoders and augmentations: what a network sees on tasks that it was not trained on.

    python -m benchmarks.probe --scenario defend_the_center --encoders nature height_pool --augment none shift

A network of an encoder and a dense head learns, from frames of the scripted player on training tasks, which action it
takes and in which columns of the frame things are in sight. It is scored on held-out episodes and on the gate tasks.
The scores say what a network can see, without the noise of reinforcement learning, and not how well it plays.
"""

import contextlib
import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jaxtyping import Array, Bool, Float, UInt8

from benchmarks.probe_frames import NUM_COLUMNS, THINGS, Frames, chosen, joined, task_frames
from benchmarks.record import describe_commit, describe_machine
from gvz.actions import action_buttons
from gvz.core.errors import ConfigError, GvzError
from gvz.core.records import Writer
from gvz.run import machine
from gvz.run.config import RunConfig
from gvz.run.config_files import load_config
from gvz.tasks import TaskSet, named_tasks, scenario_named
from learner.augment import augment
from learner.config import AgentConfig
from learner.encoders.base import make_encoder
from learner.memory import keep_freed_memory

TRAINING: TaskSet = "train4"
GATE_SHARE = 0.25
"""frames of gate tasks for each frame of training tasks"""
HELD_OUT_SHARE = 0.2
"""of a training task's episodes, the last ones"""
BATCH_SIZE = 128
CLEAN_SHARE = 0.5
"""of an augmented batch: samples that stay as they are"""
MAX_POSITIVE_WEIGHT = 20.0
"""a column where a thing is in sight weighs as much more than one where it is not, as it is rarer, up to this"""
NUM_LOOKS = 4
"""times that a network is scored, at equal distances of processor time; the last one is at the end"""


@dataclass(frozen=True, kw_only=True)
class Probe:
    """Train networks on frames of the scripted player, score them on gate tasks, append a row for each look."""

    scenario: tuple[str, ...]
    """scenarios, one after another"""
    encoders: tuple[str, ...] = ("nature",)
    """modules in learner/encoders, or paths of Python files"""
    augment: tuple[str, ...] = ("none",)
    """names of learner/augment.py, those of one variant joined by commas; none: clean frames"""
    seeds: int = 2
    """networks of each variant"""
    minutes: float = 5.0
    """processor time that a network is trained for"""
    frames: int = 20_000
    """of a scenario's training tasks, and a quarter as many of its gate tasks; they are cached"""
    config: str = "rainbow_quick"
    """config whose frame size, stack, convolutions, hidden units and learning rate are used"""
    out: Path = Path("runs/probe.jsonl")
    """record file, JSON lines"""

    def run(self) -> None:
        """Raises ConfigError for a value that cannot be, EngineError if the engine failed."""
        config = load_config(self.config)
        self._check()
        about = {
            "benchmark": "probe",
            "commit": describe_commit(),
            "date": time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime()),
            "command": shlex.join(["python", "-m", "benchmarks.probe", *sys.argv[1:]]),
            "machine": describe_machine(),
            "versions": machine.versions(),
            **{name: getattr(self, name) for name in ("config", "frames", "minutes")},
        }
        self.out.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.closing(Writer(self.out)) as writer:
            for scenario in self.scenario:
                print(f"{scenario}: frames of the scripted player", flush=True)
                trained, scored = self._frames(scenario, config)
                for encoder, names, seed in product(self.encoders, self.augment, range(self.seeds)):
                    training = Training(config, scenario, replace(config.agent, encoder=encoder), names, seed, trained)
                    variant = {"scenario": scenario, "encoder": encoder, "augment": names, "seed": seed}
                    row: dict[str, Any] = {}
                    for look in range(1, NUM_LOOKS + 1):
                        row = training.until(60 * self.minutes * look / NUM_LOOKS)
                        row |= {name: training.scores(frames) for name, frames in scored.items()}
                        writer.append({**about, **variant, **row})
                    print(f"{' '.join(map(str, variant.values()))}: {_line(row)}", flush=True)

    def _check(self) -> None:
        for name, least in (("seeds", 1), ("minutes", 1e-3), ("frames", 400)):
            if getattr(self, name) < least:
                raise ConfigError(f"--{name}: got {getattr(self, name)}, want at least {least}")
        for check, names in ((scenario_named, self.scenario), (make_encoder, self.encoders)):
            for name in names:
                check(name)
        for names in self.augment:
            augment(_split(names), jax.random.key(0), jnp.zeros((1, 8, 8, 1), jnp.uint8), 1)

    def _frames(self, scenario: str, config: RunConfig) -> tuple[Frames, dict[str, Frames]]:
        """Frames to train on; frames to score on: `held_out`, `gate`, and each gate task by its id."""

        def played(tasks: TaskSet, total: float) -> dict[str, Frames]:
            found = named_tasks(scenario, split=tasks)
            size = (config.env, config.agent.stack_size, round(total / len(found)))
            return {task.id: task_frames(task, *size) for task in found}

        training, gate = played(TRAINING, self.frames).values(), played("gate", GATE_SHARE * self.frames)
        last = [one["episodes"] > (1 - HELD_OUT_SHARE) * one["episodes"].max() for one in training]
        trained = joined([chosen(one, ~rows) for one, rows in zip(training, last, strict=True)])
        held_out = joined([chosen(one, rows) for one, rows in zip(training, last, strict=True)])
        return trained, {"held_out": held_out, "gate": joined(list(gate.values())), **gate}


class Network(nn.Module):
    """Stacks to the logits of the action, [B, A], and of every thing in every column, [B, T, K]."""

    config: AgentConfig
    num_actions: int

    @nn.compact
    def __call__(self, stacks: UInt8[Array, "B H W SC"]) -> tuple[Float[Array, "B A"], Float[Array, "B T K"]]:
        """An encoder, a hidden layer, a rectifier, an output layer."""
        x = make_encoder(self.config.encoder)(stacks.astype(jnp.float32) / 255, self.config)
        x = nn.relu(nn.Dense(self.config.hidden_units)(x))
        x = nn.Dense(self.num_actions + len(THINGS) * NUM_COLUMNS)(x)
        return x[:, : self.num_actions], x[:, self.num_actions :].reshape(-1, len(THINGS), NUM_COLUMNS)


class Training:
    """A network in training, and its scores."""

    def __init__(self, config: RunConfig, scenario: str, agent: AgentConfig, names: str, seed: int, frames: Frames):
        """Takes one gradient step, which compiles and counts as no processor time."""
        network = Network(agent, len(action_buttons(scenario_named(scenario), "buttons")))
        key_init, self._key = jax.random.split(jax.random.key(seed))
        optimizer = optax.adam(config.learner.learning_rate)
        params = network.init(key_init, jnp.asarray(frames["stacks"][:1]))
        share = frames["seen"].mean(axis=(0, 2))
        weights = np.clip((1 - share) / np.maximum(share, 1e-9), 1.0, MAX_POSITIVE_WEIGHT).astype(np.float32)[:, None]
        self._state: Any = (params, optimizer.init(params))
        self._apply, self._frames, self._rng = jax.jit(network.apply), frames, np.random.default_rng(seed)
        self._num_updates, self._spent_s = 0, 0.0

        def loss(params: Any, stacks: Array, actions: Array, seen: Array) -> Float[Array, ""]:
            """Cross-entropy of the action plus, for each thing, the mean binary cross-entropy over columns."""
            answers: Any = network.apply(params, stacks)
            by_column = optax.sigmoid_binary_cross_entropy(answers[1], seen) * jnp.where(seen, weights, 1.0)
            by_action = optax.softmax_cross_entropy_with_integer_labels(answers[0], actions)
            return by_action.mean() + by_column.mean(axis=(0, 2)).sum()

        def update(state: Any, key: Array, stacks: Array, actions: Array, seen: Array) -> Any:
            params, moments = state
            stacks = augment(_split(names), key, stacks, config.env.channels, clean_share=CLEAN_SHARE)
            change, moments = optimizer.update(jax.grad(loss)(params, stacks, actions, seen), moments, params)
            return optax.apply_updates(params, change), moments

        self._update = jax.jit(update, donate_argnums=0)
        self._step()

    def _step(self) -> None:
        rows = self._rng.integers(len(self._frames["actions"]), size=BATCH_SIZE)
        batch = [self._frames[name][rows] for name in ("stacks", "actions", "seen")]
        key = jax.random.fold_in(self._key, self._num_updates)
        self._state = jax.block_until_ready(self._update(self._state, key, *batch))
        self._num_updates += 1

    def until(self, processor_s: float) -> dict[str, Any]:
        """Trains up to this processor time, scores apart; returns what it has taken."""
        begin_s = time.process_time() - self._spent_s
        while (spent_s := time.process_time() - begin_s) < processor_s:
            self._step()
        self._spent_s = spent_s
        return {"processor_s": spent_s, "updates": self._num_updates}

    def scores(self, frames: Frames) -> dict[str, Any]:
        """Accuracy of the action, beside that of always the most frequent one; of every thing `binary_scores`."""
        stacks, actions = frames["stacks"], frames["actions"]
        batches = [stacks[first : first + BATCH_SIZE] for first in range(0, len(stacks), BATCH_SIZE)]
        full = (np.resize(batch, (BATCH_SIZE, *stacks.shape[1:])) for batch in batches)  # one size compiles once
        answers: list[Any] = [jax.device_get(self._apply(self._state[0], batch)) for batch in full]
        action_logits, logits = (np.concatenate(part)[: len(actions)] for part in zip(*answers, strict=True))
        found: dict[str, Any] = {
            "num_frames": len(actions),
            "action_accuracy": float((action_logits.argmax(axis=1) == actions).mean()),
            "most_frequent_action": float(np.bincount(actions).max() / len(actions)),
        }
        for i, thing in enumerate(THINGS):
            of_thing = binary_scores(logits[:, i] > 0, frames["seen"][:, i])
            found |= {f"{thing}_{name}": value for name, value in of_thing.items()}
        return found


def binary_scores(said: Bool[np.ndarray, "N K"], true: Bool[np.ndarray, "N K"]) -> dict[str, float | None]:
    """Balanced accuracy (mean of the shares found of the true and of the false) and F1; None without both kinds."""
    if true.all() or not true.any():
        return {"balanced_accuracy": None, "f1": None}
    return {
        "balanced_accuracy": float((said[true].mean() + (~said[~true]).mean()) / 2),
        "f1": float(2 * (said & true).sum() / (said.sum() + true.sum())),
    }


def _split(names: str) -> tuple[str, ...]:
    return () if names == "none" else tuple(names.split(","))


def _line(row: dict[str, Any]) -> str:
    """The scores of a look, percent: held-out episodes, then gate tasks."""
    names = {"action": "action_accuracy", **{thing: f"{thing}_balanced_accuracy" for thing in THINGS}}
    pairs = {name: (row["held_out"][field], row["gate"][field]) for name, field in names.items()}
    parts = (f"{name} {100 * a:.1f} -> {100 * b:.1f}" for name, (a, b) in pairs.items() if None not in (a, b))
    return ", ".join((f"{row['updates']} updates", *parts))


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns the exit code."""
    keep_freed_memory()
    try:
        tyro.cli(Probe, args=arguments, prog="python -m benchmarks.probe").run()
    except GvzError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


if __name__ == "__main__":
    sys.exit(main())
