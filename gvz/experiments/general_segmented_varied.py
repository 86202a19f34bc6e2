"""The experiment `general_segmented` on varied maps instead of eight training tasks."""

import dataclasses

from gvz.experiments.general_segmented import EXPERIMENT as SEGMENTED

EXPERIMENT = dataclasses.replace(
    SEGMENTED,
    name="general_segmented_varied",
    title="Generalization from varied maps with a segmentation network",
    question="How well does an agent play unseen tasks if every training episode has a map with looks drawn anew?",
    trainings=("varied",),
    columns="training",
    notes=(
        *SEGMENTED.notes,
        "The agents train on varied maps of their scenario's default task; the networks have seen the eight training "
        "tasks. All settings were chosen by runs on eight training tasks.",
    ),
)
