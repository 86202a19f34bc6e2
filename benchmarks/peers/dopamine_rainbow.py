"""Dopamine's JAX full Rainbow update, including the sampling of its prioritized buffer:
`python dopamine_rainbow.py CAPACITY BATCH_SIZE`.

Observations are 12 grey frames of 84x84: the array has the size of ours with 4 frames in colour. The buffer keeps whole
stacks, 10 GB at 100K, so it holds at most _MAX_CAPACITY here; sampling from a smaller buffer is not slower.
"""

import sys
import time
from typing import Any

import gin
import jax
import numpy as np
from dopamine.jax.agents.full_rainbow.full_rainbow_agent import JaxFullRainbowAgent
from serve import serve

_NUM_ACTIONS, _STACK = 3, 12
_EPISODE_STEPS = 100
_MAX_CAPACITY = 3_000


def main() -> None:
    """Fills the agent's buffer and serves."""
    capacity, batch_size = min(int(sys.argv[1]), _MAX_CAPACITY), int(sys.argv[2])
    gin.bind_parameter("JaxDQNAgent.stack_size", _STACK)
    gin.bind_parameter("JaxDQNAgent.update_horizon", 3)
    gin.bind_parameter("ReplayBuffer.max_capacity", capacity)
    gin.bind_parameter("PrioritizedSamplingDistribution.max_capacity", capacity)
    gin.bind_parameter("ReplayBuffer.batch_size", batch_size)
    agent = JaxFullRainbowAgent(num_actions=_NUM_ACTIONS, seed=0)
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (64, 84, 84), np.uint8)
    for step in range(capacity):
        last = step % _EPISODE_STEPS == _EPISODE_STEPS - 1
        agent._store_transition(frames[step % 64], step % _NUM_ACTIONS, float(rng.random()), last, episode_end=last)

    def update(seconds: float) -> dict[str, Any]:
        count, start = 0, time.perf_counter()
        while count == 0 or time.perf_counter() - start < seconds:
            agent._training_step_update()
            count += 1
        jax.block_until_ready(agent.online_params)
        return {"seconds_per_call": (time.perf_counter() - start) / count}

    update(0.0)
    serve(update, "dopamine-rl", "jax", "flax")


if __name__ == "__main__":
    main()
