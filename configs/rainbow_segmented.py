"""`rainbow_general` on frames that show what a network takes each part of the screen for (docs/BENCHMARK.md).

The network (`gvz segmenter`) has learned from the engine's labels what things look like, and the agent learns play
alone. Frames are 24x42, half as high and wide, so the convolutions are half as large with half the strides. The agent
also observes the scenario's game variables, and looks less far ahead, with a discount of 0.95, in Health Gathering of
0.98. In Dodge Projectiles it gets a reward for moving, and half of a batch shows shifted frames (docs/FINDINGS.md).
"""

import dataclasses

from configs.rainbow_general import CONFIG as GENERAL

CONFIG = dataclasses.replace(
    GENERAL,
    name="rainbow_segmented",
    env=dataclasses.replace(
        GENERAL.env,
        frames="segmented",
        frame_height=24,
        frame_width=42,
        grayscale=False,
        reward_weights=(*GENERAL.env.reward_weights, ("dodge_projectiles.moved", 0.002)),
    ),
    agent=dataclasses.replace(
        GENERAL.agent, conv_kernels=(4, 4), conv_strides=(2, 2), discount=0.95, game_variables=True
    ),
)

SCENARIO_SETTINGS = {
    "dodge_projectiles": {"agent.augmentations": ["shift"], "agent.augmentation_strength": 0.5},
    "health_gathering": {"agent.discount": 0.98},
}
