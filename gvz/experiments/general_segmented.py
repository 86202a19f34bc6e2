"""The experiment `general_short` on frames that show what a network takes each part of the screen for."""

import dataclasses

from gvz.experiments.general_short import EXPERIMENT as SHORT

EXPERIMENT = dataclasses.replace(
    SHORT,
    name="general_segmented",
    title="Generalization with a segmentation network",
    question="How well does an agent play unseen tasks that sees what a network recognizes on the screen?",
    configs=("rainbow_segmented",),
    columns="config",
    players=(),
    published={},
    notes=(
        "The networks come with GViZDoom. Each learned from the engine's labels, on the eight training tasks of its "
        "scenario, for 1,500 seconds of processor time, in Dodge Projectiles for 700, which come to the time of these "
        "runs. Agents need no labels. They also observe the scenario's game variables, and have a discount of 0.95, in "
        "Health Gathering of 0.98. In Dodge Projectiles they get a reward for moving in training, and half of a batch "
        "shows shifted frames. The other agents see frames alone, and have a discount of 0.99.",
    ),
)
