"""`general_segmented_varied_network` on the eight tasks, too: on their own maps and on varied ones."""

import dataclasses

from gvz.experiments.general_segmented_varied_network import EXPERIMENT as VARIED_NETWORK

EXPERIMENT = dataclasses.replace(
    VARIED_NETWORK,
    name="general_segmented_train8_varied",
    title="Generalization from eight training tasks and varied maps, within 90 minutes of one core",
    question="How well does an agent play unseen tasks if it trains on eight tasks, also on varied maps?",
    trainings=("train8_varied",),
    notes=(
        "The networks come with GViZDoom. They learned from the engine's labels on the same tasks for 1,500 seconds of "
        "processor time. All other settings were chosen by runs on eight training tasks.",
    ),
)
