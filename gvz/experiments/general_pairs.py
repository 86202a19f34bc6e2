"""The experiment `general_short` on the eight training tasks and pairs of their attributes."""

import dataclasses

from gvz.experiments.general_short import EXPERIMENT as SHORT

EXPERIMENT = dataclasses.replace(
    SHORT,
    name="general_pairs",
    title="Generalization when attributes come in pairs",
    question="Are unseen tasks played better if training also combines each two of the eight tasks' attributes?",
    trainings=("pairs",),
    seeds=(1111, 2222),
    players=(),
    published={},
    notes=(
        "No attribute is new: the set has the eight training tasks, and each two of their attributes that go together "
        "and are no named task. So the gate tasks and the test tasks stay unseen. The thesis has no such set.",
    ),
)
