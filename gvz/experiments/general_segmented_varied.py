"""The experiment `general_segmented` on varied maps instead of eight training tasks."""

import dataclasses

from gvz.experiments.general_segmented import EXPERIMENT as SEGMENTED

EXPERIMENT = dataclasses.replace(
    SEGMENTED,
    name="general_segmented_varied",
    title="Generalization from varied maps with a segmentation network",
    question="How well does an agent play unseen tasks if it trains on 1,000 maps that differ in their looks?",
    trainings=("varied",),
    columns="training",
    notes=(
        *SEGMENTED.notes,
        "The agents train on varied maps. All settings were chosen by runs on eight training tasks.",
    ),
)
