"""The experiment `general_segmented_varied` with the time of `general_segmented_long`."""

import dataclasses

from gvz.experiments.general_segmented_long import EXPERIMENT as LONG
from gvz.experiments.general_segmented_varied import EXPERIMENT as VARIED

EXPERIMENT = dataclasses.replace(
    VARIED,
    name="general_segmented_varied_long",
    title="Generalization from varied maps with a segmentation network, within 90 minutes of one core",
    question="What do six times the time of general_segmented_varied give?",
    max_processor_s=LONG.max_processor_s,
)
