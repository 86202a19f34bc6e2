"""The experiment `general_segmented_train4` with the time of `general`."""

import dataclasses

from gvz.experiments.general_segmented_long import EXPERIMENT as LONG
from gvz.experiments.general_segmented_train4 import EXPERIMENT as TRAIN4

EXPERIMENT = dataclasses.replace(
    TRAIN4,
    name="general_segmented_train4_long",
    title="Generalization from four training tasks with a segmentation network, within 90 minutes of one core",
    question="What do six times the time of general_segmented_train4 give?",
    max_processor_s=LONG.max_processor_s,
    players=LONG.players,
)
