"""The experiment `general_segmented` on four training tasks, with networks that have seen these alone."""

import dataclasses

from gvz.experiments.general_segmented import EXPERIMENT as SEGMENTED
from gvz.experiments.training_set_size import EXPERIMENT as THESIS

_TRAIN4 = THESIS.trainings.index("train4")

EXPERIMENT = dataclasses.replace(
    SEGMENTED,
    name="general_segmented_train4",
    title="Generalization from four training tasks with a segmentation network",
    question="How well does an agent play unseen tasks if it and its network have seen four training tasks?",
    variants={"train4_network": {"env.segmenter": "train4"}},
    trainings=("train4",),
    columns="training",
    published={"thesis": {scenario: (scores[_TRAIN4],) for scenario, scores in THESIS.published["thesis"].items()}},
    notes=(
        "The networks come with GViZDoom. Each learned from the engine's labels, on the four training tasks of its "
        "scenario, for 1,500 seconds of processor time, in Dodge Projectiles for 700, which come to the time of these "
        "runs. All else is as in general_segmented, whose settings were chosen by runs on eight training tasks.",
    ),
)
