"""The experiment `general` on eight training tasks, with the loss of sight."""

import dataclasses

from gvz.experiments.gate_sight_loss import EXPERIMENT as GATE
from gvz.experiments.general import EXPERIMENT as GENERAL

EXPERIMENT = dataclasses.replace(
    GENERAL,
    name="general_long",
    title="Generalization with the engine's labels in training, within 90 minutes of one core",
    question="What do six times the time of general_sight_loss give?",
    variants={"sight_loss": GATE.variants["sight_0.1"]},
    trainings=("train8",),
    seeds=(1111,),
    columns="config",
    players=("random",),
    notes=("Labels are needed in training alone: agents act, and are evaluated, on the same frames as others.",),
)
