"""`rainbow_general` for a machine with a GPU: frames of 84x84, a larger encoder, batches of 256 transitions.

The encoder is IMPALA's, pooled over the height. The GPU chooses the actions, too. Its memory holds the replay, 3.5 GB.
A gradient step comes with 64 decisions: a decision is drawn four times, and twice in `rainbow_general`. With 16 cores
and an NVIDIA H200 it makes 108 gradient steps a second (results/general_gpu). The learner never waits there.
"""

import dataclasses

from actors.config import ActorsConfig
from configs.rainbow_general import CONFIG as GENERAL
from gvz.run.config import off_policy

_LEARNER, _REPLAY = off_policy(GENERAL)

CONFIG = dataclasses.replace(
    GENERAL,
    name="rainbow_general_gpu",
    env=dataclasses.replace(GENERAL.env, frame_height=84, frame_width=84),
    actors=ActorsConfig(inference="device"),
    agent=dataclasses.replace(
        GENERAL.agent, encoder="impala_height_pool", hidden_units=512, activation_dtype="bfloat16"
    ),
    replay=dataclasses.replace(_REPLAY, capacity=500_000),
    learner=dataclasses.replace(
        _LEARNER,
        batch_size=256,
        env_steps_per_update=64.0,
        step_tolerance=4_096,
        warmup_steps=20_000,
        learning_rate=2.5e-4,
    ),
)
