"""The experiment `general_segmented` on the eight training tasks and all compositions of their attributes."""

import dataclasses

from gvz.experiments.general_segmented import EXPERIMENT as SEGMENTED

EXPERIMENT = dataclasses.replace(
    SEGMENTED,
    name="general_compositions",
    title="Generalization when attributes come together in training",
    question="Are unseen tasks played better if training also combines any number of the eight tasks' attributes?",
    trainings=("compositions",),
    columns="training",
    notes=(
        "No attribute is new: the set has the eight training tasks, and each choice of their attributes that go "
        "together and are no named task. So the gate tasks and the test tasks stay unseen. Each task has a game of its "
        "own. The thesis has no such set. " + SEGMENTED.notes[0],
    ),
)
