"""A fixed tiny problem, learnt by the real learner, against recorded numbers.

Float32 sums come out differently on processors with other instruction sets, in the last digits. This says whether
the learner of this machine agrees with the recorded one up to those digits: replay, sum tree, noise, loss, gradient,
Adam and target copies take part. `gvz doctor` runs it. To record the numbers again after a change of the learner:

    JAX_PLATFORMS=cpu python -m learner.selfcheck --record
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from learner import replay, sum_tree, train_step
from learner.agents.base import AgentSpec, OffPolicyAgent, make_agent
from learner.agents.configs.rainbow import RainbowConfig
from learner.config import LearnerConfig, ReplayConfig, ValueConfig
from learner.replay import ReplaySpec
from learner.store import StepArrays

RECORD = Path(__file__).with_suffix(".json")
TOLERANCE = 1e-4
"""largest difference from a recorded number, over that number

Measured with jax 0.10.2 on an AMD EPYC of model 17 (2026-11-22), recorded with AVX512_BF16: 2e-7 with AVX2 and 4e-6
with SSE4_2, a twenty-fifth of this. """
NUM_UPDATES = 12
AGENT = RainbowConfig(conv_channels=(4,), conv_kernels=(4,), conv_strides=(2,), hidden_units=8, num_atoms=11)
_LEARNER = LearnerConfig(batch_size=8, total_updates=NUM_UPDATES, target_period_updates=4, learning_rate=1e-2)
_REPLAY = ReplayConfig()
_NUM_LANES, _NUM_TASKS, _NUM_RECORDS, _EPISODE_STEPS = 2, 2, 80, 10
_FRAME = (8, 8, 1)


def run(agent_config: ValueConfig = AGENT) -> dict[str, list[float]]:
    """Makes NUM_UPDATES updates; returns the numbers of each, by name.

    Args:
        agent_config: the recorded numbers belong to the default.
    """
    num_actions = 3
    shape = (*_FRAME[:2], agent_config.stack_size * _FRAME[2])
    agent = make_agent(
        agent_config, AgentSpec(obs_shape=shape, num_actions=num_actions, num_tasks=_NUM_TASKS, v_min=-3.0, v_max=3.0)
    )
    assert isinstance(agent, OffPolicyAgent)
    spec = ReplaySpec(
        num_lanes=_NUM_LANES,
        capacity=4 * _NUM_RECORDS,
        frame_shape=_FRAME,
        num_tasks=_NUM_TASKS,
        stack_size=agent_config.stack_size,
        n_steps=agent_config.n_steps,
        discount=agent_config.discount,
        priority_exponent=_REPLAY.priority_exponent,
        min_priority=_REPLAY.min_priority,
        prioritized=_REPLAY.prioritized,
        num_newest=0,
    )
    stored = jax.jit(lambda block: replay.add(spec, replay.init(spec), block))(_records(num_actions))
    state = jax.jit(lambda key: train_step.init(agent, spec, _LEARNER, key))(jax.random.key(0))
    update = train_step.make_train_step(agent, spec, _LEARNER, _REPLAY, 1)
    no_metrics, weights = jax.device_get(state.metrics), jnp.asarray([1.0, 2.0])

    rows: list[dict[str, float]] = []
    for _ in range(NUM_UPDATES):
        state, stored = update(replace(state, metrics=jax.tree.map(jnp.array, no_metrics)), stored, weights)
        row = {
            "loss": float(state.metrics.loss),
            "gradient norm": float(state.metrics.grad_norm),
            "parameter norm": sum(float(jnp.vdot(leaf, leaf)) for leaf in jax.tree.leaves(state.params)) ** 0.5,
            "sum of priorities": float(sum_tree.total(stored.tree)),
        }
        rows.append(row)
    return {name: [row[name] for row in rows] for name in rows[0]}


def check(found: dict[str, list[float]], recorded: dict[str, list[float]]) -> float:
    """Compares the numbers of `run` with recorded ones.

    Returns:
        The largest difference, over the recorded number.

    Raises:
        ValueError: a difference is larger than TOLERANCE, or a number is NaN; names the first one.
    """
    largest = 0.0
    for update in range(NUM_UPDATES):
        for name, wanted in recorded.items():
            got, want = found[name][update], wanted[update]
            difference = abs(got - want) / abs(want)
            if not difference <= TOLERANCE:
                raise ValueError(
                    f"self-check: {name} of update {update + 1} is {got:.6g}, want {want:.6g}, the recorded number, "
                    f"within {TOLERANCE:g} of it"
                )
            largest = max(largest, difference)
    return largest


def _records(num_actions: int) -> StepArrays:
    """Two games of episodes of ten decisions. Integer arithmetic alone: no generator may change it."""
    i = np.arange(_NUM_RECORDS, dtype=np.uint32)
    t = i // _NUM_LANES
    pixel = np.arange(np.prod(_FRAME), dtype=np.uint32)
    mixed = (i[:, None] * np.uint32(2654435761) + pixel * np.uint32(2246822519)) >> np.uint32(24)
    return StepArrays(
        frames=mixed.astype(np.uint8).reshape(-1, *_FRAME),
        action=(mixed[:, 0] % num_actions).astype(np.int32),
        reward=(mixed[:, 1].astype(np.float32) - 128) / 128,
        lane=(i % _NUM_LANES).astype(np.int32),
        task=(i % _NUM_LANES).astype(np.int32),
        first=t % _EPISODE_STEPS == 0,
        terminated=t % _EPISODE_STEPS == _EPISODE_STEPS - 1,
        truncated=np.zeros(_NUM_RECORDS, bool),
        num_valid=jnp.int32(_NUM_RECORDS),
    )


def main(arguments: Sequence[str] | None = None) -> None:
    """Prints what `gvz doctor` shows, or records the numbers; raises as `check` does."""
    parser = argparse.ArgumentParser(description="Learns a fixed tiny problem; compares with recorded numbers.")
    parser.add_argument("--record", action="store_true", help=f"write the numbers into {RECORD.name}")
    record = parser.parse_args(arguments).record
    found = run()
    if record:
        RECORD.write_text(json.dumps(found, indent=1) + "\n")
    largest = check(found, json.loads(RECORD.read_text()))
    print(f"{NUM_UPDATES} updates as recorded, to {largest:.1g} of each number (tolerance {TOLERANCE:g})")


if __name__ == "__main__":
    main()
