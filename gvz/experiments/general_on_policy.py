"""The experiment `general_segmented_long` with PPO, the better of the two on-policy agents in `gate_on_policy`."""

import dataclasses

from gvz.experiments.general_segmented_long import EXPERIMENT as SEGMENTED
from gvz.experiments.general_segmented_long import PUBLISHED_NOTE

EXPERIMENT = dataclasses.replace(
    SEGMENTED,
    name="general_on_policy",
    title="Generalization without a replay, within 90 minutes of one core",
    question="How well does PPO play unseen tasks, with the frames, the network and the time of rainbow_segmented?",
    configs=("ppo_segmented",),
    seeds=(1111,),
    notes=(
        "Agents see what the networks that come with GViZDoom recognize on the screen, and the scenario's game "
        "variables. They have the discounts and the rewards of rainbow_segmented. No frames are shifted in training.",
        PUBLISHED_NOTE,
    ),
)
