"""Tianshou's PyTorch Rainbow update, including the sampling of its prioritized buffer:
`python tianshou_rainbow.py CAPACITY BATCH_SIZE`.

The network is Tianshou's own (Nature convolutions, dueling, noisy, 51 atoms); frames of 84x84x3 are stored once and
stacked by fours when a batch is drawn.
"""

import sys
import time
from typing import Any

import gymnasium
import numpy as np
import torch
from serve import serve
from tianshou.algorithm import RainbowDQN
from tianshou.algorithm.modelfree.c51 import C51Policy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Batch, PrioritizedReplayBuffer
from tianshou.env.atari.atari_network import RainbowNet
from tianshou.utils.torch_utils import policy_within_training_step

_NUM_ACTIONS, _STACK = 3, 4
_EPISODE_STEPS = 100


class StackedFrames(RainbowNet):
    """Takes uint8 [B, stack, 3, 84, 84], the buffer's form of a stack."""

    def forward(self, obs: Any, state: Any = None, info: Any = None) -> Any:
        frames = torch.as_tensor(obs).float().flatten(1, 2) / 255
        return super().forward(frames, state, info)


def filled_buffer(capacity: int) -> PrioritizedReplayBuffer:
    """A buffer full of noise, in episodes of a hundred steps."""
    buffer = PrioritizedReplayBuffer(
        capacity, alpha=0.6, beta=0.4, stack_num=_STACK, ignore_obs_next=True, save_only_last_obs=False
    )
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 256, (64, 3, 84, 84), np.uint8)
    for step in range(capacity):
        done = step % _EPISODE_STEPS == _EPISODE_STEPS - 1
        record = {"obs": frames[step % 64], "act": step % _NUM_ACTIONS, "rew": rng.random(), "info": {}}
        buffer.add(Batch(**record, obs_next=frames[step % 64], terminated=done, truncated=False))
    return buffer


def main() -> None:
    """Builds the algorithm and serves."""
    capacity, batch_size = int(sys.argv[1]), int(sys.argv[2])
    network = StackedFrames(c=12, h=84, w=84, action_shape=[_NUM_ACTIONS])
    policy = C51Policy(model=network, action_space=gymnasium.spaces.Discrete(_NUM_ACTIONS))
    algorithm = RainbowDQN(
        policy=policy,
        optim=AdamOptimizerFactory(lr=1e-4),
        gamma=0.99,
        n_step_return_horizon=3,
        target_update_freq=3000,
    )
    buffer = filled_buffer(capacity)

    def update(seconds: float) -> dict[str, Any]:
        count, start = 0, time.perf_counter()
        with policy_within_training_step(policy):
            while count == 0 or time.perf_counter() - start < seconds:
                algorithm.update(buffer=buffer, sample_size=batch_size)
                count += 1
        return {"seconds_per_call": (time.perf_counter() - start) / count}

    update(0.0)
    serve(update, "tianshou", "torch", threads=torch.get_num_threads())


if __name__ == "__main__":
    main()
