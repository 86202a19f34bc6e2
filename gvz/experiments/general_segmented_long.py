"""The experiment `general_segmented` with the time and the episodes of `general`."""

import dataclasses

from gvz.experiments.general import EXPERIMENT as GENERAL
from gvz.experiments.general_segmented import EXPERIMENT as SHORT

EXPERIMENT = dataclasses.replace(
    SHORT,
    name="general_segmented_long",
    title="Generalization with a segmentation network, within 90 minutes of one core",
    question="What do six times the time of general_segmented give?",
    max_processor_s=GENERAL.max_processor_s,
    episodes=GENERAL.episodes,
    players=("random",),
)
