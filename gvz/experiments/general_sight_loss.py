"""The experiment `general_short` with a further loss: agents learn in training to tell what is in sight."""

import dataclasses

from gvz.experiments.gate_sight_loss import EXPERIMENT as GATE
from gvz.experiments.general_short import EXPERIMENT as SHORT

EXPERIMENT = dataclasses.replace(
    SHORT,
    name="general_sight_loss",
    title="Generalization with the engine's labels in training",
    question="How well does an agent play unseen tasks that has also learned from labels to tell what is in sight?",
    variants={"sight_loss": GATE.variants["sight_0.1"]},
    columns="config",
    players=(),
    published={},
    notes=("Labels are needed in training alone: agents act, and are evaluated, on the same frames as others.",),
)
