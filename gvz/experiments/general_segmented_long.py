"""The experiment `general_segmented` with the time and the episodes of `general`."""

import dataclasses

from gvz.experiments.algorithm_comparison import EXPERIMENT as ALGORITHMS
from gvz.experiments.general import EXPERIMENT as GENERAL
from gvz.experiments.general_segmented import EXPERIMENT as SHORT
from gvz.experiments.general_short import EXPERIMENT as SCREEN

PUBLISHED_NOTE = (
    "The thesis's Rainbow learned for 200,000 gradient steps from the screen alone. LevDoom's did for 1.0M, with other "
    "time-outs and upper bounds, and its numbers are percent of those. Neither had labels, game variables or other "
    "rewards in training, as these agents had."
)

EXPERIMENT = dataclasses.replace(
    SHORT,
    name="general_segmented_long",
    title="Generalization with a segmentation network, within 90 minutes of one core",
    question="What do six times the time of general_segmented give?",
    max_processor_s=GENERAL.max_processor_s,
    episodes=GENERAL.episodes,
    players=("random",),
    published={
        "thesis": SCREEN.published["thesis"],
        "LevDoom": {scenario: scores[-1:] for scenario, scores in ALGORITHMS.published["LevDoom"].items()},
    },
    notes=(*SHORT.notes, PUBLISHED_NOTE),
)
