"""The experiment `general` with a sixth of its time, on eight training tasks."""

import dataclasses

from gvz.experiments.general import EXPERIMENT as GENERAL
from gvz.experiments.training_set_size import EXPERIMENT as THESIS

EXPERIMENT = dataclasses.replace(
    GENERAL,
    name="general_short",
    title="Generalization on all scenarios, within 15 minutes of one core",
    question="How does an agent of one core and 15 minutes play tasks that it was not trained on?",
    trainings=("train8",),
    max_processor_s=900.0,
    episodes=50,
    players=("random",),
    published={"thesis": {scenario: (scores[-1],) for scenario, scores in THESIS.published["thesis"].items()}},
)
