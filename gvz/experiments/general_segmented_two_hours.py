"""The experiment `general_segmented_long` with two hours of two cores, for one training seed."""

import dataclasses

from gvz.experiments.general_segmented_long import EXPERIMENT as LONG

EXPERIMENT = dataclasses.replace(
    LONG,
    name="general_segmented_two_hours",
    title="Generalization from eight training tasks with a segmentation network, within two hours of two cores",
    question="What do 14,400 seconds of processor time give, where general_segmented_long has 5,400?",
    seeds=(1111,),
    max_processor_s=14_400.0,
)
